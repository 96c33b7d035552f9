"""All evidence of a posed capture at once, and what is decided from it before anything is fitted."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.effects import geometry, light
from fieldfuse.effects.adjust import LENS, POSES, ROWS, predict
from fieldfuse.effects.evidence import BLUR, Finding, blur_evidence
from fieldfuse.effects.far_background import find_far_background
from fieldfuse.effects.light import EXPOSURE, VIGNETTING
from fieldfuse.effects.specularity import find_specularity
from fieldfuse.effects.tracks import QUICK, Look, Tracks, choose, gather
from fieldfuse.progress import SILENT, Progress

VIEWS, FAR = "view_dependence", "background"
ORDER = (EXPOSURE, VIGNETTING, LENS, ROWS, VIEWS, FAR, BLUR, POSES)
POINTS = "points"  # finding and matching what images share, which all effects are found by
MOST_FRAMES = 40  # that are looked at closely
FIRST_FRAMES = 16  # of a first, quick look; when nothing in it comes near to speaking for an effect, it is the last
CLOSE = 0.6  # share of a threshold or margin from which on it does


class Timing:
    """Adds up the wall-clock seconds spent on each effect. What is tried for several at once is split evenly between them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def by(self, *effects: str) -> Iterator[None]:
        """Counts what is done inside; calls must not be nested."""
        began = time.monotonic()
        try:
            yield
        finally:
            share = (time.monotonic() - began) / len(effects)
            for effect in effects:
                self.seconds[effect] = self.seconds.get(effect, 0.0) + share

    def of(self, effect: str) -> float:
        """Seconds, to the millisecond."""
        return round(self.seconds.get(effect, 0.0), 3)


@dataclass(frozen=True)
class Diagnostics:
    """Everything that was found."""

    findings: dict[str, Finding]  # in the order of `ORDER`
    seen: Tracks | None
    explained: geometry.Explained | None
    light: light.Light | None
    sharpness: Array  # (F,) factors of two of the slopes' energy
    seconds: float
    facts: dict[str, Any] = field(default_factory=dict)
    timing: Timing = field(default_factory=Timing)

    @property
    def there(self) -> frozenset[str]:
        return frozenset(name for name, finding in self.findings.items() if finding.there)


def diagnose(
    capture: Capture,
    indices: list[int] | None = None,
    progress: Progress = SILENT,
    known: dict[int, Look] | None = None,
    quick: bool = True,
) -> Diagnostics:
    """Look at a posed capture.

    Args:
        indices: the frames that may be looked at (training frames); None: all.
        known: what is found in images, for `gather`.
        quick: begin with a quick look at few images, and end there when nothing speaks for any effect.

    Raises:
        InputError: an image cannot be read.
    """
    began, timing = time.monotonic(), Timing()
    allowed = list(range(len(capture.frames))) if indices is None else list(indices)
    if quick and len(allowed) > FIRST_FRAMES:
        with timing.by(POINTS):
            tracks = gather(capture, [allowed[k] for k in choose(len(allowed), FIRST_FRAMES)], progress, QUICK)
        first = diagnose_tracks(tracks, began, timing)
        if first.explained is not None and not any(near_to(finding) for finding in first.findings.values()):
            return first
    with timing.by(POINTS):
        tracks = gather(capture, [allowed[k] for k in choose(len(allowed), MOST_FRAMES)], progress, known=known)
    return diagnose_tracks(tracks, began, timing)


def near_to(finding: Finding) -> bool:
    """Whether a closer look may find the effect: the number, and where points were held out their gain, come near to what is needed."""
    if finding.there:
        return True
    least = light.MARGIN.get(finding.effect)
    gain = 1.0 if least is None or not finding.before or finding.after is None else (1 - finding.after / finding.before) / least
    return finding.number > CLOSE * finding.threshold and gain > CLOSE


