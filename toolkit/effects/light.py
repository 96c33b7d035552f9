"""Which of exposure and vignetting explain the light of shared points, judged by points that took no part in the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.effects.evidence import ROUNDS, Evidence, Finding, robust_weights, without_points_and_frames
from fieldfuse.tone import share

EXPOSURE, VIGNETTING = "exposure", "vignetting"
DARKEST, BRIGHTEST = 0.01, 0.85  # linear light between which a color shows its exposure: not noise, not clipped
DRIFTS, DIMS = 0.04, 0.05  # thresholds: stops; share of the light that corners lose
FEWEST_GAINS, FEWEST_FALLS = 30, 60  # observations without which nothing is known of exposure and of vignetting
STRONGEST = 20.0  # of a in V(r) = (1 + a·r²)⁻²: a corner with a four-hundredth of the light
HELD_OUT = 4  # every n-th point is held out of the fits
MARGIN = {EXPOSURE: 0.24, VIGNETTING: 0.1}  # least relative fall of the held-out deviation: less did not pay on real captures
BOTH = 0.25  # … by both: each hides some of the other, so that alone neither may come as far as it does beside the other
MIN_FALL = 0.0015  # stops by which it has to fall at least
FEWEST_POINTS = 10  # that a held-out frame's gain is measured by
TORN, TORN_BY = 1.5, 0.1  # times the usual disagreement of points about a frame's gain, and stops, from which it is doubtful …
APART = 0.2  # … if it lies so many stops outside of its neighbours' gains as well


@dataclass(frozen=True)
class LightTracks:
    """Colors of points that several images show, one row an observation."""

    linear: Array  # (O, 3) linear light
    frame: Array  # (O,) int, 0 … F − 1
    point: Array  # (O,) int, 0 … P − 1
    radius: Array  # (O,) distance from the principal point in half diagonals

    def rows(self, keep: Array) -> LightTracks:
        """The observations `keep` (O,) bool, points numbered anew."""
        point = np.unique(self.point[keep], return_inverse=True)[1]
        return LightTracks(self.linear[keep], self.frame[keep], point, self.radius[keep])

    def usable(self) -> LightTracks:
        """Without what is too dark or clipped, and without points that are then seen only once."""
        keep = self.exposed()
        counts = np.bincount(self.point[keep], minlength=int(self.point.max(initial=-1)) + 1)
        return self.rows(keep & (counts[self.point] > 1))

    def exposed(self) -> Array:
        """(O,) bool: neither too dark nor clipped."""
        return np.asarray(((self.linear > DARKEST) & (self.linear < BRIGHTEST)).all(1))

    def without_vignetting(self, corner: float) -> LightTracks:
        """With a vignetting of this corner taken out: points that move towards the corners of one frame get darker in it as if it were
        exposed less. (The other way round there is nothing to do: frames' gains are taken out.)"""
        return replace(self, linear=self.linear / share(corner, self.radius**2)[:, None])


@dataclass(frozen=True)
class Light:
    """What was found about the light of shared points."""

    evidence: dict[str, Evidence]
    kept: frozenset[str]
    before: dict[str, float]  # stops: the deviation of held-out points without the effect, beside what else is kept
    after: dict[str, float]  # and with it
    corner: float  # share of the light that is left at half a diagonal

    def finding(self, name: str) -> Finding:
        """About exposure or vignetting."""
        one = self.evidence[name]
        return Finding(name, one.number, one.threshold, one.reason, name in self.kept, self.before[name], self.after[name], "stops")


def exposure_evidence(tracks: LightTracks, frames: int) -> Evidence:
    """Whether frames differ in exposure or white balance: the deviation over the frames of the gains by which shared points agree.

    The gains' own uncertainty is taken off the deviation. `parameters["gain"]` are (frames, 3) gains with geometric mean 1.
    """
    used = tracks.usable()
    if len(used.frame) < FEWEST_GAINS:
        return Evidence(EXPOSURE, 0.0, DRIFTS, "too few points are shared between pictures to compare their exposure")
    light, weight = np.log2(used.linear), np.ones(len(used.frame))
    constants = np.zeros((frames, 3))
    for _ in range(ROUNDS):
        left, constants = without_points_and_frames(light, used.frame, used.point, weight, frames)
        weight = robust_weights(left)
    seen = np.bincount(used.frame, weight, frames)
    noise = (weight[:, None] * left**2).sum(0) / max(float(weight.sum()), 1e-9)  # (3,) variance of one observation
    known = seen > 0
    chance = (noise / np.maximum(seen[known, None], 1)).mean(0)
    number = float(np.sqrt(np.maximum((constants[known] ** 2).mean(0) - chance, 0)).max())
    reason = f"the same points differ by {number:.3f} stops (deviation over frames) between pictures; {DRIFTS:g} or more speak for drift"
    return Evidence(EXPOSURE, number, DRIFTS, reason, {"gain": np.exp2(constants).tolist()})


def vignetting_evidence(tracks: LightTracks, frames: int) -> Evidence:
    """Whether points get darker as they move towards the corners, in whichever frame: the share of light lost at half a diagonal.

    a of V(r) = (1 + a·r²)⁻² is found by Gauss-Newton after each point's and each frame's own light is taken out; three standard errors
    are taken off the loss. `parameters["corner"]` is V(1).
    """
    used = tracks.usable()
    if len(used.frame) < FEWEST_FALLS:
        return Evidence(VIGNETTING, 0.0, DIMS, "too few points are shared between pictures to compare middle and corners")
    light = np.log2(used.linear).mean(1)
    square, weight, a, error = used.radius**2, np.ones(len(used.frame)), 0.0, np.inf
    for _ in range(2 * ROUNDS):
        expected = -2 * np.log2(1 + a * square)
        slope = -2 / np.log(2) * square / (1 + a * square)
        left, _ = without_points_and_frames(np.stack([light - expected, slope], axis=1), used.frame, used.point, weight, frames)
        bend = float((weight * left[:, 1] ** 2).sum())
        if bend < 1e-9:  # no point moves towards the corner
            break
        step = float((weight * left[:, 0] * left[:, 1]).sum()) / bend
        rest = left[:, 0] - step * left[:, 1]
        error = float(np.sqrt((weight * rest**2).sum() / weight.sum() / bend))
        a = float(np.clip(a + step, -0.5, STRONGEST))
        weight = robust_weights(rest)
    sure = a - 3 * error if np.isfinite(error) else 0.0
    number = float(1 - (1 + max(sure, 0.0)) ** -2)
    reason = (
        f"points lose at least {100 * number:.0f}% of their light on the way to the corner; {100 * DIMS:g}% or more speak for vignetting"
    )
    return Evidence(VIGNETTING, number, DIMS, reason, {"corner": float((1 + max(a, 0.0)) ** -2)})


def explain(tracks: LightTracks, frames: int) -> Light:
    """Evidence of both, and which of them help held-out points by a margin, alone or together."""
    out = tracks.point % HELD_OUT == HELD_OUT // 2
    fit, held = tracks.rows(~out), tracks.rows(out)
    falloff = vignetting_evidence(fit, frames)
    corner = float(falloff.parameters.get("corner", 1.0))
    deviations: dict[frozenset[str], float] = {}
    found: dict[frozenset[str], Evidence] = {}
    for base in (frozenset[str](), frozenset({VIGNETTING})):
        flat, flat_held = (one.without_vignetting(corner) if base else one for one in (fit, held))
        found[base] = exposure_evidence(flat, frames)
        gain = np.array(found[base].parameters.get("gain", np.ones((frames, 3))))
        deviations[base] = spread(flat_held)
        deviations[base | {EXPOSURE}] = spread(replace(flat_held, linear=flat_held.linear / gain[flat_held.frame]))
    allowed = [
        kept
        for kept in deviations
        if (VIGNETTING not in kept or falloff.found) and (EXPOSURE not in kept or found[kept - {EXPOSURE}].found)
    ]
    margin = {kept: BOTH if len(kept) > 1 else sum(MARGIN[name] for name in kept) for kept in allowed}
    kept = min(allowed, key=lambda one: deviations[one] / (1 - margin[one]) + MIN_FALL * len(one))
    final = vignetting_evidence(tracks, frames)
    corner = float(final.parameters.get("corner", 1.0))
    drift = exposure_evidence(tracks.without_vignetting(corner) if VIGNETTING in kept else tracks, frames)
    return Light(
        evidence={EXPOSURE: drift, VIGNETTING: final},
        kept=kept,
        before={name: deviations[kept - {name}] for name in (EXPOSURE, VIGNETTING)},
        after={name: deviations[kept | {name}] for name in (EXPOSURE, VIGNETTING)},
        corner=corner,
    )


def spread(tracks: LightTracks) -> float:
    """Stops: robust deviation of points' light between the images that show them; 0 when there are none."""
    used = tracks.usable()
    if not len(used.frame):
        return 0.0
    light = np.log2(used.linear)
    points = int(used.point.max()) + 1
    order = np.lexsort((light.mean(1), used.point))
    starts = np.searchsorted(used.point[order], np.arange(points))
    middle = light[order[starts + np.bincount(used.point, minlength=points) // 2]]  # the observation of median light
    return float(1.4826 * np.median(np.abs(light - middle[used.point]).max(1)))


def frame_gains(tracks: LightTracks, frames: int, train: Array) -> tuple[Array, list[int]]:
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
    mine = tracks.rows(train[tracks.frame])
    inner = exposure_evidence(replace(mine, frame=number[mine.frame]), int(train.sum()))
    if "gain" not in inner.parameters:
        return gain, []
    gain[train] = np.array(inner.parameters["gain"])
    points = int(tracks.point.max(initial=-1)) + 1
    bright = tracks.exposed()
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
