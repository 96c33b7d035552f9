"""Depth maps of a capture: are they there, filled, and in the unit of the poses?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.images import load_depth, spread
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.measures import stored_per_metre
from fieldfuse.progress import SILENT, Progress

LOOKED_AT = 16  # depth maps read, evenly spread
POINTS = 200  # compared for each pair of them
PAIRS = 60  # compared at most, evenly spread
MISSING = 0.3  # share of pixels without depth from which a warning is worth reading
NEAREST, FARTHEST = 0.05, 100.0  # metres: no depth sensor's median lies outside
RANGE, STEP = 20_000.0, 1.07  # factors that depth is multiplied by to see where it agrees with the poses: 1/RANGE to RANGE in such steps
FACTORS = np.exp(np.log(STEP) * np.arange(-round(np.log(RANGE) / np.log(STEP)), round(np.log(RANGE) / np.log(STEP)) + 1))
AGREE = 0.1  # relative difference of depth at which two maps agree no more
SEEN = 0.25  # share of points that must agree at a pair's best factor,
CONTRAST = 0.15  # and how much larger than at all factors smaller or larger than that by `APART` it must be, before the pair has a vote
APART = 1.5
SAME = 1.15  # factors that differ by less are one: votes of pairs that see the same
VOTES, MAJORITY = 4, 0.6  # a unit is refused by at least so many votes for another one, and such a share of all
UNITS = (2.0, 2.54, 3.28, 4.0, 5.0, 10.0, 25.4, 39.4, 100.0, 1000.0, 5000.0, 10_000.0)  # that get confused: named where they are meant
# Stored values to a metre that cameras and data sets have: metres to micrometres, the L515's 0.25 mm, TUM's fifths, 6553.5, KITTI's 256
STORED = (1.0, 10.0, 100.0, 200.0, 256.0, 500.0, 1000.0, 2000.0, 4000.0, 5000.0, 6553.5, 1e4, 1e5, 1e6)
FINE, FINE_STEP, FINE_AGREE = 1.15, 1.01, 0.03  # factors about a unit, their step, and the difference of depth, by which it is verified
NEAR_UNIT = 1.03  # the best of these factors, at most, for the unit to be the one
GIVEN_SCALE = "depth_scale_given"  # in `Capture.extra`: the user has named it
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
    def of(cls, depth: Array, frame: Frame) -> Sample | None:
        """Of a frame's depth (H, W) in any unit; None where it is empty, or the frame has no camera or pose."""
        camera = frame.depth_intrinsics or frame.intrinsics
        camera = None if camera is None else fitted(camera, (depth.shape[1], depth.shape[0]), str(frame.depth)).pinhole()
        row, column = np.nonzero(depth > 0)
        if camera is None or frame.world_from_camera is None or not len(row):
            return None
        some = np.random.default_rng(0).permutation(len(row))[:POINTS]  # not every n-th, which may all lie in a few columns
        row, column = row[some], column[some]
        pixels = np.stack([column + 0.5, row + 0.5], axis=1)
        return cls(depth, camera, frame.world_from_camera, pixels, depth[row, column].astype(np.float64))


