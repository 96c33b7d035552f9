"""Colour profiles of pictures: what phones and cameras say about the numbers they store, and the way to sRGB.

Phones store Display P3, cameras now and then Adobe RGB; both show the same numbers as duller colours to whoever takes them for sRGB. Scores
hardly know the difference, since fields are compared with pictures that were read alike, but what is exported looks other than the photos.
"""

from __future__ import annotations

import functools
import io
import threading
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageCms

from fieldfuse.camera import Array

MOST_BYTES = 2**20  # of a profile; those of cameras have a few hundred, scanners' with tables some hundred thousand
ROWS = 256  # of a picture that are converted at a time: few enough to stay in the cache
SAME = 1  # levels of 255 by which a profile that is sRGB in other words may differ
KEPT = 16  # profiles whose way to sRGB is kept
_lock = threading.Lock()

Convert = Callable[[Array], None]


def to_srgb(picture: Array, profile: bytes | None) -> Array:
    """A picture (H, W, 3) or (H, W, 4) uint8 RGB(A) with this ICC profile → the same in sRGB, clipped to what sRGB can show.

    Without a profile, with one that is damaged or not of RGB, and with one that is sRGB already, it comes back as it is.
    """
    convert = None if profile is None or len(profile) > MOST_BYTES else _conversion(profile)
    if convert is None:
        return picture
    out = np.array(picture)
    for top in range(0, len(out), ROWS):
        convert(out[top : top + ROWS])
    return out


def _conversion(profile: bytes) -> Convert | None:
    with _lock:  # of many threads that come with the same profile at once, one looks into it
        return _made(profile)


@functools.lru_cache(KEPT)
def _made(profile: bytes) -> Convert | None:
    """What converts (h, w, 3 or 4) uint8 in place; None when there is nothing to do, or no way to tell what."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return None
        target = ImageCms.createProfile("sRGB")
        way = ImageCms.buildTransform(source, target, "RGB", "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, ImportError, OSError, ValueError, TypeError, AttributeError):  # ImportError: a Pillow without Little CMS
        return None

    def convert(rows: Array) -> None:
        picture = Image.fromarray(np.ascontiguousarray(rows[..., :3]))
        ImageCms.applyTransform(picture, way, inPlace=True)
        rows[..., :3] = np.asarray(picture)

    steps = np.linspace(0, 255, 9).round().astype(np.uint8)
    before = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(9, 81, 3)
    after = before.copy()
    convert(after)
    return convert if int(np.abs(after.astype(int) - before).max()) > SAME else None
