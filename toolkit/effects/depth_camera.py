"""Where a capture's depth camera stands beside the camera of its images, by points that images share and whose depth was measured.

    X_d = R·s·X + t,    r = D(π(X_d)) / (X_d)_z − 1

X: a point in the axes of the images' camera; D: the depth map; s: a scale, so that poses which are a little too large or small do not pass
for an offset. Least is Σ min(|r|, c) over all observations, by Gauss-Newton's method with weights 1/|r|. A depth map has steps and noise,
so its slopes are taken over several pixels, fewer as c falls. Half of the points judges what fits the other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Intrinsics, distort, invert
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.types import Capture
from fieldfuse.effects import geometry
from fieldfuse.effects.adjust import Problem, adjust, predict, residuals, uncertainty
from fieldfuse.effects.diagnostics import CLOSE, FIRST_FRAMES, MOST_FRAMES
from fieldfuse.effects.evidence import Finding
from fieldfuse.effects.tracks import Look, Tracks, choose, gather
from fieldfuse.poses.cloud import every
from fieldfuse.poses.points import undistorted
from fieldfuse.progress import SILENT, Progress

DEPTH_OFFSET = "depth_offset"
UNKNOWN = "too few points with depth are shared between images"
SIDE = 320  # pixels along the long side; of larger maps every n-th is taken
SMOOTH = 0.05  # share of depth within which four pixels are of one surface
LOOKS = 4  # from a guess of where a ray meets the surface to where it does
MARGIN = 0.12  # least relative fall of what held-out points are off …
MIN_FALL = 0.0005  # … and least fall, as a share of depth
MAPS = 120  # depth maps that are looked at
FEWEST, MAX_OBSERVATIONS = 300, 6000  # observations
FOLDS = 2  # each of which is judged by what fits the others
MEETS = 2.0  # times the median distance between where a point is seen and where it should be: what is off by more is no point
SURE = 0.005  # share of its depth within which rays must meet
STAGES = ((0.2, 0.012), (0.1, 0.006), (0.06, 0.003))  # c; radians and shares of the usual depth that slopes are taken over
STEPS = 30  # for each of them
NOTHING = 0.003  # share of depth: residuals below this weigh the same
BELIEF = 0.05  # radians, and shares of the usual depth: how far off the depth camera may be
ALL, SCALE = np.arange(7), np.array([6])
EXACT = 1e-6  # share of depth: nothing is measured more surely, so that a wall seen straight on, exactly, moves nothing
SLACK = 1e-3  # relative fall below which a stage is done


@dataclass(frozen=True)
class DepthMaps:
    """M maps, one after the other in memory."""

    values: Array  # (sum of pixels,) float32, 0 = missing
    start: Array  # (M,) where each begins
    size: Array  # (M, 2) its width and height
    step: Array  # (M,) pixels of its camera from one of its pixels to the next
    cameras: tuple[Intrinsics, ...]  # (M,) each frame may have its own

    @classmethod
    def read(cls, capture: Capture, frames: Sequence[int], progress: Progress = SILENT) -> DepthMaps:
        """The maps of the frames `frames`, which all have depth and a camera.

        Raises:
            InputError: a depth map cannot be read.
        """
        maps, steps, cameras = [], [], []
        for index in frames:
            progress.check()
            frame = capture.frames[index]
            depth, camera = load_depth(frame, capture), frame.depth_intrinsics or frame.intrinsics
            assert camera is not None
            cameras.append(fitted(camera, (depth.shape[1], depth.shape[0]), str(frame.depth)))
            steps.append(max(1, round(max(depth.shape) / SIDE)))
            maps.append(depth[:: steps[-1], :: steps[-1]])
        start = np.cumsum([0, *(one.size for one in maps)])[:-1]
        sizes = np.array([one.shape[::-1] for one in maps])
        return cls(np.concatenate([one.ravel() for one in maps]), start, sizes, np.array(steps, float), tuple(cameras))

    @cached_property
    def _lens(self) -> Array:
        """(M, 4) fx, fy, cx, cy."""
        return np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in self.cameras])

    @cached_property
    def _bent(self) -> list[tuple[Intrinsics, Array]]:
        """Cameras that are no pinholes, and (M,) bool whose they are."""
        kinds = dict.fromkeys(camera for camera in self.cameras if camera.distorted)
        return [(camera, np.array([other == camera for other in self.cameras])) for camera in kinds]

    def off(self, places: Array, which: Array, depth_from_image: Array, scale: float = 1.0) -> Array:
        """(N,) r; NaN: the four pixels around are not all known, or not of one surface.

        Args:
            places: (N, 3) in the axes of the images' cameras. which: (N,) int, the map of each. depth_from_image: (4, 4).
        """
        out = np.full(len(places), np.nan)
        places = scale * places @ depth_from_image[:3, :3].T + depth_from_image[:3, 3]
        front = np.flatnonzero(places[:, 2] > 0)
        ideal, mine = places[front, :2] / places[front, 2:], which[front]
        for camera, maps in self._bent:
            one = maps[mine]
            ideal[one] = distort(camera, ideal[one])
        lens = self._lens[mine]
        pixels = (ideal * lens[:, :2] + lens[:, 2:] - 0.5) / self.step[mine, None]
        inside = (pixels >= 0).all(axis=1) & (pixels < self.size[mine] - 1).all(axis=1)
        front, pixels, mine = front[inside], pixels[inside], mine[inside]
        whole = pixels.astype(np.intp)
        a, b = (pixels - whole).T
        width = self.size[mine, 0]
        first = self.start[mine] + whole[:, 1] * width + whole[:, 0]
        corners = self.values[np.stack([first, first + 1, first + width, first + width + 1])]
        low, high = corners.min(axis=0), corners.max(axis=0)
        measured = (corners[0] * (1 - a) + corners[1] * a) * (1 - b) + (corners[2] * (1 - a) + corners[3] * a) * b
        out[front] = np.where((low > 0) & (high - low < SMOOTH * high), measured / places[front, 2] - 1, np.nan)
        return out

    def surface(self, which: int, across: int) -> Array:
        """(N, 3) what one map sees, in the axes of its camera, at `across` pixels along its long side, others as far apart."""
        width, height = self.size[which]
        apart = max(1, int(max(width, height) // across))
        rows, columns = np.mgrid[apart // 2 : height : apart, apart // 2 : width : apart]
        depth = self.values[self.start[which] + rows.ravel() * width + columns.ravel()].astype(np.float64)
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)[depth > 0] * self.step[which] + 0.5
        flat = undistorted(self.cameras[which], pixels)
        places = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * depth[depth > 0, None]
        return np.asarray(places[np.isfinite(places).all(axis=1)])

    def along(self, places: Array, which: Array, depth_from_image: Array) -> Array:
        """(N,) z at which rays from the images' cameras through `places` (N, 3), as in `off`, meet the sensor's surface; NaN: unknown."""
        ray, z = places / places[:, 2:], places[:, 2].copy()
        for _ in range(LOOKS):
            z = z * (1 + self.off(ray * z[:, None], which, depth_from_image))
        return z


@dataclass(frozen=True)
class Registration:
    """Where the depth camera stands, and how well held-out points fit it."""

    depth_from_image: Array  # (4, 4), units of the poses
    before: float  # what held-out points are off in the mean, share of depth, both cameras at one place
    after: float

    @property
    def gain(self) -> float:
        return 1 - self.after / self.before if self.before > 0 else 0.0

    @property
    def there(self) -> bool:
        return self.gain > MARGIN and self.before - self.after > MIN_FALL

    @property
    def reason(self) -> str:
        move = self.depth_from_image[:3, 3]
        turn = np.degrees(Rotation.from_matrix(self.depth_from_image[:3, :3]).magnitude())
        return (
            f"points that pictures share are {100 * self.before:.2f}% of their depth off the sensor's, {100 * self.after:.2f}% with a "
            f"depth camera that stands {np.linalg.norm(move):.3g} units beside the pictures' and is turned by {turn:.2f}°"
        )


@dataclass(frozen=True)
class Observations:
    """Points in the axes of the images' cameras, and the depth maps beside these."""

    places: Array  # (N, 3)
    point: Array  # (N,) int which points they are
    map: Array  # (N,) int which map is theirs
    maps: DepthMaps

    def some(self, which: Array) -> Observations:
        return Observations(self.places[which], self.point[which], self.map[which], self.maps)

    def with_depth(self) -> Observations:
        """Those whose depth is known where both cameras stand at one place."""
        return self.some(np.flatnonzero(np.isfinite(self.maps.off(self.places, self.map, np.eye(4)))))

    def off(self, x: Array, usual: float) -> Array:
        """(N,) r of `DepthMaps.off`; x: a turn, a move in usual depths, the logarithm of the scale."""
        return self.maps.off(self.places, self.map, _pose(x, usual), float(np.exp(x[6])))


