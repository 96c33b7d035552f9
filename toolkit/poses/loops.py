"""Frames far apart that look alike and are not the same place: what they seem to share is taken back, and mapping repeated.

A can with the same print on both sides, a table with four legs, a corridor of equal doors: matched across, they fold the way of the
camera together, and all frames are registered with a small error. The way shows it. Neighbouring frames see the same side, so how far
the camera turned between two of them does not hang on what was matched far off, and a model that has them turned otherwise is folded. Then
frames are mapped by their near neighbours alone, and of the matches between frames far apart those stay that agree with that.

Runs in the child process only.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.files import remove
from fieldfuse.poses.database import MIN_INLIERS, Report, keypoints_of, opened
from fieldfuse.poses.job import Job
from fieldfuse.poses.mapping import Model, agreement, calibrate, joined, map_images, plain
from fieldfuse.poses.match import match
from fieldfuse.poses.overlap import guessed_depth, overlap, parallax

NEIGHBOURS = 2  # frames apart that show the same side of things
CONTRADICTS = np.radians(60.0)  # between the turn of a pair of images and the model's: a few blurred points are off by less
MIN_FOLD_PAIRS = 3  # such pairs of neighbours that make a fold: one fold between two frames parts so many
NEAR = (10, 5, 3)  # frames apart whose matches are believed when a model is folded; fewer when the model of these is folded, too
AGREES = np.radians(30.0)  # matches farther apart stay within this: what a long way adds up to without loops
CHAINED = 5  # frames apart whose turns are put one after the other before anything is mapped
# Share of the pairs far apart that contradict these: with a fold 0.84 to 0.99 with guessed lenses and 0.58 to 0.97 with calibrated ones,
# without up to 0.95 and 0.31 (docs/measured/performance.md).
SUSPECT, FOLDED = 0.8, 0.5
BORNE_OUT = 0.5  # … and that contradict the model of near neighbours, too
MEETINGS = 4  # pairs far apart that are matched for each image, where cameras meet in the near model
WIDEST = 25.0  # degrees of parallax between two such cameras
CLOSED = 0.7  # share of a frame's far matches that agree with a closed loop: of nine frames in ten
COMMON = 0.4  # of both images, that they have to share
KEPT = 0.5  # share of the folded model's frames that another one has to hold …
KEPT_PHOTOS = 0.9  # … and of photos', whose neighbours by name may be of other things, or where none was mapped


@dataclass(frozen=True)
class Turns:
    """How far the camera turned between two images, by what they share: of every verified pair."""

    first: Array  # (P,) int64 index into the job's images
    second: Array  # (P,) int64
    turn: Array  # (P, 3, 3) the second camera's axes from the first's
    images: Array  # (P, 2) int64 the images' ids in the database
    shared: Array  # (P,) int64 verified matches

    @property
    def apart(self) -> Array:
        """(P,) frames between the two."""
        return np.abs(self.second - self.first)


Mapped = tuple[Model, list[dict[str, Any]], dict[str, int] | None]  # a model, its attempts, and the counts of folds (`without_folds`)


def never_folded(job: Job, report: Report) -> Mapped | None:
    """What `without_folds` would come to, without mapping the folded way first, where the pairs of images alone show a fold: most of
    those far apart contradict the turns from frame to frame, and then the model of near neighbours. None where they do not, or nothing came
    of it: then everything is mapped."""

    def alone(done: float, total: float, note: str) -> None:
        report(0, total, f"{note} (near neighbours alone)")

    count, seen = len(job.images), turns(job)
    # A guessed focal length that is off turns every step too far or too little, so that a circle does not close: a first sieve, and cheap.
    if contradicted(seen, chained(seen, count)) < SUSPECT:
        return None
    seen = turns(job, _calibrated(job, seen))
    if contradicted(seen, chained(seen, count)) < FOLDED:
        return None
    for reach in NEAR:
        near = _by_neighbours(job, seen, reach, alone)
        if near is None or len(near.registered) < KEPT_PHOTOS * count:
            return None
        if contradictions(seen, axes(near)) >= MIN_FOLD_PAIRS:
            continue  # what looks alike is so near that it is among the neighbours
        if contradicted(seen, axes(near)) < BORNE_OUT:
            return None
        found, tried, facts = _held_against(job, near, reach, report)
        if found is None or len(found.registered) < KEPT_PHOTOS * len(near.registered) or facts["left"] >= MIN_FOLD_PAIRS:
            return None
        return found, tried, facts | {"contradicting": int((seen.apart > NEAR[0]).sum())}
    return None


def without_folds(job: Job, model: Model, attempts: list[dict[str, Any]], report: Report) -> Mapped:
    """The model and its attempts as they came from `map_images`, or, where the way of the camera is folded, better ones.

    Returns:
        with them, None where nothing was folded, else counts: pairs of neighbours that are `contradicting` the folded model, and how many
        of them are `left` in the one that is answered (as many as before: nothing better was found, it is the same); matches between
        frames `far` apart, and how many of these were `dropped`.
    """
    seen = turns(job, model.reconstruction.cameras)
    before = contradictions(seen, axes(model))
    if before < MIN_FOLD_PAIRS:
        return model, attempts, None

    def again(done: float, total: float, note: str) -> None:
        report(total, total, f"{note} (again, the way was folded)")

    for reach in NEAR:
        near = _by_neighbours(job, seen, reach, again)
        if near is None or contradictions(seen, axes(near)) >= MIN_FOLD_PAIRS:
            continue  # what looks alike is so near that it is among the neighbours
        found, tried, facts = _held_against(job, near, reach, again)
        if found is None or len(found.registered) < (KEPT if job.sequential else KEPT_PHOTOS) * len(model.registered):
            break
        if facts["left"] < MIN_FOLD_PAIRS:
            return found, tried, facts | {"contradicting": before}
    return model, attempts, {"contradicting": before, "left": before, "far": int((seen.apart > NEAR[0]).sum()), "dropped": 0}


def _held_against(job: Job, near: Model, reach: int, report: Report) -> tuple[Model | None, list[dict[str, Any]], dict[str, int]]:
    """The model of all that agrees with the one of near neighbours, matched once more where that meets itself, and counts as of
    `without_folds`."""
    with copied(job) as copy:
        match(copy, meetings(near), report)
        every = turns(copy, near.reconstruction.cameras)
        far = every.apart > reach
        false = far & ~(disagreement(every, axes(near)) < AGREES)  # where the near model has no answer a pair is not believed
        _drop(copy, every, false)
        # The near model has drifted along its way. Where that is too much for what meets again to be joined, all is mapped from the start.
        found = joined(copy, near, report)
        tried = [] if found is None else [{"attempt": found.attempt, "models": [len(found.registered)]}]
        if found is None or len(found.registered) < len(near.registered) or not _closed(copy, found, reach):
            found, tried = map_images(copy, report)
    left = 0 if found is None else contradictions(every, axes(found))
    return found, tried, {"left": left, "far": int(far.sum()), "dropped": int(false.sum())}


def _closed(job: Job, model: Model, reach: int) -> bool:
    """Whether what frames far apart share agrees with their cameras, too."""
    shares = [share for share in agreement(job, model, reach).values() if share > 0]
    return bool(shares) and float(np.percentile(shares, 10)) >= CLOSED


def _by_neighbours(job: Job, seen: Turns, reach: int, report: Report) -> Model | None:
    """The model of what images at most `reach` apart share."""
    with copied(job) as copy:
        _drop(copy, seen, seen.apart > reach)
        return map_images(copy, report)[0]


def _calibrated(job: Job, seen: Turns) -> dict[int, pycolmap.Camera]:
    """Cameras by id, their focal lengths by near neighbours (by every pair's fundamental matrix)."""
    with copied(job) as copy:
        _drop(copy, seen, seen.apart > CHAINED)
        calibrate(copy.database, job.seed)
        with opened(copy.database) as database:
            return {camera.camera_id: camera for camera in database.read_all_cameras()}


def turns(job: Job, lenses: Mapping[int, pycolmap.Camera] | None = None) -> Turns:
    """Of all verified pairs of the job's database, with `lenses` by camera id, as a model or a calibration found them, else as guessed."""
    rows = []
    with opened(job.database) as database:
        images = {image.image_id: image for image in database.read_all_images()}
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()} | dict(lenses or {})
        points = {image_id: found[:, :2].astype(np.float64) for image_id, found in keypoints_of(database).items()}
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
            if len(geometry.inlier_matches) < MIN_INLIERS:
                continue
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            pair = cameras[images[a].camera_id], cameras[images[b].camera_id]
            if pycolmap.estimate_two_view_geometry_pose(pair[0], points[a], pair[1], points[b], geometry):
                turn, shared = geometry.cam2_from_cam1.rotation.matrix(), len(geometry.inlier_matches)
                rows.append((int(images[a].name), int(images[b].name), turn, (a, b), shared))
    columns = list(zip(*rows, strict=True)) if rows else [()] * 5
    first, second, ids, number = (np.array(columns[k], dtype=np.int64) for k in (0, 1, 3, 4))
    return Turns(first, second, np.array(columns[2], dtype=np.float64).reshape(-1, 3, 3), ids.reshape(-1, 2), number)


