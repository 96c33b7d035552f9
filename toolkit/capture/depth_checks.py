"""Depth maps of a capture: are they there, filled, and in the unit of the poses?"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from toolkit.camera import Array, Intrinsics, project, unproject
from toolkit.capture.images import load_depth
from toolkit.capture.listing import fitted
from toolkit.capture.types import Capture
from toolkit.errors import InputError
from toolkit.progress import SILENT, Progress

LOOKED_AT = 16  # depth maps read, evenly spread
POINTS = 300  # compared for each pair of them
SEEN = 0.3  # share of points that must agree, in some unit, before a pair of frames says anything
AGREE = 0.05  # relative difference of depth up to which two maps agree
MISSING = 0.3  # share of pixels without depth from which a warning is worth reading
NEAREST, FARTHEST = 0.05, 100.0  # metres: no depth sensor's median lies outside
FACTORS = (1000.0, 100.0, 10.0, 5.0, 0.2, 0.1, 0.01, 0.001)  # units that get confused: mm, cm, m, and the 5000 of TUM
WHAT_TO_SET = {
    "transforms": "set `depth_unit_scale_factor` (units of length for each stored value) in transforms.json",
    "redwood": "set `depth_scale` (stored values for each unit of the trajectory) in the camera's json",
    "replica": "set `scale` (stored values for each metre) in cam_params.json",
    "tum": "store depth as 16-bit PNG with 5000 for each metre",
}
OTHERWISE = "store depth as 16-bit PNG in millimetres and poses in metres"


@dataclass(frozen=True)
class Sample:
    """A posed depth map and some of its points."""

    depth: Array  # (H, W) float32, 0 = missing
    camera: Intrinsics  # pinhole; a depth lens bends too little to matter here
    pose: Array  # (4, 4)
    pixels: Array  # (N, 2)
    values: Array  # (N,) depth at them

    @classmethod
    def of(cls, depth: Array, camera: Intrinsics, pose: Array) -> Sample:
        row, column = np.nonzero(depth > 0)
        row, column = row[:: max(1, len(row) // POINTS)], column[:: max(1, len(column) // POINTS)]
        return cls(depth, camera.pinhole(), pose, np.stack([column + 0.5, row + 0.5], axis=1), depth[row, column].astype(np.float64))


def check_depth(capture: Capture, progress: Progress = SILENT) -> list[str]:
    """Warnings about the depth maps of `capture`; none when it has no depth.

    Raises:
        InputError: a depth file is missing or damaged, no map holds a value, or depth and poses are in different units.
    """
    frames = [frame for frame in capture.frames if frame.depth is not None]
    if not frames:
        return []
    for frame in frames:
        if frame.depth is not None and not frame.depth.is_file():
            raise InputError(f"the depth map {frame.depth} of {frame.name} is not there; add it or remove the frame")
    order = sorted(range(len(frames)), key=lambda index: frames[index].name) if not capture.ordered else range(len(frames))
    chosen = [frames[order[int(index)]] for index in np.unique(np.linspace(0, len(frames) - 1, min(LOOKED_AT, len(frames))).round())]
    filled, medians, samples = [], [], []
    for index, frame in enumerate(chosen):
        progress.check()
        progress.update(index, len(chosen), "depth")
        depth = load_depth(frame, capture)
        there = depth[depth > 0]
        filled.append(there.size / depth.size)
        camera = frame.depth_intrinsics or frame.intrinsics
        if camera is not None:
            camera = fitted(camera, (depth.shape[1], depth.shape[0]), str(frame.depth))
        if there.size:
            medians.append(float(np.median(there)))
            if camera is not None and frame.world_from_camera is not None:
                samples.append(Sample.of(depth, camera, frame.world_from_camera))
    if not medians:
        raise InputError(
            f"no depth map in {capture.root} holds a value (all are 0, NaN or 65535); check how depth was written, or remove it"
        )
    _refuse_wrong_unit(capture, float(np.median(medians)), samples)
    warnings = []
    empty = sum(share == 0 for share in filled)
    if empty:
        warnings.append(f"{empty} of {len(filled)} depth maps that were looked at are empty")
    gaps = 1 - float(np.mean([share for share in filled if share > 0]))
    if gaps > MISSING:
        warnings.append(f"{100 * gaps:.0f}% of the depth is missing (glass, shiny or dark things, too near or too far)")
    if len(frames) < len(capture.frames):
        warnings.append(f"{len(capture.frames) - len(frames)} of {len(capture.frames)} frames have no depth")
    return warnings


def _refuse_wrong_unit(capture: Capture, median: float, samples: list[Sample]) -> None:
    advice = WHAT_TO_SET.get(capture.kind, OTHERWISE)
    factor = unit_factor(samples)
    if factor != 1.0:
        times = f"{factor:g} times larger" if factor > 1 else f"{1 / factor:g} times smaller"
        raise InputError(
            f"the depth in {capture.root} (median {median:.3g}) does not fit the camera's motion, but would if it were {times}, "
            f"so its unit is probably another one; {advice}"
        )
    if capture.metric and not NEAREST <= median <= FARTHEST:
        raise InputError(
            f"the median depth in {capture.root} is {median:.3g} m, which no depth camera measures, "
            f"so its unit is probably another one; {advice}"
        )


def unit_factor(samples: list[Sample]) -> float:
    """What depth must be multiplied by to agree with the poses: 1, or one of `FACTORS` when that is far better.

    Points of one depth map are carried into other frames by the poses and compared with the depth there. A wrong unit moves
    them to wrong places as soon as the camera moves by a good part of the depth. Each pair of frames that can tell (some
    unit makes it agree) has a vote, so pairs that see different things, or hardly moved, do no harm.
    """
    own, others = 0, dict.fromkeys(FACTORS, 0)
    for a, b in _pairs(samples):
        here = agreement(a, b, 1.0)
        scores = {factor: agreement(a, b, factor) for factor in FACTORS}
        best = max(scores.values())
        if max(here, best) < SEEN:
            continue
        if best > 2 * here:
            # Of units that fit about as well (a flat wall, little motion), the one that changes least.
            others[min((f for f in FACTORS if scores[f] > 0.95 * best), key=lambda f: abs(np.log(f)))] += 1
        else:
            own += 1
    likely = max(others, key=lambda factor: others[factor])
    return likely if others[likely] >= 2 and others[likely] > 2 * own else 1.0


def _pairs(samples: list[Sample]) -> list[tuple[Sample, Sample]]:
    """Pairs of frames from different places that look much the same way."""
    return [(a, b) for a, b in combinations(samples, 2) if a.pose[:3, 2] @ b.pose[:3, 2] > 0.5 and np.any(a.pose[:3, 3] != b.pose[:3, 3])]


def agreement(a: Sample, b: Sample, factor: float) -> float:
    """Share of a's points, with depth times `factor`, that lie on b's surface where b sees them."""
    points = unproject(a.camera, a.pose, a.pixels, a.values * factor)
    place, depth = project(b.camera, b.pose, points)
    inside = (depth > 0) & (place >= 0).all(axis=1) & (place[:, 0] < b.camera.width) & (place[:, 1] < b.camera.height)
    if not inside.any():
        return 0.0
    column, row = np.floor(place[inside]).astype(int).T
    seen = b.depth[row, column].astype(np.float64) * factor
    return float(((seen > 0) & (np.abs(depth[inside] - seen) < AGREE * seen)).sum() / len(a.values))