def look_for_offset(
    capture: Capture, train: Sequence[int], seen: Tracks | None, progress: Progress = SILENT, known: dict[int, Look] | None = None
) -> tuple[Finding, Array | None]:
    """What is found about the depth camera, and (4, 4) the images' camera from it; None: too little is seen.

    Args:
        capture: with the poses and lenses that depth is going to be used with.
        train: frames that may be looked at.
        seen: what was found in its images, whatever poses and lenses it had then; a quick look at few of them is followed by a closer
            one where it comes near to speaking for an offset, or finds nothing.

    Raises:
        InputError: an image or a depth map cannot be read.
    """
    index = {frame.name: number for number, frame in enumerate(capture.frames)}
    allowed = [number for number in train if capture.frames[number].depth is not None]

    def found_by(tracks: Tracks) -> Registration | None:
        numbers = [index[name] for name in tracks.names]
        frames = [capture.frames[number] for number in numbers]
        cameras = [frame.intrinsics for frame in frames if frame.intrinsics is not None]
        poses = np.stack([np.asarray(frame.world_from_camera) for frame in frames])
        problem = _problem(replace(tracks, cameras=cameras, poses=poses), np.isin(numbers, allowed))
        chosen = [] if problem is None else deep_frames(capture, numbers, problem)
        use = np.zeros(0, dtype=bool) if problem is None else sure(problem) & np.isin(problem.frame, chosen)
        if problem is None or use.sum() < FEWEST:
            return None
        maps = DepthMaps.read(capture, [numbers[number] for number in chosen], progress)
        which = np.searchsorted(chosen, problem.frame[use])
        return register(Observations(predict(problem)[0][use], problem.point[use], which, maps))

    found = None if seen is None else found_by(seen)
    quick = seen is not None and len(seen.names) <= FIRST_FRAMES < len(allowed)
    if quick and (found is None or found.gain > CLOSE * MARGIN):
        found = found_by(gather(capture, [allowed[k] for k in choose(len(allowed), MOST_FRAMES)], progress, known=known))
    if found is None:
        return Finding(DEPTH_OFFSET, 0.0, MARGIN, UNKNOWN, False), None
    finding = Finding(DEPTH_OFFSET, max(found.gain, 0.0), MARGIN, found.reason, found.there, found.before, found.after, "of depth")
    return finding, invert(found.depth_from_image)


