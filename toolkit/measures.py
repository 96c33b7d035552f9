"""What a user states about lengths: the unit of stored depth, measured distances between marked points, markers of known size."""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass

from fieldfuse.errors import InputError, brief

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "µm": 1e-6, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
LENGTH = re.compile(rf"\s*({NUMBER})\s*(?:/\s*({NUMBER}))?\s*([a-zµ]*)\s*")
MARK = re.compile(rf"\s*(\S.*?):\s*({NUMBER})\s*,\s*({NUMBER})(?=\s|$)")
SHORTEST, LONGEST = 1e-7, 1e6  # metres
MOST_TEXT, MOST_MARKS = 100_000, 1000  # characters, marks of one measurement
MOST_SQUARES = 100  # a side of a board
SCALE_FORM = (
    'it is "IMAGE:x,y IMAGE:x,y = LENGTH" for the distance of two marked points, or "MARKS to MARKS = LENGTH" with each point marked in '
    'two images or more, as in "IMG_1:812,330 IMG_2:790,335 to IMG_1:1204,341 IMG_2:1180,344 = 1.20"'
)
MARKER_FORM = (
    'it is "DICTIONARY:SIDE" for ArUco markers, as DICT_4X4_50:0.05, or "charuco:DICTIONARY:COLUMNSxROWS:SQUARE:MARKER" for a board, as '
    "charuco:DICT_5X5_100:7x5:0.04:0.03; lengths are metres"
)


def length(text: str | float) -> float:
    """Metres of a length such as `1.2`, `120cm`, `0.25 mm` or `1/5000 m`; without a unit it is metres.

    Raises:
        InputError: it is none, or not one between a ten-thousandth of a millimetre and a thousand kilometres.
    """
    found = LENGTH.fullmatch(str(text))
    unit = METRES.get(found[3] or "m") if found else None
    try:
        value = float(found[1]) / float(found[2] or 1) * unit if found and unit else math.nan
    except ZeroDivisionError:
        value = math.nan
    if math.isnan(value):
        raise InputError(f"{brief(repr(text))} is no length; give a number of metres, or one with its unit ({', '.join(METRES)})")
    if not SHORTEST <= value <= LONGEST:
        raise InputError(f"{brief(repr(text))} is no length that can be; it must be positive and at most {LONGEST / 1000:g} km")
    return value


def stored_per_metre(text: str | float) -> float:
    """Stored depth values to a metre: a plain number is that (1000: millimetres), a length (`0.25mm`) is what one stored value stands for.

    Raises:
        InputError: it is neither.
    """
    try:
        plain = float(text)
    except ValueError:
        return 1 / length(text)
    if not (math.isfinite(plain) and 1 / LONGEST <= plain <= 1 / SHORTEST):
        raise InputError(f"{brief(repr(text))} stored values to a metre cannot be; give 1000 for millimetres, 5000 for TUM's, or as 0.25mm")
    return plain


@dataclass(frozen=True)
class Mark:
    """A point marked in an image."""

    image: str  # name or file name
    x: float  # pixels from the upright image's upper left corner, as viewers show it at full size
    y: float


@dataclass(frozen=True)
class Measurement:
    """Two points, each by its marks in one image or more, and their distance."""

    first: tuple[Mark, ...]
    second: tuple[Mark, ...]
    metres: float


