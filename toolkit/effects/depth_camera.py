"""Whether a capture's depth camera stands where the camera of its pictures does, and where else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fieldfuse.camera import Array, invert
from fieldfuse.capture.types import Capture
from fieldfuse.effects import geometry
from fieldfuse.effects.adjust import Problem, adjust
from fieldfuse.effects.registration import DEPTH_OFFSET, MARGIN, Registration, register
from fieldfuse.effects.sightings import Look, Sightings, choose, gather
from fieldfuse.effects.survey import CLOSE, FIRST_FRAMES, MOST_FRAMES, Finding
from fieldfuse.progress import SILENT, Progress

UNIT = "of depth"
NOTHING = "too few points are shared between pictures and have depth to tell"


def look_for_offset(
    capture: Capture,
    train: Sequence[int],
    seen: Sightings | None,
    progress: Progress = SILENT,
    known: dict[int, Look] | None = None,
) -> tuple[Finding, Array | None]:
    """What is found about the depth camera, and (4, 4) the picture's camera from it; None: too little is seen.

    Args:
        capture: with the poses and lenses that depth is going to be used with.
        train: frames that may be looked at.
        seen: what was found in its pictures, whatever poses and lenses it had then; a quick look at few of them is followed by a closer
            one where it comes near to speaking for an offset, or tells nothing.

    Raises:
        InputError: a picture or a depth map cannot be read.
    """
    index = {frame.name: number for number, frame in enumerate(capture.frames)}
    allowed = [number for number in train if capture.frames[number].depth is not None]

    def found_by(sightings: Sightings) -> Registration | None:
        numbers = [index[name] for name in sightings.names]
        frames = [capture.frames[number] for number in numbers]
        cameras = [frame.intrinsics for frame in frames if frame.intrinsics is not None]
        poses = np.stack([np.asarray(frame.world_from_camera) for frame in frames])
        problem = _problem(replace(sightings, cameras=cameras, poses=poses), np.isin(numbers, allowed))
        return None if problem is None else register(capture, numbers, problem, progress)

    found = None if seen is None else found_by(seen)
    quick = seen is not None and len(seen.names) <= FIRST_FRAMES < len(allowed)
    if quick and (found is None or found.gain > CLOSE * MARGIN):
        closely = [allowed[k] for k in choose(len(allowed), MOST_FRAMES)]
        found = found_by(gather(capture, closely, progress, known=known))
    if found is None:
        return Finding(DEPTH_OFFSET, 0.0, MARGIN, NOTHING, False), None
    finding = Finding(DEPTH_OFFSET, max(found.gain, 0.0), MARGIN, found.reason, found.there, found.before, found.after, UNIT)
    return finding, invert(found.depth_from_picture)


def _problem(seen: Sightings, train: Array) -> Problem | None:
    """Points of training pictures, where their rays meet."""
    if not len(seen.frame):
        return None
    whole, _ = geometry.open_problem(seen)
    mine = train[whole.frame]
    whole = replace(whole, frame=whole.frame[mine], point=whole.point[mine], place=whole.place[mine], row=whole.row[mine])
    whole = whole.only(np.bincount(whole.point, minlength=len(whole.points)) >= 2)
    if not len(whole.points):
        return None
    return adjust(whole).problem
