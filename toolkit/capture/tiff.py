"""What the first directory of a TIFF says (TIFF 6.0, section 2; BigTIFF alike), for what Pillow and OpenCV leave out.

Pillow opens no images of 32-bit floating-point colours, and both turn pixels by the orientation tag on their own, whatever they are asked
for. So the orientation is read here, and taken out of what they are given.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

WIDTH, HEIGHT, BITS, ORIENTATION, SAMPLES, MAXIMUM, EXTRA, FORMAT, PROFILE = 256, 257, 258, 274, 277, 281, 338, 339, 34675
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 6: 1, 7: 1, 8: 2, 9: 4, 13: 4, 16: 8, 17: 8, 18: 8}  # bytes of a value, by type
NUMBERS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q"}
MOST_ENTRIES = 4096
MOST_BYTES = 2**24  # of one entry


@dataclass(frozen=True)
class Tiff:
    """The first image of a TIFF, as stored."""

    width: int
    height: int
    bits: int  # of a sample
    floating: bool  # whether samples are floating-point numbers
    samples: int  # a pixel
    orientation: int  # 1 to 8
    alpha: bool
    maximum: int | None  # largest value that samples have, where the file says so
    profile: bytes | None
    turned_at: int | None  # where the orientation stands in the file
    order: str  # of bytes, as `struct` names it


def is_tiff(data: bytes) -> bool:
    return data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def read_tiff(data: bytes) -> Tiff | None:
    """The first directory; None where it is damaged, or there is none."""
    if not is_tiff(data):
        return None
    order, big = "<" if data[:2] == b"II" else ">", data[2:4] in (b"+\0", b"\0+")
    try:
        entries = _entries(data, order, big)
        width, height = (_numbers(data, order, entries[tag])[0] for tag in (WIDTH, HEIGHT))
        tags = (BITS, ORIENTATION, SAMPLES, MAXIMUM, EXTRA, FORMAT)
        values = {tag: _numbers(data, order, entries[tag]) for tag in tags if tag in entries}
        profile = _bytes(data, entries[PROFILE]) if PROFILE in entries else None
    except (struct.error, KeyError, IndexError, ValueError):
        return None
    orientation = values.get(ORIENTATION, (1,))[0]
    return Tiff(
        width=width,
        height=height,
        bits=max(values.get(BITS, (1,))),
        floating=3 in values.get(FORMAT, ()),
        samples=values.get(SAMPLES, (1,))[0],
        orientation=orientation if 1 <= orientation <= 8 else 1,
        alpha=any(kind in (1, 2) for kind in values.get(EXTRA, ())),
        maximum=max(values[MAXIMUM]) if values.get(MAXIMUM) else None,
        profile=profile,
        turned_at=entries[ORIENTATION][2] if ORIENTATION in entries else None,
        order=order,
    )


def unturned(data: bytes) -> bytes:
    """The file with its orientation taken out, so that whatever decodes it leaves the pixels as they are stored."""
    found = read_tiff(data) if is_tiff(data) else None
    if found is None or found.turned_at is None or found.orientation == 1:
        return data
    at = found.turned_at
    return data[:at] + struct.pack(found.order + "H", 1) + data[at + 2 :]


def _entries(data: bytes, order: str, big: bool) -> dict[int, tuple[int, int, int]]:
    """Type, number of values and place of each tag of the first directory."""
    start = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    count = struct.unpack_from(order + ("Q" if big else "H"), data, start)[0]
    if count > MOST_ENTRIES:
        raise ValueError("too many entries")
    first, step, inline = (start + 8, 20, 8) if big else (start + 2, 12, 4)
    out = {}
    for at in range(first, first + step * count, step):
        tag, kind = struct.unpack_from(order + "HH", data, at)
        number = struct.unpack_from(order + ("Q" if big else "I"), data, at + 4)[0]
        value = at + step - inline
        if SIZES.get(kind, 8) * number > inline:
            value = struct.unpack_from(order + ("Q" if big else "I"), data, value)[0]
        out[tag] = (kind, number, value)
    return out


def _numbers(data: bytes, order: str, entry: tuple[int, int, int]) -> tuple[int, ...]:
    kind, number, at = entry
    if not 1 <= number <= 64:
        raise ValueError("no numbers, or too many")
    return struct.unpack_from(f"{order}{number}{NUMBERS[kind]}", data, at)


def _bytes(data: bytes, entry: tuple[int, int, int]) -> bytes | None:
    _, number, at = entry
    return data[at : at + number] if number <= MOST_BYTES and at + number <= len(data) else None
