"""Colours by number (ITU-T H.273): what PNG's chunk cICP and HEIF's box nclx say instead of an ICC profile, put into one."""

from __future__ import annotations

import functools
import struct

import numpy as np

from fieldfuse.camera import Array

# Chromaticities of red, green and blue, by their number; the white is D65. What is BT.709's is sRGB already.
PRIMARIES = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),  # BT.2020
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),  # Display P3
}
ORDINARY = (1, 6, 13, 14, 15)  # curves that are shown as sRGB's; not those of high dynamic range
WHITE, CONNECTION = (0.3127, 0.3290), (0.3457, 0.3585)  # D65, and D50, which profiles meet at
CONES = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])  # Bradford's
CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)  # sRGB's, as a parametric curve of the third kind
HEADER, ENTRY = 128, 12  # bytes
PNG_START, CHUNK = 8, 12  # bytes of a PNG's signature, and of a chunk beside its data


@functools.lru_cache(8)
def profile_of(primaries: int, transfer: int) -> bytes | None:
    """An ICC profile (version 4) of these primaries with sRGB's curve; None where that is sRGB, not known, or of high dynamic range."""
    if primaries not in PRIMARIES or transfer not in ORDINARY:
        return None
    rgb = np.stack([_light(place) for place in PRIMARIES[primaries]], axis=1)
    rgb = rgb * np.linalg.solve(rgb, _light(WHITE))  # their sum is the white
    scale = (CONES @ _light(CONNECTION)) / (CONES @ _light(WHITE))
    adapted = np.linalg.solve(CONES, scale[:, None] * (CONES @ rgb))
    text = b"mluc" + struct.pack(">3I2s2sII", 0, 1, 12, b"en", b"US", 4, 28) + "it".encode("utf-16-be")
    tags = {b"desc": text, b"cprt": text, b"wtpt": _xyz(_light(CONNECTION))}
    curve = b"para" + struct.pack(">IHH5i", 0, 3, 0, *(round(65536 * value) for value in CURVE))
    for name, column in zip((b"r", b"g", b"b"), adapted.T, strict=True):
        tags |= {name + b"XYZ": _xyz(column), name + b"TRC": curve}
    return _file(tags)


def png_colours(data: bytes) -> bytes | None:
    """The profile of what a PNG's cICP says, which goes before its other colours; None without one that says anything else than sRGB."""
    at = PNG_START
    while at + CHUNK <= len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        if name == b"cICP" and size == 4 and at + CHUNK + size <= len(data):
            primaries, transfer, matrix, _ = data[at + 8 : at + 12]
            return profile_of(primaries, transfer) if matrix == 0 else None
        if name in (b"IDAT", b"IEND"):
            return None
        at += CHUNK + size
    return None


def heif_colours(box: object) -> bytes | None:
    """The same of HEIF's box nclx, as `pillow_heif` tells of it."""
    if not isinstance(box, dict):
        return None
    primaries, transfer = box.get("color_primaries"), box.get("transfer_characteristics")
    return profile_of(primaries, transfer) if isinstance(primaries, int) and isinstance(transfer, int) else None


def _light(place: tuple[float, float]) -> Array:
    """Chromaticity → XYZ with Y = 1."""
    x, y = place
    return np.array([x, y, 1 - x - y]) / y


def _xyz(values: Array) -> bytes:
    return b"XYZ " + struct.pack(">I3i", 0, *(round(65536 * float(value)) for value in values))


def _file(tags: dict[bytes, bytes]) -> bytes:
    """A profile for screens, from RGB to XYZ, with these tags."""
    table, body = struct.pack(">I", len(tags)), b""
    first = HEADER + len(table) + ENTRY * len(tags)
    for name, value in tags.items():
        table += struct.pack(">4sII", name, first + len(body), len(value))
        body += value + bytes(-len(value) % 4)
    version, made = 0x04300000, (2026, 1, 1, 0, 0, 0)
    head = struct.pack(">I4sI4s4s4s6H4s", first + len(body), b"", version, b"mntr", b"RGB ", b"XYZ ", *made, b"acsp")
    return head.ljust(68, b"\0") + _xyz(_light(CONNECTION))[8:] + bytes(HEADER - 80) + table + body
