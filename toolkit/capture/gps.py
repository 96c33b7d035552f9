"""Where images were taken, by the GPS part of their EXIF, and the height over the start that DJI's drones write into XMP.

EXIF 2.32 (CIPA DC-008), tags 0 to 6 of the GPS directory; `drone-dji:` as DJI's aircraft write it. Nothing is parsed as XML.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.capture.heif import file_is_heif, register

GPS_FOLDER = 0x8825
NORTH_REF, NORTH, EAST_REF, EAST, UP_REF, UP = 1, 2, 3, 4, 5, 6
HEIGHT = re.compile(rb"drone-dji:RelativeAltitude\s{0,4}(?:=\s{0,4}[\"']|>)\s{0,4}([+-]?\d{1,6}(?:\.\d{1,9})?)")
ABSOLUTE = re.compile(rb"drone-dji:AbsoluteAltitude\s{0,4}(?:=\s{0,4}[\"']|>)\s{0,4}([+-]?\d{1,6}(?:\.\d{1,9})?)")
MOST_XMP = 2**20  # bytes that are looked through
DEEPEST, HIGHEST = -1000.0, 100_000.0  # metres that an altitude can be


def gps_of(path: Path) -> tuple[Array, float | None] | None:
    """(3,) degrees north, degrees east (WGS 84) and metres of altitude (NaN: not given) of an image, and its height over the drone's start
    (None: not given); None where EXIF has no believable place. 0° north, 0° east is what programs write that know none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if file_is_heif(path):
                register(path)
            with Image.open(path) as image:
                tags = dict(image.getexif().get_ifd(GPS_FOLDER))
                xmp = image.info.get("xmp") if tags else None
        north, east = _degrees(tags.get(NORTH), tags.get(NORTH_REF), "S"), _degrees(tags.get(EAST), tags.get(EAST_REF), "W")
        up = float(tags[UP]) if UP in tags else math.nan
        below = tags.get(UP_REF) in (1, b"\x01")
    except Exception:  # Pillow raises many families, and what stands there is anybody's
        return None
    if not (abs(north) <= 90 and abs(east) <= 180) or (north == 0 and east == 0):
        return None
    xmp = xmp[:MOST_XMP] if isinstance(xmp, bytes) else b""
    absolute, height = (float(match[1]) if (match := pattern.search(xmp)) else None for pattern in (ABSOLUTE, HEIGHT))
    up = -up if below else up
    up = absolute if absolute is not None and not math.isfinite(up) else up
    return np.array([north, east, up if DEEPEST <= up <= HIGHEST else math.nan]), height


def _degrees(value: Any, side: Any, negative: str) -> float:
    """Degrees, minutes and seconds → degrees; NaN where they are none."""
    parts = [float(part) for part in value] if isinstance(value, Sequence) and not isinstance(value, (str, bytes)) else []
    if not 1 <= len(parts) <= 3 or not all(math.isfinite(part) for part in parts):
        return math.nan
    degrees = sum(part / 60**at for at, part in enumerate(parts))
    return -degrees if str(side).strip("\x00 ").upper() == negative else degrees


def gps_of_images(paths: Sequence[Path]) -> Array:
    """(N, 3) degrees north, degrees east, metres of altitude; NaN where an image has none.

    Where all images with GPS have a drone's height over its start, differences of altitude are that height's, which its barometer
    measures several times as well as GPS does; the mean altitude stays that of GPS.
    """
    found = [gps_of(path) for path in paths]
    places = np.array([np.full(3, np.nan) if one is None else one[0] for one in found]).reshape(-1, 3)
    heights = np.array([np.nan if one is None or one[1] is None else one[1] for one in found])
    there = np.isfinite(places).all(axis=1)
    if there.any() and np.isfinite(heights[there]).all():
        places[there, 2] = heights[there] + np.mean(places[there, 2] - heights[there])
    return places
