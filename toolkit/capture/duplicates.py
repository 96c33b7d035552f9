"""Images of a capture that are there twice: as JPEG and as PNG, saved again in another size, copied under another name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Frame

# Saved again (a quarter of the size, JPEG of quality 30), images differ by up to 1.3 grey levels on average and 14 at most, at 48 × 48;
# neighbours of eight captures by at least 6.6 and 83.
MEAN_DIFFERENCE, MAX_DIFFERENCE = 2.0, 24.0
CONTRAST = 40.0  # grey levels of standard deviation; of images of less, the limits are less in proportion
COPIED = re.compile(r"(([ _-]*\([0-9]{1,3}\))|([ _-]+(copy|kopie|copie|copia)([ _-]*[0-9]{1,3})?))+$")  # what programs add to a copy's name


def suspects(frames: Sequence[Frame]) -> set[int]:
    """Indices of frames whose files' names say that they may be copies: `IMG_1.png` and `IMG_1 (1).jpg` beside `IMG_1.jpg`."""
    names = [(frame.image.parent, COPIED.sub("", frame.image.stem.lower())) for frame in frames]
    often = Counter(names)
    return {index for index, name in enumerate(names) if often[name] > 1}


def copies(tiny: Sequence[Array], sizes: Sequence[int], names: Sequence[str]) -> dict[int, int]:
    """Index of an image that shows the same as another → that other one: the larger, then the one with the shorter name.

    Args:
        tiny: (48, 48) float32 grey each.
        sizes: pixels of the images as stored.
    """
    order = sorted(range(len(tiny)), key=lambda index: (-sizes[index], len(names[index]), index))
    flat = np.array([tiny[index].ravel() for index in order], dtype=np.float32).reshape(len(order), -1)
    means = flat.mean(axis=1)
    contrast = np.minimum(1.0, flat.std(axis=1) / CONTRAST)
    out: dict[int, int] = {}
    stays = np.ones(len(order), dtype=bool)
    for place in range(1, len(order)):
        near = np.flatnonzero(stays[:place] & (np.abs(means[:place] - means[place]) < MEAN_DIFFERENCE))
        if len(near):
            off = np.abs(flat[near] - flat[place])
            same = (off.mean(axis=1) < MEAN_DIFFERENCE * contrast[place]) & (off.max(axis=1) < MAX_DIFFERENCE * contrast[place])
            if same.any():
                out[order[place]] = order[int(near[np.argmax(same)])]
                stays[place] = False
    return out
