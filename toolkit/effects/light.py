"""Which of exposure and vignetting explain the light of shared points, judged by points that took no part in the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.effects import exposure, vignetting
from fieldfuse.effects.evidence import BRIGHTEST, DARKEST, Evidence, Tracks

EXPOSURE, VIGNETTING = "exposure", "vignetting"
HELD_OUT = 4  # every so manieth point is kept out of the fits
MARGIN = {EXPOSURE: 0.24, VIGNETTING: 0.1}  # least relative fall of the held-out deviation: less did not pay on real pictures
BOTH = 0.25  # … by both: each hides some of the other, so that alone neither may come as far as it does beside the other
MIN_FALL = 0.0015  # stops by which it has to fall at least
FEWEST_POINTS = 10  # that a held-out frame's gain is measured by
TORN, TORN_BY = 1.5, 0.1  # times the usual disagreement of points about a frame's gain, and stops, from which it is doubtful …
APART = 0.2  # … if it lies so many stops outside of its neighbours' gains as well


@dataclass(frozen=True)
class Light:
    """What was found about the light of shared points.

    Attributes:
        gain: (frames, 3) gains of the frames, geometric mean 1, with the vignetting taken out first when it is kept.
        corner: share of the light that is left at half a diagonal.
        before, after: stops, the deviation of held-out points without the effect and with it, beside what else is kept.
    """

    evidence: dict[str, Evidence]
    kept: frozenset[str]
    before: dict[str, float]
    after: dict[str, float]
    gain: Array
    corner: float

def explain(tracks: Tracks, frames: int) -> Light:
    """Evidence of both, and which of them help held-out points by a margin, alone or together."""
    out = tracks.point % HELD_OUT == HELD_OUT // 2
    fit, held = _rows(tracks, ~out), _rows(tracks, out)
    falloff = vignetting.evidence(fit, frames)
    corner = float(falloff.parameters.get("corner", 1.0))
    deviations: dict[frozenset[str], float] = {}
    found: dict[frozenset[str], Evidence] = {}
    for bent in (False, True):
        base = frozenset({VIGNETTING} if bent else ())
        flat = vignetting.corrected(fit, corner) if bent else fit
        flat_held = vignetting.corrected(held, corner) if bent else held
        drift = exposure.evidence(flat, frames)
        gain = np.array(drift.parameters.get("gain", np.ones((frames, 3))))
        found[base] = drift
        deviations[base] = spread(flat_held)
        deviations[base | {EXPOSURE}] = spread(replace(flat_held, linear=flat_held.linear / gain[flat_held.frame]))
    allowed = [
        kept
        for kept in deviations
        if (VIGNETTING not in kept or falloff.found) and (EXPOSURE not in kept or found[kept - {EXPOSURE}].found)
    ]
    kept = min(allowed, key=lambda one: deviations[one] / (1 - _margin(one)) + MIN_FALL * len(one))
    final = vignetting.evidence(tracks, frames)
    corner = float(final.parameters.get("corner", 1.0))
    drift = exposure.evidence(vignetting.corrected(tracks, corner) if VIGNETTING in kept else tracks, frames)
    return Light(
        evidence={EXPOSURE: drift, VIGNETTING: final},
        kept=kept,
        before={name: deviations[kept - {name}] for name in (EXPOSURE, VIGNETTING)},
        after={name: deviations[kept | {name}] for name in (EXPOSURE, VIGNETTING)},
        gain=np.array(drift.parameters.get("gain", np.ones((frames, 3)))),
        corner=corner,
    )


def _margin(kept: frozenset[str]) -> float:
    """By what share the held-out deviation has to fall for all of `kept` to be corrected."""
    return BOTH if len(kept) > 1 else MARGIN[next(iter(kept))] if kept else 0.0


def spread(tracks: Tracks) -> float:
    """Stops: robust deviation of points' light between the pictures that show them; 0 when there are none."""
    used = tracks.usable()
    if not len(used.frame):
        return 0.0
    light = np.log2(used.linear)
    points = int(used.point.max()) + 1
    order = np.lexsort((light.mean(1), used.point))
    starts = np.searchsorted(used.point[order], np.arange(points))
    counts = np.bincount(used.point, minlength=points)
    middle = light[order[starts + counts // 2]]  # the observation of median light
    return float(1.4826 * np.median(np.abs(light - middle[used.point]).max(1)))


def frame_gains(tracks: Tracks, frames: int, train: Array) -> tuple[Array, list[int]]:
    """Gains of training frames from the points that they share, with geometric mean 1; of others by comparison with these.

    A frame that is held out has its neighbours' gain (exposure changes smoothly) where it shows too few of the points, or where these
    disagree about it and together put it outside of what its neighbours have: it plays no part in what the training frames agree on.

    Args:
        train: (frames,) bool.

    Returns:
        (frames, 3), and the held-out frames whose gain is their neighbours' although they show enough points.
    """
    gain = np.ones((frames, 3))
    number = np.cumsum(train) - 1
    mine = _rows(tracks, train[tracks.frame])
    inner = exposure.evidence(replace(mine, frame=number[mine.frame]), int(train.sum()))
    if "gain" not in inner.parameters:
        return gain, []
    gain[train] = np.array(inner.parameters["gain"])
    points = int(tracks.point.max(initial=-1)) + 1
    bright = ((tracks.linear > DARKEST) & (tracks.linear < BRIGHTEST)).all(1)
    light = np.log2(np.maximum(tracks.linear, 1e-6)) - np.log2(gain[tracks.frame])
    known = train[tracks.frame] & bright
    count = np.bincount(tracks.point[known], minlength=points)
    mean = np.stack([np.bincount(tracks.point[known], light[known, c], points) for c in range(3)], axis=1) / np.maximum(count[:, None], 1)
    compared = bright & (count[tracks.point] > 0)
    off = light - mean[tracks.point]

    def disagreement(frame: int) -> float:
        mine = off[(tracks.frame == frame) & compared]
        return float(np.median(np.abs(mine - np.median(mine, axis=0)))) if len(mine) >= FEWEST_POINTS else np.inf

    trained, borrowed = np.flatnonzero(train), []
    usual = float(np.median([disagreement(int(frame)) for frame in trained])) if len(trained) else 0.0
    for frame in np.flatnonzero(~train):
        near = trained[np.argsort(np.abs(trained - frame), kind="stable")[:2]]
        theirs = np.log2(gain[near])
        rows = (tracks.frame == frame) & compared
        found = np.median(off[rows], axis=0) if rows.sum() >= FEWEST_POINTS else None
        if found is not None and len(near):
            beyond = np.maximum(found - theirs.max(0), theirs.min(0) - found).max()
            if beyond > APART and disagreement(int(frame)) > max(TORN * usual, TORN_BY):
                borrowed.append(int(frame))
                found = None
        if found is not None or len(near):
            gain[frame] = np.exp2(theirs.mean(0) if found is None else found)
    return gain, borrowed


def _rows(tracks: Tracks, keep: Array) -> Tracks:
    point = np.unique(tracks.point[keep], return_inverse=True)[1]
    return Tracks(tracks.linear[keep], tracks.frame[keep], point, tracks.radius[keep])
