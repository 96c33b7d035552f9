"""Depth maps of a capture: are they there, filled, and in the unit of the poses?"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from toolkit.camera import Array, Intrinsics, project, unproject
from toolkit.capture.images import load_depth, load_image
from toolkit.capture.listing import fitted
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError
from toolkit.progress import SILENT, Progress

LOOKED_AT = 16  # depth maps read, evenly spread
POINTS = 300  # compared for each pair of them
SEEN = 0.3  # share of points that must agree, in some unit, before a pair of frames says anything
AGREE = 0.05  # relative difference of depth up to which two maps agree
MISSING = 0.3  # share of pixels without depth from which a warning is worth reading
NEAREST, FARTHEST = 0.05, 100.0  # metres: no depth sensor's median lies outside
# Units that get confused: mm, cm, m, tenths and quarters of a millimetre, the 5000 steps a metre of TUM, inverse and doubled factors.
FACTORS = (1000.0, 100.0, 10.0, 5.0, 4.0, 2.0, 0.5, 0.25, 0.2, 0.1, 0.01, 0.001)
BEYOND = 3.0  # times a factor: where depths agree there as well, it is since the camera hardly moves against them, which says nothing
PEAK = 0.9  # of the agreement at a factor, that is less there
BETTER = 1.7  # times the agreement as it stands that another unit needs
PLAINLY = 0.1  # by which colours agree better under one unit than under another
ALIKE, FEWEST_PAIRS = 0.5, 3  # correlation of colours that fit, and pairs that say so
FEWEST = 40  # points whose colours are compared
GREY_SIDE = 160  # pixels of the images that are
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
    grey: Array | None = None  # (h, w) float32 the image, blurred

    @classmethod
    def of(cls, depth: Array, camera: Intrinsics, pose: Array, grey: Array | None = None) -> Sample:
        row, column = np.nonzero(depth > 0)
        row, column = row[:: max(1, len(row) // POINTS)], column[:: max(1, len(column) // POINTS)]
        return cls(depth, camera.pinhole(), pose, np.stack([column + 0.5, row + 0.5], axis=1), depth[row, column].astype(np.float64), grey)

    def shade(self, pixels: Array) -> Array:
        """(N,) grey at places in the depth map's pixels."""
        assert self.grey is not None
        height, width = self.grey.shape
        column = np.clip(pixels[:, 0] / self.camera.width * width, 0, width - 1).astype(int)
        row = np.clip(pixels[:, 1] / self.camera.height * height, 0, height - 1).astype(int)
        return np.asarray(self.grey[row, column], dtype=np.float64)


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
                samples.append(Sample.of(depth, camera, frame.world_from_camera, _grey(frame)))
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
    them to wrong places as soon as the camera moves by a good part of the depth. Each pair of frames that can tell (one unit
    makes it agree much better than others) has a vote for or against the unit as it is, so pairs that see different things, or hardly
    moved, do no harm; those against it choose together. A long step along a corridor looks as if the camera had not moved before
    something far away: there the agreement does not fall with still larger depths, and colours agree better as it stands.
    """
    own, against = 0, []
    for a, b in _pairs(samples):
        here = agreement(a, b, 1.0)
        scores = {factor: agreement(a, b, factor) for factor in FACTORS}
        factor = max(FACTORS, key=lambda f: scores[f])
        best = scores[factor]
        if max(here, best) < SEEN:
            continue
        if here * PEAK > best:
            own += 1
        elif best > BETTER * here:
            if agreement(a, b, factor * (BEYOND if factor > 1 else 1 / BEYOND)) > PEAK * best:
                continue
            colours, other_colours = colours_agree(a, b, 1.0), colours_agree(a, b, factor)
            if colours is None or other_colours is None or other_colours > colours + PLAINLY:
                against.append(scores)
            elif colours > other_colours + PLAINLY:
                own += 1
    if len(against) < 2 or len(against) <= 2 * own:
        return 1.0
    together = {factor: sum(scores[factor] for scores in against) for factor in FACTORS}
    # Of units that fit about as well (a flat wall, little motion), the one that changes least.
    most = max(together.values())
    factor = min((f for f in FACTORS if together[f] > 0.95 * most), key=lambda f: abs(np.log(f)))
    return 1.0 if _colours_fit(samples, factor) else factor


def _colours_fit(samples: list[Sample], factor: float) -> bool:
    """Whether the colours of all pairs that have points in common as depth stands say that it is right, and not `factor` times as large."""
    both = [(colours_agree(a, b, 1.0), colours_agree(a, b, factor)) for a, b in _pairs(samples)]
    known = np.array([(here, there) for here, there in both if here and there is not None])
    if len(known) < FEWEST_PAIRS:
        return False
    here, there = np.median(known, axis=0)
    return bool(here > ALIKE and here > there + PLAINLY)


def _pairs(samples: list[Sample]) -> list[tuple[Sample, Sample]]:
    """Pairs of frames from different places that look much the same way."""
    return [(a, b) for a, b in combinations(samples, 2) if a.pose[:3, 2] @ b.pose[:3, 2] > 0.5 and np.any(a.pose[:3, 3] != b.pose[:3, 3])]


def _grey(frame: Frame) -> Array | None:
    """The frame's image, small and blurred; None where it cannot be read, which is said elsewhere."""
    try:
        image = load_image(frame)
    except InputError:
        return None
    scale = GREY_SIDE / max(image.shape[:2])
    small = cv2.resize(image[..., :3], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.5))


def colours_agree(a: Sample, b: Sample, factor: float) -> float | None:
    """Correlation of the images' grey where a's points, with depth times `factor`, lie in b; 0 where too few do; None without images."""
    if a.grey is None or b.grey is None:
        return None
    place, depth = project(b.camera, b.pose, unproject(a.camera, a.pose, a.pixels, a.values * factor))
    inside = (depth > 0) & (place >= 0).all(axis=1) & (place[:, 0] < b.camera.width) & (place[:, 1] < b.camera.height)
    if inside.sum() < FEWEST:
        return 0.0
    one, other = a.shade(a.pixels[inside]), b.shade(place[inside])
    spread = float(one.std() * other.std())
    return float(((one - one.mean()) * (other - other.mean())).mean() / spread) if spread > 0 else 0.0


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