def check_depth(capture: Capture, progress: Progress = SILENT) -> tuple[Capture, list[str]]:
    """The capture with the unit of depth that fits its poses, and warnings about its depth maps; none when it has no depth.

    Raises:
        InputError: a map is missing, all are empty, or depth is in another unit than the poses and none that is usual fits.
    """
    frames = [frame for frame in capture.frames if frame.depth is not None]
    if not frames:
        return capture, []
    for frame in frames:
        if frame.depth is not None and not frame.depth.is_file():
            raise InputError(f"the depth map {frame.depth} of {frame.name} is not there; add it or remove the frame")
    chosen = spread(frames if capture.ordered else sorted(frames, key=lambda frame: frame.name), min(LOOKED_AT, len(frames)))
    filled, medians, samples = [], [], []
    for index, frame in enumerate(chosen):
        progress.check()
        progress.update(index, len(chosen), "depth")
        depth = load_depth(frame, capture)
        there = depth[depth > 0]
        filled.append(there.size / depth.size)
        medians += [float(np.median(there))] if there.size else []
        samples.append(Sample.of(depth, frame))
    if not medians:
        raise InputError(
            f"no depth map in {capture.root} holds a value (all are 0, NaN or 65535); check how depth was written, or remove it"
        )
    capture, warnings = _in_unit_of_poses(capture, float(np.median(medians)), [sample for sample in samples if sample is not None])
    empty = sum(share == 0 for share in filled)
    if empty:
        warnings.append(f"{empty} of {len(filled)} depth maps that were looked at are empty")
    gaps = 1 - float(np.mean([share for share in filled if share > 0]))
    if gaps > MISSING:
        warnings.append(f"{100 * gaps:.0f}% of the depth is missing (glass, shiny or dark things, too near or too far)")
    if len(frames) < len(capture.frames):
        warnings.append(f"{len(capture.frames) - len(frames)} of {len(capture.frames)} frames have no depth")
    return capture, warnings


def with_depth_scale(capture: Capture, stated: float | str | None) -> Capture:
    """The capture with a user's unit of depth (see `measures.stored_per_metre`); None: as it is.

    Raises:
        InputError: it has no depth.
    """
    if stated is None:
        return capture
    if not capture.has_depth:
        raise InputError(f"--depth-scale is given, but {capture.root} has no depth; leave it out")
    return replace(capture, depth_scale=stored_per_metre(stated), extra={**capture.extra, GIVEN_SCALE: True})


def _in_unit_of_poses(capture: Capture, median: float, samples: list[Sample]) -> tuple[Capture, list[str]]:
    """With another unit of depth where one that is usual fits the poses and the present one does not, and a remark on it."""
    factor = unit_factor(samples)
    if factor != 1.0:
        times = f"{factor:g} times larger" if factor > 1 else f"{1 / factor:g} times smaller"
        why = f"the depth in {capture.root} (median {median:.3g}) does not fit the camera's motion, but would if it were {times}"
    elif capture.metric and not NEAREST <= median <= FARTHEST:
        why = f"the median depth in {capture.root} is {median:.3g} m, which no depth camera measures"
    else:
        return capture, []
    if capture.extra.get(GIVEN_SCALE):
        return capture, [f"{why}; the depth scale that was given, {capture.depth_scale:g} stored values to a unit of length, is kept"]
    scale = None if factor == 1.0 else usual_scale(capture.depth_scale, factor, samples)
    usual = scale is not None and (not capture.metric or NEAREST <= median * capture.depth_scale / scale <= FARTHEST)
    if scale is None or not usual:
        advice = WHAT_TO_SET.get(capture.kind, OTHERWISE)
        raise InputError(f"{why}, so its unit is probably another one; {advice}, or give --depth-scale (as 5000, or 0.25mm)")
    remark = (
        f"depth is taken as {scale:g} stored values to a unit of length, which fits the camera's motion; {capture.depth_scale:g}, as the "
        "source has it, does not (--depth-scale sets it)"
    )
    return replace(capture, depth_scale=scale), [remark]


def usual_scale(before: float, factor: float, samples: list[Sample]) -> float | None:
    """The depth scale of `STORED` that is meant where depth, read by the scale `before`, must be multiplied by about `factor`; None where
    there is none, or the maps agree better with each other by another one beside it."""
    wanted = before / factor
    scale = min(STORED, key=lambda one: abs(np.log(one / wanted)))
    if abs(np.log(scale / wanted)) > np.log(SAME):
        return None
    count = round(np.log(FINE) / np.log(FINE_STEP))
    factors = before / scale * FINE_STEP ** np.arange(-count, count + 1)
    pairs = spread(_pairs(samples), PAIRS)
    shares = sum((_agreement(one, other, factors, FINE_AGREE) for a, b in pairs for one, other in ((a, b), (b, a))), np.zeros(len(factors)))
    return scale if abs(np.log(FINE_STEP)) * abs(int(shares.argmax()) - count) <= np.log(NEAR_UNIT) else None