def axes(model: Model) -> dict[int, Array]:
    """(3, 3) camera_from_world rotations of the registered images, by their index."""
    images = (model.reconstruction.image(image_id) for image_id in model.registered)
    return {int(image.name): np.asarray(image.cam_from_world().rotation.matrix()) for image in images}


def chained(seen: Turns, count: int) -> dict[int, Array]:
    """(3, 3) camera_from_world rotations of the first of `count` images and all that hang on it by pairs of near neighbours, as `axes`:
    each by way of the earlier one that it shares most with for the frames between them. They drift, but they are not folded."""
    best: dict[int, dict[int, tuple[float, Array]]] = {}
    for row in np.flatnonzero((seen.apart <= CHAINED) & (seen.apart > 0)):
        i, j, turn = int(seen.first[row]), int(seen.second[row]), seen.turn[row]
        best.setdefault(max(i, j), {})[min(i, j)] = (seen.shared[row] / seen.apart[row], turn if i < j else turn.T)
    known = {0: np.eye(3)}
    for later in range(1, count):
        links = [(share, earlier, turn) for earlier, (share, turn) in best.get(later, {}).items() if earlier in known]
        if links:
            _, earlier, turn = max(links, key=lambda link: link[:2])
            known[later] = turn @ known[earlier]
    return known


