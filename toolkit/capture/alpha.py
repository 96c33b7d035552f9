"""Whether alpha cuts an object out of a capture's pictures. Screenshots and many programs' PNGs have an alpha that is full everywhere: such
pictures are like any others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fieldfuse.capture.images import see_through
from fieldfuse.capture.listing import picture_header
from fieldfuse.capture.types import Frame
from fieldfuse.errors import InputError

HEADERS, PICTURES = 100, 5  # looked at at most, evenly spread: decoding all of a large capture would take minutes


def cut_out(frames: Sequence[Frame]) -> bool:
    """Whether some pixel of the pictures looked at is not opaque. What cannot be read is left to whoever reads it all."""
    paths = [frame.image for frame in frames if frame.video_index is None]
    with_alpha = [path for path in _spread(paths, HEADERS) if _tells(_has_alpha, path)]
    return any(_tells(see_through, path) for path in _spread(with_alpha, PICTURES))


def _has_alpha(path: Path) -> bool:
    return picture_header(path).alpha


def _tells(question: Callable[[Path], bool], path: Path) -> bool:
    try:
        return question(path)
    except InputError:
        return False


def _spread(paths: list[Path], most: int) -> list[Path]:
    return [paths[int(place)] for place in np.unique(np.linspace(0, len(paths) - 1, most).round())] if paths else []