def unit_factor(samples: list[Sample]) -> float:
    """What depth must be multiplied by to agree with the poses: 1, or another factor of which the evidence is strong.

    Points of one depth map are carried into another frame by the poses and compared with the depth there, under many factors. The right
    one shows as a peak: with smaller depth the camera seems to move further, with larger depth less, and either way points come to lie
    beside their surfaces. Where there is no such peak the pair has no vote: frames hardly moved, they see different things, or the scene
    looks the same from everywhere (along a corridor, large depth always agrees, since the camera then seems to stand still).
    """
    found = [np.log(factor) for a, b in spread(_pairs(samples), PAIRS) if (factor := _peak(a, b)) is not None]
    others = np.array([value for value in found if abs(value) > np.log(APART)])
    if not len(others):
        return 1.0
    agree = np.abs(others[:, None] - others) < np.log(SAME)
    mode = int(agree.sum(axis=1).argmax())
    votes = int(agree[mode].sum())
    if votes < VOTES or votes < MAJORITY * len(found):
        return 1.0
    # The factor of a unit that is confused with another, where it is near to one; else itself with two digits.
    factor = float(np.exp(np.median(others[agree[mode]])))
    near = min((unit for known in UNITS for unit in (known, 1 / known)), key=lambda unit: abs(np.log(unit / factor)))
    return near if abs(np.log(near / factor)) < np.log(SAME) else float(f"{factor:.2g}")


def _pairs(samples: list[Sample]) -> list[tuple[Sample, Sample]]:
    """Those that look the same way from different places."""
    return [(a, b) for a, b in combinations(samples, 2) if a.pose[:3, 2] @ b.pose[:3, 2] > 0.5 and np.any(a.pose[:3, 3] != b.pose[:3, 3])]


def _peak(a: Sample, b: Sample) -> float | None:
    """The factor under which two maps agree best, both ways; None where it does not stand out."""
    shares = (_agreement(a, b) + _agreement(b, a)) / 2
    best = int(shares.argmax())
    apart = round(np.log(APART) / np.log(STEP))
    smaller, larger = shares[: max(best - apart, 0)], shares[best + apart :]
    if not len(smaller) or not len(larger) or shares[best] < SEEN:
        return None
    return float(FACTORS[best]) if shares[best] - max(smaller.max(), larger.max()) >= CONTRAST else None


def _agreement(a: Sample, b: Sample, factors: Array = FACTORS, agree: float = AGREE) -> Array:
    """(F,) for each of `factors`, by which both depths are multiplied: the share of a's points that lie on b's surface, those that are off
    by a part of `agree` counted by the rest."""
    b_from_a = invert(b.pose) @ a.pose
    rays = np.stack([(a.pixels[:, 0] - a.camera.cx) / a.camera.fx, (a.pixels[:, 1] - a.camera.cy) / a.camera.fy, np.ones(len(a.pixels))])
    points = factors[:, None, None] * (b_from_a[:3, :3] @ (rays * a.values)) + b_from_a[:3, 3:]
    depth = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        across, down = b.camera.fx * points[:, 0] / depth + b.camera.cx, b.camera.fy * points[:, 1] / depth + b.camera.cy
        inside = (depth > 0) & (across >= 0) & (across < b.camera.width) & (down >= 0) & (down < b.camera.height)
        seen = b.depth[np.where(inside, down, 0).astype(np.intp), np.where(inside, across, 0).astype(np.intp)] * factors[:, None]
        off = np.where(inside & (seen > 0), np.abs(depth - seen) / seen, np.inf)
    return np.asarray(np.maximum(1 - off / agree, 0).sum(axis=1) / len(a.values))
