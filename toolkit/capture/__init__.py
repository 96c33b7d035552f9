"""Captures: one reader a source kind, one file each, all returning a `Capture` of `Frame`s.

Whatever is wrong with a file raises `InputError`, with one sentence that names it and what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from fieldfuse.capture.types import Capture, Frame, Views

__all__ = ["Capture", "Frame", "Views", "open_capture"]


def open_capture(
    source: Path | str, masks: str = "auto", choose: Callable[[Sequence[Capture]], int] | None = None, projection: str = "auto"
) -> Capture:
    """The capture at `source`: a video, a folder of a known layout, a `.sens` file, or one of a layout's JSON files. Found by looking.

    Args:
        masks: how masks beside the images are read: auto (black is excluded) | inverted | off.
        projection: what the images are (`panorama.with_projection`).
        choose: which of the captures that several COLMAP models make is the right one; None: the one that most images fit by name and size.

    Only listings, metadata and image headers are read; pixels are decoded of a video's first frame, and of a few images with
    alpha, or twice as wide as high.

    Raises:
        InputError: nothing there, nothing known, or the layout's own files are broken.
    """
    # Imported late: training and rendering need the types above on machines without Pillow.
    from fieldfuse.capture.colmap import model_captures
    from fieldfuse.capture.detect import read_source
    from fieldfuse.capture.masks import with_masks
    from fieldfuse.capture.panorama import with_projection
    from fieldfuse.capture.photos import with_remark
    from fieldfuse.capture.poses import lenient_poses
    from fieldfuse.capture.usable import turned_by_exif, with_usable_poses

    with lenient_poses() as notes:
        capture = read_source(Path(source))
        if choose is not None and len(others := model_captures(capture)) > 1 and (best := choose(others)) > 0:
            remark = "of several COLMAP models the one is used whose poses fit the images best"
            capture = others[best].with_frames(others[best].frames, remark)
        capture = with_usable_poses(capture, notes)
        return with_projection(with_remark(with_masks(turned_by_exif(capture), masks)), projection)
