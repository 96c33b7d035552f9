"""`field.html`: a baked field and what draws it in one file, for whatever browser has WebGL 2: to walk through, to keep, to send.

The page holds only what cannot be worked out (occupied voxels, a byte of density and sixteen of features a corner as `corners.py` writes
them, the decoder), deflated; the scripts in `web/` unpack it and march through it as `backends/numba/march.py` does. It asks no server
for anything.
"""

from __future__ import annotations

import base64
import itertools
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, StrictUndefined

from fieldfuse import __version__
from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.corners import corner_differences, written_corners
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.encoding import BEHIND, DIRECTION, SH
from fieldfuse.render.bake import FINER, BakedField
from fieldfuse.render.field import Field
from fieldfuse.render.march import MAX_STRETCH
from fieldfuse.tone import SHOULDER

CHANNELS, HIDDEN = 16, 96  # at most: what lies in one word of four, and, in thirds, in uniform blocks of 16 kB
WHOLE = 12  # hidden units are a multiple of it: three parts of rows, four units a vector
INPUTS = CHANNELS + DIRECTION  # of the decoder: features and harmonics
NEAREST_DEPTH, FARTHEST_DEPTH = 0.6, 2.5  # of the median depth: the range of depth's colours
SCRIPTS = ("unpack.js", "draw.js", "walk.js", "frame.js", "tools.js", "vr.js", "page.js")


@dataclass(frozen=True)
class Tour:
    """Where a visitor can go: photos, and a path to fly along.

    Attributes:
        names, lenses, poses: of the photos; poses (N, 4, 4) world_from_camera, working frame.
        test: (N,) bool, held out.
        path: (F, 4, 4) closed.
        depth: median depth of the scene, working units: how far away what is looked at is taken to be.
        exposure: colours are shown brighter by it (`fieldfuse.tone.brighter`).
        start: the photo at which a visitor begins.
        working_from_input: what is measured, cropped, saved and shared is in the input's frame.
        metric: its unit is a metre.
        region: (3,) lowest and (3,) highest corner of what matters, working frame: a crop box begins there.
        inside: a drag looks around, as in a room, and does not turn about what is in the middle.
    """

    names: Sequence[str]
    lenses: Sequence[Intrinsics]
    poses: Array
    test: Array
    path: Array
    depth: float
    exposure: float = 1.0
    start: int = 0
    working_from_input: Similarity = field(default_factory=Similarity.identity)
    metric: bool = False
    region: tuple[Array, Array] = (np.full(3, -1.0), np.full(3, 1.0))
    inside: bool = False


def require_page(field: Field) -> None:
    """
    Raises:
        InputError: a field with this decoder, or of so many features, does not go into a page.
    """
    if not isinstance(field.decoder, Deferred):
        raise InputError("only a field with the deferred decoder goes into a page; fit it with --decoder deferred")
    channels, hidden = field.decoder.channels, field.decoder.hidden
    if channels > CHANNELS or hidden > HIDDEN:
        raise InputError(
            f"a page draws up to {CHANNELS} features and {HIDDEN} hidden units, and this field has {channels} and {hidden}; "
            "leave page out of export.formats, or fit with the usual field.channels and field.hidden"
        )


