"""`field.html`: a baked field and what draws it in one file, for whatever browser has WebGL 2: to walk through, to keep, to send.

The page holds only what cannot be worked out (occupied voxels, a byte of density and sixteen of features a corner as `corners.py` writes
them, the decoder), deflated; the scripts in `web/` unpack it and march through it as `backends/numba/march.py` does. It asks no server
for anything.

A field that is too large for that is in the page on a coarser lattice, and in whole in `field_parts/` beside it (`parts.py`).
"""

from __future__ import annotations

import base64
import itertools
import json
import math
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
from fieldfuse.export.coarse import coarsened
from fieldfuse.export.parts import PART_BYTES, PARTS, corner_arrays, deflated, joined, remove_others, write_parts
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.encoding import BEHIND, DIRECTION, SH
from fieldfuse.render.bake import FINER, BakedField, bake
from fieldfuse.render.field import Field
from fieldfuse.render.march import MAX_STRETCH
from fieldfuse.tone import SHOULDER

CHANNELS, HIDDEN = 16, 96  # at most: what lies in one word of four, and, in thirds, in uniform blocks of 16 kB
WHOLE = 12  # hidden units are a multiple of it: three parts of rows, four units a vector
INPUTS = CHANNELS + DIRECTION  # of the decoder: features and harmonics
MOST_BYTES = 25_000_000  # of a field in its page: a page of 33 MB, which a phone opens in seconds and many a mailbox still takes
COARSEST = 16  # by how much, at most, what is in the page is coarser than the field
DETAIL_BYTES = 400_000_000  # of textures for details at a time: a phone's browser gives a page about a gigabyte in all
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


def write_page(path: Path | str, field: BakedField, tour: Tour, title: str, whole: Field | None = None) -> list[Path]:
    """Write the page, atomically; where the field is too large for one file, a coarse one is in it, and the field is in `field_parts/`
    beside it. Answers all files.

    Args:
        field: baked from one that passed `require_page`.
        whole: what it was baked from, on the CPU; None: what its bytes stand for. Coarse ones are made of it.

    Raises:
        OutputError: a file cannot be written.
    """
    path = Path(path)
    files: list[Path] = []
    about, blob = packed(field, tour)
    inside = deflated(blob)
    if len(inside) > MOST_BYTES:
        count = -(-len(inside) // PART_BYTES)
        coarse, ratio, about, inside = _coarse(field, field.to_field() if whole is None else whole, tour)
        own, files = write_parts(path.parent / PARTS, field, coarse, ratio, count)
        about |= {"parts": {"field": own, "ratio": ratio, "budget": DETAIL_BYTES}}
    with atomic_path(path) as temporary:
        temporary.write_text(_text(about, inside, title, field.voxels), encoding="utf-8")
    remove_others(path.parent / PARTS, files)
    return [path, *files]


def page(field: BakedField, tour: Tour, title: str) -> str:
    """The text of the page with the whole field in it."""
    about, blob = packed(field, tour)
    return _text(about, deflated(blob), title, field.voxels)


def _coarse(field: BakedField, whole: Field, tour: Tour) -> tuple[BakedField, int, dict[str, Any], bytes]:
    """The finest of the coarser fields that fits into a page, by how much it is coarser, and what `packed` and `deflated` make of it."""
    ratio = 1
    while True:
        ratio *= 2
        coarse = bake(coarsened(whole, ratio), like=field)
        about, blob = packed(coarse, tour)
        inside = deflated(blob)
        if len(inside) <= MOST_BYTES or ratio == COARSEST:
            break
    about["march"]["voxel"] = ratio * 2 * field.space.extent / field.resolution
    about["define"] |= {"RATIO": ratio, "COARSE_STEPS": field.fine, "FINE": "steps"}  # how many of them is a variable of the shader
    return coarse, ratio, about, inside


def _text(about: dict[str, Any], inside: bytes, title: str, voxels: int) -> str:
    """The page around what `packed` and `deflated` answer."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    # What closes a script would end it, wherever it stands.
    quoted = json.dumps(about, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    raw, parts = environment.filters["safe"], "parts" in about
    return environment.from_string(_source("index.html.j2")).render(
        version=__version__,
        title=title,
        photos=len(about["photos"]),
        voxels=f"{voxels:,}",
        unit="metres" if about["metric"] else "units",
        parts=parts,
        style=raw(_source("style.css")),
        about=raw(quoted),
        march=raw(_script("march.frag", parts)),
        decode=raw(_script("decode.frag", parts)),
        field=raw(base64.b64encode(inside).decode("ascii")),
        script=raw("\n".join(_script(name, parts) for name in (SCRIPTS if not parts else (*SCRIPTS[:-1], "parts.js", SCRIPTS[-1])))),
    )


def packed(field: BakedField, tour: Tour) -> tuple[dict[str, Any], bytes]:
    """What the scripts need to know, and the arrays one after the other."""
    small, large = decoder_blocks(field)
    bits, keys, values = corner_arrays(field)
    given: list[tuple[str, Array]] = [
        bits,
        keys,
        ("bricks", field.arrays.bricks),
        values,
        ("thickness", field.arrays.thickness.astype("<f4")),
        ("small", small.astype("<f4")),
        ("large", large.astype("<f4")),
        ("palette", _palette()),
    ]
    arrays, blob = joined(given)
    return {**_about(field, tour), "arrays": arrays}, blob


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


def _script(name: str, parts: bool) -> str:
    """A script or shader; lines between `//% if parts` and `//% endif` are only in pages of fields in parts."""
    environment = Environment(
        *("/*%", "%*/", "/*=", "=*/", "/*#", "#*/"),  # braces are the scripts' own
        line_statement_prefix="//%",
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    return environment.from_string(_source(name)).render(parts=parts)


def _source(name: str) -> str:
    return resources.files("fieldfuse.export").joinpath("web", name).read_text(encoding="utf-8")
