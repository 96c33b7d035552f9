"""Captures: one reader a source kind, one file each, all returning a `Capture` of `Frame`s."""

from __future__ import annotations

from pathlib import Path

from toolkit.capture.types import Capture, Frame, Views

__all__ = ["Capture", "Frame", "Views", "open_capture"]


def open_capture(source: Path | str, masks: str = "auto") -> Capture:
    """The capture at `source`: a video, a folder of a known layout, a `.sens` file, or one of a layout's JSON files. Found by looking.

    Args:
        masks: what masks beside the images mean: auto (black is left out) | inverted | off.

    Only listings, metadata and picture headers are read; pixels are decoded of a video's first frame, and of a few pictures with alpha.

    Raises:
        InputError: nothing there, nothing known, or the layout's own files are broken.
    """
    # Imported late: training and rendering need the types above on machines without Pillow.
    from toolkit.camera import lenient_poses
    from toolkit.capture.beside import with_remark
    from toolkit.capture.detect import read_source
    from toolkit.capture.masks import with_masks
    from toolkit.capture.usable import turned_by_exif, with_usable_poses

    with lenient_poses() as notes:
        capture = with_usable_poses(read_source(Path(source)), notes)
        return with_remark(with_masks(turned_by_exif(capture), masks))
