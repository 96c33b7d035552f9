"""OpenEXR images (https://openexr.com/en/latest/TechnicalIntroduction.html), read by the package OpenEXR (BSD), which is imported with the
first such file. Colours are linear light and multiplied by their alpha; depth comes from renderers and phones, often as channel Z.
"""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.archive import read_bytes
from fieldfuse.errors import InputError
from fieldfuse.extras import extra

SUFFIX = ".exr"
FORMAT = "EXR"
MAGIC = b"\x76\x2f\x31\x01"
HEAD_BYTES = 2**20  # of a file, in which its headers end
MOST_BYTES = 2**30  # of all channels together, which the package decodes at once
MOST_SIDE = 2**20  # pixels; windows are signed 32-bit numbers
FAR = 1e9  # depth from here on is nothing: Blender writes 1e10 where no surface is
DEPTH_NAMES = ("z", "depth", "distance")
COLOURS, GREY = ("r", "g", "b"), ("y", "v", "grey", "gray", "luminance")
SRGB = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]])  # red, green, blue, white
_printing = threading.Lock()  # stdout is the whole process's


@dataclass(frozen=True)
class ExrHeader:
    """What is read of an EXR file. `size` is that of its display window: what lies outside is cut off, what is not stored there is 0."""

    size: tuple[int, int]  # width, height
    part: int
    names: dict[str, str]  # "r", "g", "b", "a" or "grey" or "depth" → name of the channel


def read_exr(path: Path, *, depth: bool = False) -> Array:
    """The image in an OpenEXR file, float32: (H, W, 3) RGB, (H, W, 4) RGBA (premultiplied), or (H, W) of one channel. Values are as stored;
    colours of other primaries than sRGB's become those of sRGB.

    With `depth` always (H, W): the channel named Z or depth, else the only one, else that of three equal ones (a grey map saved in
    colour); 0 where nothing is (`FAR`, infinite, not a number).

    Raises:
        InputError: missing, damaged, deep or too large; without such channels; or the package OpenEXR is not installed.
    """
    data = read_bytes(path)
    header = exr_header(data, path, depth=depth)
    with _reported(path):
        part = package(path).File(io.BytesIO(data), separate_channels=True).parts[header.part]
        found = {key: np.asarray(part.channels[name].pixels) for key, name in header.names.items()}
        (left, top), (right, bottom) = (np.asarray(corner).tolist() for corner in part.header["dataWindow"])
        (x, y), _ = (np.asarray(corner).tolist() for corner in part.header["displayWindow"])
        chromaticities = part.header.get("chromaticities")
    if any(plane.shape != (bottom - top + 1, right - left + 1) for plane in found.values()):
        raise InputError(f"{path} is an OpenEXR file whose channels differ in size; save it anew, with all of one size")
    width, height = header.size
    out = np.zeros((height, width, len(found)), np.float32)
    rows, columns = slice(max(0, top - y), max(0, bottom + 1 - y)), slice(max(0, left - x), max(0, right + 1 - x))
    inside = out[rows, columns]
    for index, plane in enumerate(found.values()):
        inside[..., index] = plane[max(0, y - top) :, max(0, x - left) :][: inside.shape[0], : inside.shape[1]]
    if depth:
        return _one_map(out, path)
    if len(found) < 3:
        return out[..., 0]
    if (matrix := _to_srgb(chromaticities)) is not None:
        out[..., :3] = out[..., :3] @ matrix.T
    return out


def exr_header(data: bytes, path: Path, *, depth: bool | None = None) -> ExrHeader:
    """The header of the OpenEXR file `path`, which begins with `data`; of several parts, that of the first with the channels wanted:
    an image, `depth`, or (None) the former if there is one.

    Raises:
        InputError: as `read_exr`.
    """
    with _reported(path):
        headers = [part.header for part in package(path).File(io.BytesIO(data), separate_channels=True, header_only=True).parts]
        names = [[str(channel.name) for channel in header["channels"]] for header in headers]
        windows = [np.asarray(header[name], dtype=np.int64) for header in headers for name in ("displayWindow", "dataWindow")]
        deep = any("deep" in str(header.get("type", "")) for header in headers)
    sides = [high - low + 1 for low, high in windows]
    if any((side < 1).any() or (side > MOST_SIDE).any() for side in sides):
        raise InputError(f"{path} is an OpenEXR file of an impossible size; save it anew")
    if sum(int(np.prod(side)) * len(of) * 4 for side, of in zip(sides[1::2], names, strict=True)) > MOST_BYTES:
        raise InputError(f"{path} is an OpenEXR file of more than {MOST_BYTES // 2**30} GB of values; make it smaller")
    if deep:
        raise InputError(f"{path} is a deep OpenEXR file (many values a pixel), which is not read; save it flattened")
    for choose in [_colours_of] * (not depth) + [_depth_of] * (depth is not False):
        for index, channels in enumerate(names):
            if found := choose(channels):
                width, height = (int(side) for side in sides[2 * index])
                return ExrHeader((width, height), index, found)
    held = ", ".join(sorted({name for of in names for name in of})[:6])
    wanted = "no depth (a channel Z, or one alone)" if depth else "no image (channels R, G and B, or one alone)"
    raise InputError(f"{path} is an OpenEXR file with {wanted}; it has {held or 'no channels'}")


