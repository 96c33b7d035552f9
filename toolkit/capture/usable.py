"""One bad part does not stop a good whole: frames that cannot be used are excluded where nearly all others can."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.headers import LYING, image_header, orientation_of, read_header
from fieldfuse.capture.images import EXIF_TURNS
from fieldfuse.capture.listing import IMAGES, counted, some_of
from fieldfuse.capture.poses import PoseNotes
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

MOST_BAD = 0.2  # share of the frames that may be excluded; with more of them something is wrong with the capture
MIN_FRAMES = 3  # frames that have to stay
# Kinds whose images may be photos as a camera wrote them.
BESIDE = ("transforms", "blender", "colmap", "llff", "metashape", "realitycapture", "opensfm", "meshroom", "bundler")


def without(capture: Capture, bad: Mapping[str, str], refusal: str | None = None) -> Capture:
    """The capture without its `bad` frames (name → a sentence that says why), with a remark; itself where there are none. Frames that were
    not read at all may be among the bad ones.

    Args:
        refusal: the error where too many are bad; None: the first one's sentence.
    """
    if not bad:
        return capture
    stay = [frame for frame in capture.frames if frame.name not in bad]
    lost, total = len(bad), len(stay) + len(bad)
    first = next(iter(bad.values()))
    if lost > MOST_BAD * total or len(stay) < MIN_FRAMES:
        raise InputError(refusal or (f"{first} ({lost} of {total} frames are like this)" if lost > 1 else first))
    cause = first.rsplit("; ", 1)[0]
    remark = f"{counted(lost, 'frame')} of {total} {'is' if lost == 1 else 'are'} left out ({some_of(list(bad))}): {cause}"
    return capture.with_frames(stay, remark)


def with_usable_depth(capture: Capture) -> Capture:
    """The capture without those few depth maps that are missing, empty or damaged; their frames stay."""
    total, bad = 0, dict[str, str]()
    for frame in capture.frames:
        if frame.depth is None or frame.video_index is not None:
            continue
        total += 1
        try:
            if frame.depth.suffix.lower() in IMAGES:
                read_header(read_bytes(frame.depth), frame.depth)
            elif not frame.depth.stat().st_size:
                raise InputError(f"{frame.depth} is empty; copy it again")
        except InputError as error:
            bad[frame.name] = str(error)
        except OSError:
            bad[frame.name] = f"{frame.depth} is not there; add it or remove the frame"
    if not bad:
        return capture
    first = next(iter(bad.values()))
    if len(bad) > MOST_BAD * total:
        raise InputError(f"{first} ({len(bad)} of {total} depth maps are like this)" if len(bad) > 1 else first)
    none: dict[str, Any] = {"depth": None, "depth_intrinsics": None, "confidence": None, "depth_pose": None}
    frames = [replace(frame, **none) if frame.name in bad else frame for frame in capture.frames]
    return capture.with_frames(frames, f"{counted(len(bad), 'frame is', 'frames are')} used without depth ({some_of(list(bad))}): {first}")


def turned_by_exif(capture: Capture) -> Capture:
    """The capture with the switch that has its images turned by EXIF, where its cameras have the shape of the upright images only; and with
    a remark on images that EXIF turns by 180° or mirrors, where the shape shows nothing."""
    if capture.kind not in BESIDE or not capture.posed or any(frame.video_index is not None for frame in capture.frames):
        return capture
    turns = [orientation_of(frame.image) for frame in capture.frames]
    lying = sum(
        turn >= LYING and (frame.intrinsics.width, frame.intrinsics.height) == image_header(frame.image).size[::-1]
        for frame, turn in zip(capture.frames, turns, strict=True)
        if frame.intrinsics is not None and frame.intrinsics.width != frame.intrinsics.height
    )
    if lying:
        remark = f"{counted(lying, 'image fits its camera', 'images fit their cameras')} only when turned by EXIF, so all are turned by it"
        return replace(capture.with_frames(capture.frames, remark), extra={**capture.extra, EXIF_TURNS: True})
    over = sum(1 < turn < LYING for turn in turns)
    if not over:
        return capture
    remark = (
        f"EXIF turns {over} of {len(turns)} images (by 180°, or mirrored), and poses are taken to be for the images as they are stored; "
        "if renders come out wrong, write the images anew without that tag"
    )
    return capture.with_frames(capture.frames, remark)


def with_usable_poses(capture: Capture, notes: PoseNotes) -> Capture:
    """The capture without frames whose pose holds nothing usable, and with remarks on poses that were made rigid."""
    lost = [frame for frame in capture.frames if frame.world_from_camera is not None and not np.isfinite(frame.world_from_camera).all()]
    sentences = [*notes.unusable[: len(lost)], *[""] * (len(lost) - len(notes.unusable))]
    refusal = None
    if notes.unusable and len(lost) > 1:
        refusal = f"{notes.unusable[0]} ({len(lost)} of {len(capture.frames)} poses hold nothing usable)"
    capture = without(capture, {frame.name: why for frame, why in zip(lost, sentences, strict=True)}, refusal)
    capture = without(capture, notes.unread)
    remarks = []
    if notes.scales:
        low, high = min(notes.scales), max(notes.scales)
        by = f"{low:.4g}" if high - low < 0.01 * high else f"{low:.4g} to {high:.4g}"
        remarks.append(f"the rotations of {counted(len(notes.scales), 'pose')} were scaled by {by}, which was removed")
    if notes.rounding:
        most, many = max(notes.rounding), counted(len(notes.rounding), "pose")
        remarks.append(f"the rotations of {many} were off by up to {most:.2g} (rounded?) and were made rigid")
    return capture.with_frames(capture.frames, *remarks) if remarks else capture
