"""Colour profiles of images, and the way to sRGB. Phones store Display P3, cameras at times Adobe RGB: taken for sRGB, both look dull.

A profile is ICC, or numbers (ITU-T H.273) in PNG's chunk cICP or HEIF's box nclx, from which an ICC profile is made.
"""

from __future__ import annotations

import functools
import io
import struct
import threading
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageCms

from fieldfuse.camera import Array

MOST_BYTES = 2**20  # of a profile; those of cameras have a few hundred, scanners' with tables some hundred thousand
ROWS = 256  # of an image that are converted at a time: few enough to stay in the cache
SAME = 1  # levels of 255 by which a profile that is sRGB in other words may differ
D50 = (63196, 65536, 54074)  # XYZ, here and below in units of 1/65536
PRIMARIES = {  # XYZ of red, green and blue, adapted to D50 (Bradford), by their number in H.273; 1 is sRGB itself
    9: ((44140, 18288, -127), (10859, 44258, 1965), (8197, 2990, 52236)),  # BT.2020
    12: ((33761, 15807, -69), (19137, 45365, 2745), (10298, 4363, 51398)),  # Display P3
}
ORDINARY = (1, 6, 13, 14, 15)  # curves that are shown as sRGB's; not those of high dynamic range
CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)  # sRGB's, as a parametric curve of the third kind
_lock = threading.Lock()


def to_srgb(image: Array, profile: bytes | None) -> Array:
    """An image (H, W, 3) or (H, W, 4) uint8 RGB(A) with this ICC profile → the same in sRGB, clipped to what sRGB can show.

    Without a profile, with a damaged one, one that is not of RGB, or one that is sRGB already, it is returned as it is.
    """
    if profile is None or len(profile) > MOST_BYTES:
        return image
    with _lock:  # of many threads with the same profile at once, one makes the conversion
        convert = _conversion(profile)
    if convert is None:
        return image
    out = np.array(image)
    for top in range(0, len(out), ROWS):
        convert(out[top : top + ROWS])
    return out


@functools.lru_cache(16)
def _conversion(profile: bytes) -> Callable[[Array], None] | None:
    """What converts (h, w, 3 or 4) uint8 in place; None where nothing is to be done, or the profile is not usable."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return None
        target = ImageCms.createProfile("sRGB")
        way = ImageCms.buildTransform(source, target, "RGB", "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, ImportError, OSError, ValueError, TypeError, AttributeError):  # ImportError: a Pillow without Little CMS
        return None

    def convert(rows: Array) -> None:
        image = Image.fromarray(np.ascontiguousarray(rows[..., :3]))
        ImageCms.applyTransform(image, way, inPlace=True)
        rows[..., :3] = np.asarray(image)

    steps = np.linspace(0, 255, 9).round().astype(np.uint8)
    before = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(9, 81, 3)
    after = before.copy()
    convert(after)
    return convert if int(np.abs(after.astype(int) - before).max()) > SAME else None


def is_linear(profile: bytes | None) -> bool | None:
    """Whether an ICC profile's curve for green is a straight line; None without a profile or such a curve (ICC.1:2022, 10.6 and 10.18)."""
    if profile is None or not 132 <= len(profile) <= MOST_BYTES:
        return None
    for index in range(min(struct.unpack_from(">I", profile, 128)[0], 100, (len(profile) - 132) // 12)):
        name, at, size = struct.unpack_from(">4sII", profile, 132 + 12 * index)
        if name == b"gTRC" and size >= 12 and at + size <= len(profile):
            kind, count = struct.unpack_from(">4s4xI", profile, at)
            if kind == b"curv":
                return count == 0 or (count == 1 and size >= 14 and profile[at + 12 : at + 14] == b"\1\0")
            return kind == b"para" and size >= 16 and profile[at + 8 : at + 10] == b"\0\0" and profile[at + 12 : at + 16] == b"\0\1\0\0"
    return None


def png_colours(data: bytes) -> bytes | None:
    """The ICC profile of a PNG's cICP, which goes before its other colours; None without one, or where it is sRGB."""
    at = 8
    while at + 12 <= len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        if name == b"cICP" and size == 4 and at + 16 <= len(data):
            primaries, transfer, matrix, _ = data[at + 8 : at + 12]
            return profile_of(primaries, transfer) if matrix == 0 else None
        if name in (b"IDAT", b"IEND"):
            return None
        at += 12 + size
    return None


def profile_of(primaries: object, transfer: object) -> bytes | None:
    """An ICC profile (version 4) of these primaries with sRGB's curve; None where that is sRGB, unknown, or of high dynamic range."""
    if primaries not in PRIMARIES or transfer not in ORDINARY:
        return None
    text = b"mluc" + struct.pack(">3I2s2sII", 0, 1, 12, b"en", b"US", 4, 28) + "it".encode("utf-16-be")
    tags = {b"desc": text, b"cprt": text, b"wtpt": struct.pack(">4sI3i", b"XYZ ", 0, *D50)}
    curve = struct.pack(">4sIHH5i", b"para", 0, 3, 0, *(round(65536 * value) for value in CURVE))
    for name, values in zip((b"r", b"g", b"b"), PRIMARIES[primaries], strict=True):
        tags |= {name + b"XYZ": struct.pack(">4sI3i", b"XYZ ", 0, *values), name + b"TRC": curve}
    table, body = struct.pack(">I", len(tags)), b""
    first = 128 + len(table) + 12 * len(tags)
    for name, value in tags.items():
        table += struct.pack(">4sII", name, first + len(body), len(value))
        body += value + bytes(-len(value) % 4)
    version, made = 0x04300000, (2026, 1, 1, 0, 0, 0)
    head = struct.pack(">I4sI4s4s4s6H4s", first + len(body), b"", version, b"mntr", b"RGB ", b"XYZ ", *made, b"acsp")
    return head.ljust(68, b"\0") + struct.pack(">3i", *D50) + bytes(48) + table + body