def exr_head(path: Path) -> ExrHeader:
    """The header of an OpenEXR file, with little of it read.

    Raises:
        InputError: as `read_exr`.
    """
    try:
        with path.open("rb") as file:
            data = file.read(HEAD_BYTES)
    except OSError:
        data = read_bytes(path)  # a zip file's member, or it says what is wrong
    return exr_header(data, path)


def _colours_of(channels: list[str]) -> dict[str, str]:
    """Channels of one layer: that without a name, else one named Combined (Blender's), else the first."""
    layers: dict[str, dict[str, str]] = {}
    for name in channels:
        layer, _, last = name.rpartition(".")
        layers.setdefault(layer, {}).setdefault(last.lower(), name)
    for layer in sorted(layers, key=lambda layer: (layer != "", "combined" not in layer.lower())):
        if all(colour in layers[layer] for colour in COLOURS):
            return {key: layers[layer][key] for key in (*COLOURS, "a") if key in layers[layer]}
    for of in layers.values():
        if grey := next((name for name in GREY if name in of and len(of) - ("a" in of) == 1), None):
            return {"grey": of[grey]}
    return {"grey": channels[0]} if len(channels) == 1 else {}


def _depth_of(channels: list[str]) -> dict[str, str]:
    if named := sorted(filter(_is_depth, channels), key=len):
        return {"depth": named[0]}
    return {"depth": channels[0]} if len(channels) == 1 else {key: name for key, name in _colours_of(channels).items() if key != "a"}


def _is_depth(name: str) -> bool:
    return any(part in DEPTH_NAMES for part in name.lower().split(".")[-2:])


def _to_srgb(chromaticities: Any) -> Array | None:
    """(3, 3) float32: linear colours of a file's primaries and white (CIE xy) → sRGB's; None where they are these already, or no colours.
    White is not adapted, as in OpenEXR's own conversions."""
    try:
        xy = np.array(chromaticities, dtype=np.float64).reshape(4, 2)
        if not np.isfinite(xy).all() or np.abs(xy - SRGB).max() < 1e-3:
            return None
        matrix = np.linalg.inv(_to_xyz(SRGB)) @ _to_xyz(xy)
    except (TypeError, ValueError, np.linalg.LinAlgError, FloatingPointError):
        return None
    return matrix.astype(np.float32) if np.isfinite(matrix).all() and np.abs(matrix).max() < 100 else None


def _to_xyz(xy: Array) -> Array:
    """(3, 3): linear red, green and blue of these primaries → CIE XYZ, with Y = 1 for white."""
    primaries = np.column_stack([xy, 1 - xy.sum(axis=1)]).T
    with np.errstate(divide="raise", invalid="raise"):
        white = primaries[:, 3] / primaries[1, 3]
    return np.asarray(primaries[:, :3] * np.linalg.solve(primaries[:, :3], white))


def _one_map(stored: Array, path: Path) -> Array:
    plane = stored[..., 0]
    if any(not np.array_equal(plane, stored[..., index], equal_nan=True) for index in range(1, stored.shape[2])):
        raise InputError(f"{path} holds a coloured image where depth is expected; save depth as one channel (Z), not as colours")
    return np.where(np.isfinite(plane) & (plane < FAR), plane, np.float32(0))


def package(path: Path) -> Any:
    """The package that reads OpenEXR, for `path`."""
    otherwise = ", or write depth as 16-bit PNG in millimetres or as float .npy, and images as PNG or TIFF"
    return extra("exr", "OpenEXR", f"{path} is OpenEXR, which", otherwise)


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """What OpenEXR raises on damaged files, as one sentence. It also prints a warning, which would stand among results on stdout."""
    with _printing:
        try:
            with redirect_stdout(io.StringIO()):
                yield
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{path} (OpenEXR) is damaged or cut short, so it cannot be decoded; copy or save it again") from error