def write_page(path: Path | str, field: BakedField, tour: Tour, title: str) -> None:
    """Write the page, atomically. `field` was baked from one that passed `require_page`.

    Raises:
        OutputError: it cannot be written.
    """
    text = page(field, tour, title)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def page(field: BakedField, tour: Tour, title: str) -> str:
    """The page's text."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    about, blob = packed(field, tour)
    # What closes a script would end it, wherever it stands.
    quoted = json.dumps(about, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    raw = environment.filters["safe"]
    return environment.from_string(_source("index.html.j2")).render(
        version=__version__,
        title=title,
        photos=len(tour.names),
        voxels=f"{field.voxels:,}",
        unit="metres" if tour.metric else "units",
        style=raw(_source("style.css")),
        about=raw(quoted),
        march=raw(_source("march.frag")),
        decode=raw(_source("decode.frag")),
        field=raw(base64.b64encode(_deflated(blob)).decode("ascii")),
        script=raw("\n".join(_source(name) for name in SCRIPTS)),
    )


def packed(field: BakedField, tour: Tour) -> tuple[dict[str, Any], bytes]:
    """What the scripts need to know, and the arrays one after the other, each filled up to whole words."""
    arrays = field.arrays
    small, large = decoder_blocks(field)
    given: list[tuple[str, Array]] = [
        ("bits", np.ascontiguousarray(arrays.bits).view(np.uint8)),
        ("keys", (field.keys() - field.table_origin).astype(np.uint16)),
        ("bricks", arrays.bricks),
        ("values", corner_differences(field, written_corners(field))),
        ("thickness", arrays.thickness.astype("<f4")),
        ("small", small.astype("<f4")),
        ("large", large.astype("<f4")),
        ("palette", _palette()),
    ]
    blob = bytearray()
    for _, array in given:
        blob += array.tobytes()
        blob += b"\0" * (-len(blob) % 4)
    about = _about(field, tour)
    about["arrays"] = [[name, f"{array.dtype.kind}{array.dtype.itemsize}", array.size] for name, array in given]
    return about, bytes(blob)


def _deflated(blob: bytes) -> bytes:
    """Differences hardly repeat: their frequencies are all that helps, and runs in what else there is."""
    how = zlib.compressobj(strategy=zlib.Z_RLE)
    return how.compress(blob) + how.flush()


def _width(field: BakedField) -> int:
    """Hidden units of a page's decoder."""
    return -(-len(field.decoder.b1) // WHOLE) * WHOLE


def decoder_blocks(field: BakedField) -> tuple[Array, Array]:
    """The decoder as the shader's uniform blocks: matrices of four by four, column by column, (first layer, biases, last layer) and
    (second layer, whose rows are used in thirds). Hidden units that are missing up to `_width` are zeros."""
    d, channels, width = field.decoder, field.arrays.feature.shape[1], _width(field)
    w1 = np.zeros((width, INPUTS), np.float32)
    hidden = len(d.b1)
    w1[:hidden, :channels] = d.w1_out[:, :channels]
    w1[:hidden, CHANNELS:] = d.w1_out[:, channels : channels + DIRECTION]
    w2 = _padded(_padded(d.w2_out, width, 1), width, 0)
    last = _padded(d.w3, width, 1)
    small = [_by_four(w1), _padded(d.b1, width, 0), _padded(d.b2, width, 0), last.reshape(-1), _padded(d.b3, 4, 0)]
    return np.concatenate([part.reshape(-1) for part in small]), _by_four(w2).reshape(-1)


def _about(field: BakedField, tour: Tour) -> dict[str, Any]:
    """Numbers that are not arrays."""
    space, resolution = field.space, field.resolution
    voxel = 2 * space.extent / resolution
    low, scale = (_padded(values, CHANNELS, 0) for values in (field.arrays.low, field.arrays.scale))
    sky = np.zeros((BEHIND, 3))
    sky[0] = field.background / SH[0]
    march = {
        "centre": list(space.centre),
        "box": list(space.box),
        "tableOrigin": list(field.table_origin),
        "halfSize": space.half,
        "shell": space.shell,
        "extent": space.extent,
        "voxel": voxel,
        "near": field.near,
        "low": low.tolist(),
        "scale": scale.tolist(),
    }
    define: dict[str, Any] = {"FINE": field.fine, "FINER": FINER, "RESOLUTION": resolution, "HIDDEN": _width(field)}
    define |= {"MAX_STRETCH": f"{MAX_STRETCH:e}", "LONGEST": int(14 * space.extent / (4 * voxel)) + 32}
    define["SHOULDER"] = repr(SHOULDER)
    define |= {f"C{number}": repr(value) for number, value in enumerate(SH)}
    frame = tour.working_from_input
    corners = frame.inverse().points(np.array(list(itertools.product(*zip(*tour.region, strict=True)))))
    return {
        "define": define,
        "march": march,
        "sky": (sky if field.sky is None else np.asarray(field.sky, np.float64)).reshape(-1).tolist(),
        "table": list(field.arrays.table.shape[::-1]),
        "side": field.arrays.bricks.shape[0],
        "channels": field.arrays.feature.shape[1],
        "depth": tour.depth,
        "exposure": tour.exposure,
        "range": [1 / (FARTHEST_DEPTH * tour.depth), 1 / (NEAREST_DEPTH * tour.depth)],
        "start": tour.start,
        "frame": {"scale": frame.scale, "turn": frame.rotation.reshape(-1).tolist(), "shift": frame.translation.tolist()},
        "metric": tour.metric,
        "region": [corners.min(0).tolist(), corners.max(0).tolist()],
        "inside": tour.inside,
        "photos": [
            {"name": name, "lens": [c.width, c.height, c.fx, c.fy], "pose": _numbers(pose), "test": bool(test)}
            for name, c, pose, test in zip(tour.names, tour.lenses, tour.poses, tour.test, strict=True)
        ],
        "path": [_numbers(pose) for pose in tour.path],
    }


def _rounded(values: Array) -> list[float]:
    """With as many digits as are worth it."""
    return [float(f"{value:.7g}") for value in np.asarray(values).reshape(-1)]


def _numbers(pose: Array) -> list[float]:
    """Twelve of them."""
    values = _rounded(pose[:3])
    if not all(math.isfinite(value) for value in values):
        raise InputError("a camera's pose is not finite; find the poses again")
    return values


def _padded(values: Array, size: int, axis: int) -> Array:
    """Zeros behind, up to `size` along `axis`."""
    short = [(0, size - length if number == axis else 0) for number, length in enumerate(values.shape)]
    return np.pad(values, short)


def _by_four(matrix: Array) -> Array:
    """(4 n, 4 m) → (n, m, 4, 4) blocks, each column by column."""
    rows, columns = matrix.shape
    return matrix.reshape(rows // 4, 4, columns // 4, 4).transpose(0, 2, 3, 1)


def _palette() -> Array:
    """(256, 4) uint8: depth's colours from far (red) to near (blue), as in the report."""
    colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[::-1, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return np.concatenate([colours, np.full((256, 1), 255, np.uint8)], 1)


def _source(name: str) -> str:
    return resources.files("fieldfuse.export").joinpath("web", name).read_text(encoding="utf-8")