def diagnose_tracks(seen: Tracks, began: float | None = None, timing: Timing | None = None) -> Diagnostics:
    """The evidence that tracks hold; what each effect costs is added to `timing`."""
    began, timing = time.monotonic() if began is None else began, timing or Timing()
    with timing.by(LENS, ROWS, POSES):
        explained = geometry.explain(seen) if len(seen.frame) else None
    frames = len(seen.names)
    if explained is None:
        nothing = {name: Finding(name, 0.0, 0.0, "too few points are shared between images", False) for name in ORDER}
        facts = {"frames": frames, "points": seen.points, "points_seconds": timing.of(POINTS)}
        return Diagnostics(nothing, None, None, None, np.zeros(frames), time.monotonic() - began, facts, timing)
    mine = np.zeros(len(seen.frame), dtype=bool)
    mine[explained.observation] = True
    kept = seen.rows(mine)
    # `rows` drops points that are left with one observation; the problem has none of these, so both number alike.
    with timing.by(EXPOSURE, VIGNETTING):
        found = light.explain(kept.light(), frames)
    depth = predict(explained.problem)[0][np.argsort(explained.observation, kind="stable"), 2]
    with timing.by(BLUR):
        blur = blur_evidence(kept.slope, depth, kept.frame, kept.point, frames, kept.linear)
    with timing.by(VIEWS):
        views = find_specularity(kept, explained.problem, depth, found)
    with timing.by(FAR):
        usual = float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0
        far = find_far_background(seen, explained.problem, usual)
    findings = {
        **{name: found.finding(name) for name in (EXPOSURE, VIGNETTING)},
        LENS: _lens(explained),
        ROWS: _rows(explained, seen.times),
        VIEWS: views,
        FAR: far,
        BLUR: Finding(BLUR, blur.number, blur.threshold, blur.reason, blur.found),
        POSES: _poses(explained),
    }
    sharpness = np.array(blur.parameters.get("sharpness", np.zeros(frames)))
    points, observations = len(explained.problem.points), len(explained.observation)
    facts = {"frames": frames, "points": points, "observations": observations, "points_seconds": timing.of(POINTS)}
    return Diagnostics(findings, seen, explained, found, sharpness, time.monotonic() - began, facts, timing)


def _of_points(name: str, choice: geometry.Choice, reason: str, there: bool) -> Finding:
    number = max(1 - choice.after / choice.before if choice.before > 0 else 0.0, 0.0)
    return Finding(name, number, geometry.MARGIN[name], reason, there, choice.before, choice.after, "working pixels")


def _changed(choice: geometry.Choice, less: str, more: str) -> tuple[str, str]:
    """Whether what held-out points are off by falls or grows, and by how many percent."""
    percent = round(100 * (1 - choice.after / choice.before)) if choice.before > 0 else 0
    return (more if percent < 0 else less), f"{abs(percent)}%"


def _lens(found: geometry.Explained) -> Finding:
    choice = found.choices[LENS]
    rings = ", ".join(f"{round(float(value), 2) + 0:+.2f}" for value in found.profile)
    does, percent = _changed(choice, "lowers", "raises")
    reason = (
        f"a lens with k1 and k2 beyond the given one {does} what held-out points are off by {percent}; from the middle "
        f"to the corners points lie {rings} working pixels too far out"
    )
    return _of_points(LENS, choice, reason, choice.kept)


def _rows(found: geometry.Explained, times: Array) -> Finding:
    choice = found.choices[ROWS]
    do, percent = _changed(choice, "lower", "raise")
    reason = f"rows read one after the other {do} what held-out points are off by {percent}"
    there = choice.kept
    if choice.kept:
        share, alike = geometry.readout(found.problem.motion, geometry.steps_of(found.problem.poses, times))
        if alike > 0.5:
            reason += f"; the camera turns as if reading took {share:.2f} of the time between two pictures"
            there = share <= 1
        reason += "; this is not corrected: film with a global shutter, or move more slowly" if there else ", which no shutter takes"
    return _of_points(ROWS, choice, reason, there)


def _poses(found: geometry.Explained) -> Finding:
    choice = found.choices[POSES]
    way, percent = _changed(choice, "less", "more")
    reason = (
        f"held-out points are {choice.before:.2f} working pixels off with the given poses, {choice.after:.2f} with refined ones: "
        f"{percent} {way}"
    )
    return _of_points(POSES, choice, reason, choice.kept)