def parse_scale(text: str) -> list[Measurement]:
    """Measured distances, separated by semicolons; see `SCALE_FORM`.

    Raises:
        InputError: the text is not of that form.
    """
    if len(text) > MOST_TEXT:
        raise InputError(f"scale has {len(text)} characters, more than {MOST_TEXT}; give fewer measurements")
    found = []
    for part in (part for part in text.split(";") if part.strip()):
        points, equals, value = part.rpartition("=")
        if not equals:
            raise InputError(f"scale {brief(repr(part.strip()))} has no length after a `=`; {SCALE_FORM}")
        sides = re.split(r"\sto\s", f" {points} ")
        marks = [_marks(side) for side in sides]
        if len(sides) == 1 and len(marks[0]) == 2:
            marks = [marks[0][:1], marks[0][1:]]
        if len(marks) != 2:
            many = f"has {len(marks[0])} marks" if len(sides) == 1 else f"has {len(sides)} points"
            raise InputError(f"scale {brief(repr(part.strip()))} {many}; {SCALE_FORM}")
        for side in marks:
            if len({mark.image for mark in side}) < len(side):
                raise InputError(f"scale {brief(repr(part.strip()))} marks one point twice in {side[0].image}; {SCALE_FORM}")
        if marks[0] == marks[1]:
            raise InputError(f"scale {brief(repr(part.strip()))} marks the same place twice, which is no distance; {SCALE_FORM}")
        found.append(Measurement(marks[0], marks[1], length(value.strip())))
    if not found:
        raise InputError(f"scale holds no measurement; {SCALE_FORM}")
    return found


def _marks(text: str) -> tuple[Mark, ...]:
    """The marks of one point."""
    marks, end = [], 0
    while (match := MARK.match(text, end)) is not None:
        x, y = float(match[2]), float(match[3])
        if not (abs(x) < 1e6 and abs(y) < 1e6):
            raise InputError(f"scale marks {match[2]},{match[3]} in {match[1]}, which lies in no image; {SCALE_FORM}")
        marks.append(Mark(match[1], x, y))
        end = match.end()
        if len(marks) > MOST_MARKS:
            raise InputError(f"scale marks a point in more than {MOST_MARKS} images; give fewer")
    if text[end:].strip() or not marks:
        raise InputError(f"scale cannot be read at {brief(repr(text[end:].strip()))}; {SCALE_FORM}")
    return tuple(marks)


@dataclass(frozen=True)
class Marker:
    """ArUco markers of one size, or a ChArUco board."""

    dictionary: str  # as OpenCV names it
    side: float  # metres, of a marker, its black border included
    squares: tuple[int, int] | None = None  # columns and rows of a board; None: single markers
    square: float = 0.0  # metres, of a board's square


def parse_marker(text: str) -> Marker:
    """Markers whose size is known; see `MARKER_FORM`.

    Raises:
        InputError: the text is not of that form, or there is no such dictionary.
    """
    parts = [part.strip() for part in text[:MOST_TEXT].split(":")]
    board = parts[0].lower() == "charuco"
    if len(parts) != (5 if board else 2):
        raise InputError(f"marker {brief(repr(text))} is not understood; {MARKER_FORM}")
    dictionary = _dictionary(parts[1 if board else 0])
    if not board:
        return Marker(dictionary, length(parts[1]))
    size = re.fullmatch(r"(\d{1,4})\s*[x×]\s*(\d{1,4})", parts[2])
    columns, rows = (int(size[1]), int(size[2])) if size else (0, 0)
    square, side = length(parts[3]), length(parts[4])
    if not (2 <= columns <= MOST_SQUARES and 2 <= rows <= MOST_SQUARES and side < square):
        most = f"2 to {MOST_SQUARES} squares a side, larger than its markers"
        raise InputError(f"marker {brief(repr(text))} is no board, which has {most}; {MARKER_FORM}")
    return Marker(dictionary, side, (columns, rows), square)


def _dictionary(name: str) -> str:
    import cv2

    known = {one.upper(): one for one in dir(cv2.aruco) if one.startswith("DICT_")}
    wanted = name.upper() if name.upper().startswith("DICT_") else f"DICT_{name.upper()}"
    if wanted not in known:
        near = difflib.get_close_matches(wanted, known, n=1)
        meant = f" (did you mean {known[near[0]]}?)" if near else ""
        raise InputError(f"marker: there is no dictionary {brief(repr(name))}{meant}; {MARKER_FORM}")
    return known[wanted]