def _problem(seen: Tracks, train: Array) -> Problem | None:
    """Points of training images, where their rays meet."""
    if not len(seen.frame):
        return None
    whole, _ = geometry.open_problem(seen)
    whole = whole.only_frames(train)
    whole = whole.only(np.bincount(whole.point, minlength=len(whole.points)) >= 2)
    return adjust(whole).problem if len(whole.points) else None


def deep_frames(capture: Capture, indices: Sequence[int], problem: Problem, most: int = MAPS) -> list[int]:
    """Up to `most` frames of the problem (frames `indices` of the capture) that have depth and show points, evenly spread, ascending."""
    deep = [number for number, index in enumerate(indices) if capture.frames[index].depth is not None and (problem.frame == number).any()]
    return [deep[k] for k in every(len(deep), most)]


def sure(problem: Problem) -> Array:
    """(O,) bool: observations of points that are where they should be, and whose rays meet within `SURE` of their depth."""
    if not len(problem.frame):
        return np.zeros(0, dtype=bool)
    depth, off = predict(problem)[0][:, 2], np.linalg.norm(residuals(problem), axis=1)
    return np.asarray((off < MEETS * np.median(off)) & (depth > 0) & (uncertainty(problem) < SURE * np.maximum(depth, 0)))


def register(found: Observations) -> Registration | None:
    """The offset by all observations; None: too few of these have depth."""
    usual, known = float(np.median(found.places[:, 2])), found.with_depth()
    fold = known.point % FOLDS
    if min(np.bincount(fold, minlength=FOLDS)) < FEWEST / FOLDS:
        return None
    off = []  # of held-out observations, with both cameras at one place and each where it stands
    for held in range(FOLDS):
        fit, judge = known.some(np.flatnonzero(fold != held)), known.some(np.flatnonzero(fold == held))
        off.append([judge.off(_fitted(fit, usual, free), usual) for free in (SCALE, ALL)])
    before, after = _means(np.concatenate(off, axis=1))
    return Registration(_pose(_fitted(known, usual, ALL), usual), before, after)


