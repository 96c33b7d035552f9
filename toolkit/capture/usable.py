"""One bad part does not stop a good whole: frames that cannot be used are left out where nearly all others can."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from toolkit.camera import PoseNotes
from toolkit.capture.listing import counted
from toolkit.capture.types import Capture
from toolkit.errors import InputError

MOST_BAD = 0.2  # share of the frames that may be left out; with more of them something is wrong with the capture
LEAST = 3  # frames that have to stay
NAMED = 3  # frames that a remark names


def without(capture: Capture, bad: Mapping[str, str], refusal: str | None = None) -> Capture:
    """The capture without its `bad` frames (name → a sentence that says why), with a remark; itself where there are none.

    Args:
        refusal: what is said where too many are bad; None: the first one's sentence.

    Raises:
        InputError: too many are bad.
    """
    if not bad:
        return capture
    kept = [frame for frame in capture.frames if frame.name not in bad]
    total, lost = len(capture.frames), len(capture.frames) - len(kept)
    first = next(iter(bad.values()))
    if lost > MOST_BAD * total or len(kept) < LEAST:
        raise InputError(refusal or (f"{first} ({lost} of {total} frames are like this)" if lost > 1 else first))
    names = ", ".join(list(bad)[:NAMED]) + (", …" if lost > NAMED else "")
    cause = first.rsplit("; ", 1)[0]
    remark = f"{counted(lost, 'frame')} of {total} {'is' if lost == 1 else 'are'} left out ({names}): {cause}"
    return capture.with_frames(kept, remark)


def with_usable_poses(capture: Capture, notes: PoseNotes) -> Capture:
    """The capture without frames whose pose holds nothing usable, and with remarks on poses that were made rigid.

    Raises:
        InputError: too many poses are unusable.
    """
    lost = [frame for frame in capture.frames if frame.world_from_camera is not None and not np.isfinite(frame.world_from_camera).all()]
    sentences = [*notes.unusable[: len(lost)], *[""] * (len(lost) - len(notes.unusable))]
    refusal = None
    if notes.unusable and len(lost) > 1:
        refusal = f"{notes.unusable[0]} ({len(lost)} of {len(capture.frames)} poses hold nothing usable)"
    capture = without(capture, {frame.name: why for frame, why in zip(lost, sentences, strict=True)}, refusal)
    remarks = []
    if notes.scales:
        low, high = min(notes.scales), max(notes.scales)
        by = f"{low:.4g}" if high - low < 0.01 * high else f"{low:.4g} to {high:.4g}"
        remarks.append(f"the rotations of {counted(len(notes.scales), 'pose')} were scaled by {by}, which was taken out")
    if notes.rounding:
        most = max(notes.rounding)
        remarks.append(f"the rotations of {counted(len(notes.rounding), 'pose')} were off by up to {most:.2g} (rounded?) and were made rigid")
    return capture.with_frames(capture.frames, *remarks) if remarks else capture
