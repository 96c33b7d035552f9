"""Camera raw files as Adobe's DNG (specification 1.4), uncompressed, of a sensor with red, green, green, blue."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array

WHITE = 16383
NEUTRAL = (0.5, 1.0, 0.6)  # what the sensor counts of white light, as shares of green
SRGB_FROM_XYZ = (3.2404542, -1.5371385, -0.4985314, -0.9692660, 1.8760108, 0.0415560, 0.0556434, -0.2040259, 1.0572252)
SIZES = {"B": 1, "H": 2, "I": 4, "s": 1, "R": 8, "r": 8}
CODES = {"B": 1, "s": 2, "H": 3, "I": 4, "R": 5, "r": 10}
FOCAL_35 = 35  # mm, in the EXIF part


def mosaic(light: Array, neutral: tuple[float, float, float] = NEUTRAL) -> Array:
    """(H, W, 3) linear light in [0, 1] → (H, W) uint16, each pixel of one colour, as a sensor counts it that sees white as `neutral`."""
    counted = np.round(light * np.array(neutral) * WHITE).clip(0, WHITE).astype(np.uint16)
    out = counted[..., 1].copy()
    out[0::2, 0::2], out[1::2, 1::2] = counted[0::2, 0::2, 0], counted[1::2, 1::2, 2]
    return out


def write_dng(path: Path, counted: Array, *, orientation: int = 1, neutral: tuple[float, float, float] = NEUTRAL) -> Path:
    """A DNG of what a sensor counted, (H, W) uint16."""
    (height, width), pixels = counted.shape, counted.astype("<u2").tobytes()
    matrix = [number for value in SRGB_FROM_XYZ for number in (round(value * 10000), 10000)]
    whites = [number for value in neutral for number in (round(value * 10000), 10000)]
    tags: list[tuple[int, str, list[int] | bytes]] = [
        *((254, "I", [0]), (256, "I", [width]), (257, "I", [height]), (258, "H", [16]), (259, "H", [1]), (262, "H", [32803])),
        *((271, "s", b"Maker\0"), (272, "s", b"Camera\0"), (273, "I", [0]), (274, "H", [orientation]), (277, "H", [1])),
        *((278, "I", [height]), (279, "I", [len(pixels)]), (284, "H", [1]), (34665, "I", [0])),
        *((33421, "H", [2, 2]), (33422, "B", [0, 1, 1, 2])),
        *((50706, "B", [1, 4, 0, 0]), (50707, "B", [1, 1, 0, 0]), (50708, "s", b"Made\0"), (50714, "H", [0]), (50717, "I", [WHITE])),
        *((50721, "r", matrix), (50728, "R", whites), (50778, "H", [21])),
    ]
    behind = 8 + 2 + 12 * len(tags) + 4
    rows, values, places = b"", b"", {}
    for tag, kind, content in tags:
        if isinstance(content, bytes):
            data, count = content, len(content)
        else:
            data = struct.pack(f"<{len(content)}{ {'R': 'I', 'r': 'i'}.get(kind, kind) }", *content)
            count = len(data) // SIZES[kind]
        places[tag] = 8 + 2 + len(rows) + 8
        if len(data) > 4:
            rows += struct.pack("<HHII", tag, CODES[kind], count, behind + len(values))
            values += data + bytes(len(data) % 2)
        else:
            rows += struct.pack("<HHI", tag, CODES[kind], count) + data.ljust(4, b"\0")
    exif = struct.pack("<HHHIHHI", 1, 0xA405, 3, 1, FOCAL_35, 0, 0)
    out = bytearray(struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + rows + struct.pack("<I", 0) + values)
    for tag, at in ((34665, len(out)), (273, len(out) + len(exif))):
        struct.pack_into("<I", out, places[tag], at)
    path.write_bytes(bytes(out) + exif + pixels)
    return path