def register_quickly(found: Observations) -> Array:
    """(4, 4) the offset, judged by the observations that it is fitted to; none where it is not there, or too few have depth."""
    known = found.with_depth()
    if len(known.point) < FEWEST:
        return np.eye(4)
    usual = float(np.median(known.places[:, 2]))
    scale, offset = (_fitted(known, usual, free) for free in (SCALE, ALL))
    judged = Registration(_pose(offset, usual), *_means(np.stack([known.off(scale, usual), known.off(offset, usual)])))
    return judged.depth_from_image if judged.there else np.eye(4)


def _means(off: Array) -> tuple[float, float]:
    """Of (2, N) r without and with the offset the means of |r|, no more of each than the last stage counts, where both are known."""
    off = np.minimum(np.abs(off[:, np.isfinite(off).all(axis=0)]), STAGES[-1][0])
    return (float(off[0].mean()), float(off[1].mean())) if off.size else (0.0, 0.0)


def _fitted(found: Observations, usual: float, free: Array) -> Array:
    """(7,) a turn, a move in usual depths, the logarithm of the scale; 0 but for those `free`."""
    some = found.some(np.linspace(0, len(found.point) - 1, min(MAX_OBSERVATIONS, len(found.point))).astype(int))
    x = np.zeros(7)
    for cut, over in STAGES:
        x = _descend(some, x, usual, cut, over, free)
    return x


def _pose(x: Array, usual: float) -> Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix()
    out[:3, 3] = x[3:6] * usual
    return out


def _descend(found: Observations, x: Array, usual: float, cut: float, over: float, free: Array) -> Array:
    """From `x` on downhill in the numbers `free`."""
    off, damping = found.off(x, usual), 1e-3
    for _ in range(STEPS):
        slopes = []
        for k in free:
            aside = over * (np.arange(7) == k)
            slopes.append((found.off(x + aside, usual) - found.off(x - aside, usual)) / (2 * over))
        slope = np.stack(slopes, axis=1)
        use = np.isfinite(off) & (np.abs(off) < cut) & np.isfinite(slope).all(axis=1)
        if use.sum() < FEWEST // 4:
            return x
        heavy = slope[use] / np.maximum(np.abs(off[use]), NOTHING)[:, None]
        hold = max(float(np.median(np.abs(off[use]))), EXACT) / BELIEF**2
        normal, downhill = heavy.T @ slope[use] + hold * np.eye(len(free)), heavy.T @ off[use] + hold * x[free]
        for _ in range(6):
            moved = x.copy()
            moved[free] -= np.linalg.solve(normal + damping * np.diag(np.diag(normal)), downhill)
            new = found.off(moved, usual)
            both = np.isfinite(off) & np.isfinite(new)
            was, value = (float(np.minimum(np.abs(one[both]), cut).mean()) for one in (off, new))
            if value < was:
                break
            damping *= 10
        else:
            return x
        x, off, damping = moved, new, max(damping / 10, 1e-6)
        if was - value < SLACK * was:
            break
    return x
