"""Poses that come with a capture are held against its images.

Measured is the share of matches that agree with the epipolar geometry of the given poses, of matches that were found and verified without
these (`two_view`). Right poses reach 0.7 to 1 where wrong ones mostly stay below 0.5. Where the share is low, other readings of the poses
are tried (`mistakes`): one that clearly fits, on pairs that had no part in choosing it too, is used. Poses that no reading saves are
refused if the evidence is strong: many pairs with parallax, most of which contradict even the rough motion. Noisy poses pass.
Single cameras that all of their matches contradict are excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.types import Capture
from fieldfuse.errors import PoseError
from fieldfuse.poses.mistakes import Reading, readings, refocused
from fieldfuse.poses.points import Features
from fieldfuse.poses.result import PoseResult, listed
from fieldfuse.poses.two_view import Matches, deviation, find_matches, roughly_right
from fieldfuse.progress import SILENT, Progress

VERSION = 1  # of what is found; a change makes runs look again
AS_IS = "as_is"
MOST_IMAGES = 30  # that are matched at first
MOST_SEARCHED = 300  # images that are matched when some of the first were wrong
RUN = 3  # images next to each other that are looked at together
NEAR = 8 / 3  # tolerances: so far off, poses are inexact rather than wrong
FITS = 0.6  # share of matches that agree from which poses are taken as right
BETTER = 0.25  # by which another reading must beat the given one
CLEARLY = 0.1  # by which it must beat the next best of another geometry; where nearly all agrees less is enough (`BARELY`)
BARELY = 0.03
LENS, BETTER_LENS = 0.85, 0.1  # share below which another focal length is tried though the poses fit, and by how much it must be better
PLATEAU = 0.01  # of the score within which focal lengths fit alike
ROUGH = 0.4  # of the pairs with parallax: fewer that agree roughly with the poses contradict them (noise of 3° leaves 0.7)
EXACT = 0.8  # median of the pairs' shares from which what is only nearly right stands out as wrong
FEW_PAIRS = 6  # pairs with parallax that a refusal needs
LEAST_MATCHES = 100  # below which nothing is concluded
WRONG, RIGHT = 0.3, 0.5  # share of a pair's matches that agree: below, the pair contradicts its poses; above, it confirms them
MOST_WRONG = 0.2  # share of the cameras that may be excluded
OUTLYING = 20.0  # times the median distance of cameras from their middle
LOST = 100.0  # the same, of cameras that are excluded if no match confirms them
SUSPECTS = 8  # images that are looked at because their poses are odd
SAME_TURN, SAME_WAY = 1.0, 5.0  # degrees within which two readings are one geometry


@dataclass(frozen=True)
class Agreement:
    """How well poses fit matches."""

    share: float  # of matches that agree within the tolerance
    matches: int
    pairs: int

    def __str__(self) -> str:
        return f"matches agree with the poses: {self.share:.0%} of {self.matches:,} in {self.pairs} pairs"


def check_given(
    capture: Capture,
    given: PoseResult,
    convention: str = "auto",
    progress: Progress = SILENT,
    known: dict[str, Features] | None = None,
) -> PoseResult:
    """The poses as they fit the images, with warnings of what was changed or excluded; `agreement` is how well they fit.

    Args:
        convention: `as_is` keeps the poses whatever is found; the warning stays.
        known: features by name; those found are added.

    Raises:
        PoseError: the poses contradict the images, and no other reading of them fits.
    """
    known = {} if known is None else known
    by_name = {frame.name: frame for frame in capture.frames}
    posed = capture.with_frames(
        [replace(by_name[name], intrinsics=camera) for name, camera in zip(given.names, given.intrinsics, strict=True)]
    )
    poses, keep_all = given.world_from_camera, convention == AS_IS
    twins = same_poses(poses)
    chosen = choose_images(poses, twins)
    matches = find_matches(posed, chosen, _links(chosen, twins), progress=progress, known=known)
    checked, agreement, reading = given, _agreement(poses[chosen], matches), None
    if agreement.matches < LEAST_MATCHES:
        return _leave_out(given, _outlying(poses, chosen, matches), set(), keep_all)[0]
    if agreement.share < FITS and not _few_wrong(poses[chosen], matches, twins[chosen]):
        reading, guess = _other_reading(posed, poses, chosen, matches)
        if reading is None:
            return _told(_doubt(capture, given, agreement, poses[chosen], matches, guess, keep_all), agreement)
    elif agreement.share < LENS:
        reading, _ = _other_reading(posed, poses, chosen, matches, lens_alone=True)
    if reading is not None:
        if keep_all:
            text = f"{_low(agreement)} of {_what(capture)}, and more would {reading.text}; they are kept as they came"
            return _told(given.warned(text), agreement)
        before, matches = agreement, _seen_by(reading, matches, posed, chosen)
        agreement = _agreement(reading.poses[chosen], matches)
        checked = _read_so(given, reading).warned(
            f"the poses of {_what(capture)} do not fit its images as they came ({before.share:.0%} of {before.matches:,} matches agree); "
            f"they fit {reading.text} ({agreement.share:.0%} agree), and are used so; --set poses.convention=as_is keeps them as they came"
        )
        poses = checked.world_from_camera
    wrong = [chosen[i] for i in _contradicted(poses[chosen], matches)]
    if wrong and reading is None and len(chosen) < len(poses) <= MOST_SEARCHED:
        everyone = list(range(len(poses)))
        matches = find_matches(posed, everyone, alike=chosen, progress=progress, known=dict(known))
        chosen, wrong = everyone, _contradicted(poses, matches)
    wrong = sorted({*wrong, *_twins_of(wrong, twins, chosen), *_outlying(poses, chosen, matches)})
    checked, out = _leave_out(checked, wrong, {int(i) for i in np.flatnonzero(twins >= 0)}, keep_all)
    rest = matches.subset(matches.without(np.isin(chosen, out)))
    return _told(checked, _agreement(poses[chosen], rest), reading)


def _told(result: PoseResult, agreement: Agreement, reading: Reading | None = None) -> PoseResult:
    return replace(result, agreement={**asdict(agreement), "reading": None if reading is None else reading.text})


def best_fitting(captures: Sequence[Capture], progress: Progress = SILENT) -> int:
    """Of several captures with the same images and poses from different sources, the one whose poses fit best; of equals the first."""
    scores = []
    for capture in captures:
        posed = [i for i, frame in enumerate(capture.frames) if frame.world_from_camera is not None and frame.intrinsics is not None]
        poses = np.array([capture.frames[i].world_from_camera for i in posed], dtype=np.float64).reshape(-1, 4, 4)
        chosen = choose_images(poses, same_poses(poses)) if len(poses) > 1 else []
        matches = find_matches(capture, [posed[i] for i in chosen], progress=progress)
        scores.append(_score(poses[chosen], matches) if len(matches.pair) >= LEAST_MATCHES else 0.0)
    return int(np.argmax(scores))


# ------------------------------------------------------------------------------------------------- which images


def same_poses(poses: Array) -> Array:
    """(N,) number of the group of cameras with one and the same pose that each is in; -1 for those that are in none."""
    _, group, count = np.unique(np.round(poses[:, :3].reshape(len(poses), -1), 9), axis=0, return_inverse=True, return_counts=True)
    group = np.asarray(group).ravel()
    return np.where(count[group] > 1, group, -1)


def choose_images(poses: Array, twins: Array) -> list[int]:
    """Up to about `MOST_IMAGES` images: all, or short runs spread over the capture, and with their neighbours those whose poses are odd."""
    count = len(poses)
    if count <= MOST_IMAGES:
        return list(range(count))
    centres = poses[:, :3, 3]
    jump = np.zeros(count)
    jump[1:-1] = np.linalg.norm(centres[1:-1] - 0.5 * (centres[:-2] + centres[2:]), axis=1)
    far = _distances(centres)
    odd = [i for group in np.unique(twins[twins >= 0]) for i in np.flatnonzero(twins == group)[:3]][:SUSPECTS]
    odd += [int(i) for i in np.argsort(-far, kind="stable")[:2] if far[i] > OUTLYING]
    odd += [int(i) for i in np.argsort(-jump, kind="stable")[:2]]
    near = {j for i in odd for j in (i - 1, i, i + 1) if 0 <= j < count}
    runs = max(2, (MOST_IMAGES - len(near)) // RUN)
    starts = np.linspace(0, count - RUN, runs).round().astype(int)
    return sorted(near | {int(start) + step for start in starts for step in range(RUN)})


def _links(chosen: list[int], twins: Array) -> list[tuple[int, int]]:
    """Pairs of cameras to which the capture gives one pose."""
    groups = [[position for position, index in enumerate(chosen) if twins[index] == group] for group in np.unique(twins[twins >= 0])]
    return [(group[0], other) for group in groups for other in group[1 : 1 + SUSPECTS]]


def _distances(centres: Array) -> Array:
    """(N,) distance of each camera from their middle, in medians of it."""
    distance = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    return np.asarray(distance / max(float(np.median(distance)), 1e-300))


# ------------------------------------------------------------------------------------------------- what fits


def _agreement(poses: Array, matches: Matches) -> Agreement:
    off = deviation(poses, matches) if len(matches.pair) else np.zeros(0)
    return Agreement(float(np.mean(off < 1)) if len(off) else 0.0, len(off), len(matches.pairs))


def _score(poses: Array, matches: Matches) -> float:
    """Mean of the shares that agree and that nearly agree: noise in otherwise right poses costs part of it."""
    off = deviation(poses, matches)
    return 0.5 * float(np.mean(off < 1) + np.mean(off < NEAR))


def _seen_by(reading: Reading, matches: Matches, posed: Capture, chosen: Sequence[int]) -> Matches:
    """The matches as the cameras of a reading see them."""
    if reading.focal == 1 and not reading.centred:
        return matches
    cameras = [posed.frames[i].intrinsics for i in chosen]
    shift = np.array([[(c.cx - c.width / 2) / c.fx, (c.cy - c.height / 2) / c.fy] for c in cameras if c is not None])
    return matches.refocused(reading.focal, shift if reading.centred else np.zeros_like(shift))


def _other_reading(
    posed: Capture, poses: Array, chosen: list[int], matches: Matches, lens_alone: bool = False
) -> tuple[Reading | None, Reading | None]:
    """The reading of the poses that clearly fits, if one does; and the best guess, if there is one. With `lens_alone` only other focal
    lengths are tried. Where there is depth, they are not: it may be of the same camera."""
    first = np.arange(len(matches.pairs)) % 2 == 0
    choosing, proving = matches.subset(first), matches.subset(~first)
    if len(proving.pair) == 0:
        return None, None
    better = BETTER_LENS if lens_alone else BETTER
    found = [r for r in readings(poses, posed.kind) if (not lens_alone and not r.of_lens) or (r.of_lens and not posed.has_depth)]
    if not found:
        return None, None
    scores = np.array([_score(r.poses[chosen], _seen_by(r, choosing, posed, chosen)) for r in found])
    best = int(scores.argmax())
    winner = found[best]
    given = _score(poses[chosen], choosing)
    if scores[best] < given + better:
        return None, None
    if winner.focal != 1:  # what fits is a range of focal lengths, of which the middle is taken
        alike = [r.focal for r, s in zip(found, scores, strict=True) if r.centred == winner.centred and s > scores[best] - PLATEAU]
        winner = refocused(winner, float(np.exp(np.mean(np.log(alike)))))
    rivals = [s for r, s in zip(found, scores, strict=True) if not _same(r, winner, chosen, matches)]
    margin = min(CLEARLY, BARELY + 1 - scores[best])
    clear = scores[best] >= FITS and scores[best] > max(rivals, default=0.0) + margin
    proof = _score(winner.poses[chosen], _seen_by(winner, proving, posed, chosen))
    proven = proof >= FITS and proof > _score(poses[chosen], proving) + better
    return (winner if clear and proven else None), (winner if scores[best] >= 0.5 else None)


def _same(one: Reading, other: Reading, chosen: list[int], matches: Matches) -> bool:
    """Whether two readings are nearly the same geometry of the matched pairs."""
    if one is other or (one.of_lens and other.of_lens):
        return True
    i, j = matches.pairs.T
    moved = [invert(r.poses[chosen][j]) @ r.poses[chosen][i] for r in (one, other)]
    cosine = (np.einsum("nij,nij->n", moved[0][:, :3, :3], moved[1][:, :3, :3]) - 1) / 2
    ways = [m[:, :3, 3] / np.maximum(np.linalg.norm(m[:, :3, 3], axis=1), 1e-300)[:, None] for m in moved]
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    way = np.degrees(np.arccos(np.clip((ways[0] * ways[1]).sum(axis=1), -1, 1)))
    return bool(np.median(turn) < SAME_TURN and np.median(way) < SAME_WAY)


def _read_so(given: PoseResult, reading: Reading) -> PoseResult:
    """The result by another reading. Points of the source may belong to the poses as they came, so they go."""

    def lens(camera: Intrinsics) -> Intrinsics:
        camera = replace(camera, fx=camera.fx * reading.focal, fy=camera.fy * reading.focal)
        return replace(camera, cx=camera.width / 2, cy=camera.height / 2) if reading.centred else camera

    return replace(given, intrinsics=[lens(camera) for camera in given.intrinsics], world_from_camera=reading.poses, points=None)


def _doubt(
    capture: Capture, given: PoseResult, agreement: Agreement, poses: Array, matches: Matches, guess: Reading | None, keep_all: bool
) -> PoseResult:
    """Poses that do not fit and that no other reading saves: refused if the evidence is strong, else with a warning."""
    rough = roughly_right(poses, matches)
    other = f"; they would fit better {guess.text}, but not clearly" if guess is not None else ""
    strong = len(rough) >= FEW_PAIRS and rough.mean() < ROUGH and agreement.share < RIGHT
    if strong and not keep_all:
        raise PoseError(
            f"the poses that come with {capture.root} do not fit its images: {agreement.share:.0%} of {agreement.matches:,} matches in "
            f"{agreement.pairs} pairs agree with them, {rough.mean():.0%} of {len(rough)} pairs with the motion{other}; correct them, or "
            f"find own poses with --poses sfm"
        )
    if agreement.share >= RIGHT and not strong:
        return given
    noisy = len(rough) >= FEW_PAIRS and rough.mean() > 1 - ROUGH
    inexact = "are inexact, and refined as far as the images allow" if noisy else "may be inexact or wrong"
    what = "are kept as they came" if strong else inexact
    return given.warned(f"{_low(agreement)} of {_what(capture)}{other}: they {what}; --poses sfm finds own ones")


def _low(agreement: Agreement) -> str:
    return f"only {agreement.share:.0%} of {agreement.matches:,} matches agree with the poses"


def _what(capture: Capture) -> str:
    return str(capture.root.name or capture.root)


# ------------------------------------------------------------------------------------------------- single cameras


def _few_wrong(poses: Array, matches: Matches, twins: Array) -> bool:
    """Whether the poses fit once a few wrong ones, or those that several images share (`twins` (N,) from 0), are left aside."""
    wrong = _contradicted(poses, matches)
    rest = matches.subset(matches.without(np.isin(np.arange(len(poses)), wrong)))
    single = [i for i in wrong if twins[i] < 0]
    return len(single) <= MOST_WRONG * len(poses) and len(rest.pair) >= LEAST_MATCHES and _agreement(poses, rest).share >= FITS


def _contradicted(poses: Array, matches: Matches) -> list[int]:
    """Images whose verified pairs all contradict their poses, found one after the other: who is contradicted by a wrong one only stays."""
    if len(matches.pair) == 0:
        return []
    off = deviation(poses, matches)
    share, near = matches.by_pair(off < 1), matches.by_pair(off < NEAR)
    one = np.abs(poses[matches.pairs[:, 0]] - poses[matches.pairs[:, 1]]).max(axis=(1, 2)) < 1e-9
    # Two images with one pose are the same image, or one of the poses is wrong; whether a third is right does not follow from them.
    within = share if np.median(share) >= EXACT else near
    against = np.where(one, share < RIGHT, within < WRONG)
    confirms = (within >= RIGHT) & ~one
    alive = np.ones(len(matches.pairs), dtype=bool)
    out: list[int] = []
    while True:
        bad = np.bincount(matches.pairs[alive & against].ravel(), minlength=len(poses))
        good = np.bincount(matches.pairs[alive & confirms].ravel(), minlength=len(poses))
        bad[good > 0] = 0
        worst = int(bad.argmax())
        if bad[worst] < 2:
            return sorted(out)
        out.append(worst)
        alive &= (matches.pairs != worst).all(axis=1)


def _twins_of(wrong: list[int], twins: Array, chosen: list[int]) -> list[int]:
    """Images that were not looked at and have the very pose of others, all of which are wrong."""
    bad, seen = set(wrong), set(chosen)
    groups = {int(twins[i]) for i in wrong if twins[i] >= 0}
    groups = {g for g in groups if all(int(i) in bad for i in np.flatnonzero(twins == g) if int(i) in seen)}
    return [int(i) for g in groups for i in np.flatnonzero(twins == g) if int(i) not in seen]


def _outlying(poses: Array, chosen: list[int], matches: Matches) -> list[int]:
    """Cameras absurdly far from the others that no match confirms."""
    far = _distances(poses[:, :3, 3])
    off = deviation(poses[chosen], matches) if len(matches.pair) else np.zeros(0)
    held = {chosen[int(i)] for i in matches.pairs[matches.by_pair(off < 1) >= FITS].ravel()} if len(off) else set()
    return [int(i) for i in np.flatnonzero(far > LOST) if int(i) not in held]


def _leave_out(given: PoseResult, wrong: list[int], twins: set[int], keep_all: bool) -> tuple[PoseResult, list[int]]:
    """The result without the cameras `wrong`, where these are few, or have one pose for different images (`twins`)."""
    count = len(given.names)
    if not wrong or count - len(wrong) < 2:
        return given, []
    if len([i for i in wrong if i not in twins]) > MOST_WRONG * count or keep_all:
        text = f"the images contradict the poses of {len(wrong)} of {count} frames, which are kept"
        return given.warned(f"{text}: {listed([given.names[i] for i in wrong])}"), []
    keep = [i for i in range(count) if i not in set(wrong)]
    names = [given.names[i] for i in wrong]
    same = sum(i in twins for i in wrong)
    why = f" ({same} of them have one and the same pose for different images)" if same else ""
    text = f"{len(wrong)} of {count} frames are left out because the images contradict their poses{why}: {listed(names)}"
    return replace(
        given,
        registered=len(keep),
        names=[given.names[i] for i in keep],
        intrinsics=[given.intrinsics[i] for i in keep],
        world_from_camera=given.world_from_camera[keep],
        models=[len(keep)],
        missing=[*given.missing, *names],
    ).warned(text), wrong