def contradicted(seen: Turns, rotations: dict[int, Array]) -> float:
    """Share of the pairs far apart that clearly have another turn than `rotations`, or whose images these do not have; 0: there is no
    such pair."""
    far = seen.apart > NEAR[0]
    return float(np.mean(~(disagreement(seen, rotations)[far] < CONTRADICTS))) if far.any() else 0.0


def disagreement(seen: Turns, rotations: dict[int, Array]) -> Array:
    """(P,) radians between the turn of each pair and that of the cameras at `rotations`; nan where one of the two is missing."""
    off = np.full(len(seen.first), np.nan)
    known = np.array([i in rotations and j in rotations for i, j in zip(seen.first, seen.second, strict=True)], dtype=bool)
    if known.any():
        first, second = (np.array([rotations[int(i)] for i in side[known]]) for side in (seen.first, seen.second))
        rest = seen.turn[known] @ first @ np.swapaxes(second, 1, 2)
        off[known] = np.arccos(np.clip((np.trace(rest, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return off


def contradictions(seen: Turns, rotations: dict[int, Array]) -> int:
    """How many pairs of neighbours have another turn than `rotations`."""
    return int(np.count_nonzero((seen.apart <= NEIGHBOURS) & (disagreement(seen, rotations) > CONTRADICTS)))


def meetings(model: Model) -> list[tuple[int, int]]:
    """Pairs of images far apart whose cameras see much in common from nearly the same side, by the model's own poses: each image's
    best few. On a way that was not known before these are the loops."""
    data = plain(model)
    names, poses = np.array(data["pictures"]), np.array(data["world_from_camera"])
    shares = overlap(poses, [Intrinsics.from_dict(camera) for camera in data["intrinsics"]], depth := guessed_depth(poses))
    score = np.sqrt(shares * shares.T) * (parallax(poses, depth) < WIDEST) * (np.abs(names[:, None] - names[None]) > NEAR[0])
    pairs = set()
    for i, row in enumerate(score):
        for j in np.argsort(-row, kind="stable")[:MEETINGS]:
            if row[j] > COMMON:
                pairs.add((int(min(names[i], names[j])), int(max(names[i], names[j]))))
    return sorted(pairs)


def _drop(job: Job, seen: Turns, which: Array) -> None:
    """Take the pairs `which` (P,) out of the job's database."""
    with opened(job.database) as database, pycolmap.DatabaseTransaction(database):
        for a, b in seen.images[which]:
            database.delete_two_view_geometry(int(a), int(b))


@contextmanager
def copied(job: Job) -> Iterator[Job]:
    """The job in a folder of its own, which goes again: what was matched stays as it is for later runs."""
    folder = Path(job.folder) / "again"
    remove(folder)
    folder.mkdir()
    copy = replace(job, folder=str(folder))
    try:
        shutil.copyfile(job.database, copy.database)
        yield copy
    finally:
        remove(folder)
