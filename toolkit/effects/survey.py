"""All evidence of a posed capture at once, and what is decided from it before anything is fitted."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.effects import beyond, geometry, light, motion_blur, sheen
from fieldfuse.effects.adjust import LENS, POSES, ROWS, predict
from fieldfuse.effects.evidence import Evidence, HeldOut
from fieldfuse.effects.light import EXPOSURE, VIGNETTING
from fieldfuse.effects.paid import POINTS, Paid
from fieldfuse.effects.sightings import QUICK, Look, Sightings, choose, gather
from fieldfuse.progress import SILENT, Progress

PIXELS = "working pixels"
BLUR, VIEWS, FAR = "motion_blur", "view_dependence", "background"
ORDER = (EXPOSURE, VIGNETTING, LENS, ROWS, VIEWS, FAR, BLUR, POSES)
MOST_FRAMES = 40  # that are looked at closely
FIRST_FRAMES = 16  # of a first, quick look; when nothing in it comes near to speaking for an effect, it is the last
CLOSE = 0.6  # share of a threshold or margin from which on it does


@dataclass(frozen=True)
class Finding:
    """What was found about one effect, and whether it is there.

    Attributes:
        before, after: what held-out points are off without and with the effect, in `unit`; None where nothing is fitted.
        there: the number is above its threshold, and held-out points agree by a margin.
    """

    effect: str
    number: float
    threshold: float
    reason: str
    there: bool
    before: float | None = None
    after: float | None = None
    unit: str = ""

    def to_dict(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "effect": self.effect,
            "number": round(float(self.number), 4),
            "threshold": self.threshold,
            "there": bool(self.there),  # NumPy's own truth values are not JSON
            "reason": self.reason,
        }
        if self.before is not None and self.after is not None:
            before, after = float(self.before), float(self.after)
            out["held_out"] = {"before": round(before, 4), "after": round(after, 4), "unit": self.unit}
            if before > 0 and after > 0:
                out["held_out"]["decibels"] = round(20 * float(np.log10(before / after)), 2)
        return out


@dataclass(frozen=True)
class Survey:
    """Everything that was found."""

    findings: dict[str, Finding]  # in the order of `ORDER`
    seen: Sightings | None
    explained: geometry.Explained | None
    light: light.Light | None
    sharpness: Array  # (F,) factors of two of the slopes' energy
    seconds: float
    facts: dict[str, Any] = field(default_factory=dict)
    paid: Paid = field(default_factory=Paid)

    @property
    def there(self) -> frozenset[str]:
        return frozenset(name for name, finding in self.findings.items() if finding.there)


def survey(
    capture: Capture,
    indices: list[int] | None = None,
    progress: Progress = SILENT,
    known: dict[int, Look] | None = None,
    quick: bool = True,
) -> Survey:
    """Look at a posed capture.

    Args:
        indices: the frames that may be looked at (training frames); None: all.
        known: what is found in pictures, for `gather`.
        quick: begin with a quick look at few pictures, and end there when nothing speaks for any effect.

    Raises:
        InputError: a picture cannot be read.
    """
    began, paid = time.monotonic(), Paid()
    allowed = list(range(len(capture.frames))) if indices is None else list(indices)
    if quick and len(allowed) > FIRST_FRAMES:
        few = [allowed[k] for k in choose(len(allowed), FIRST_FRAMES)]
        with paid.by(POINTS):
            sightings = gather(capture, few, progress, QUICK)
        first = look(sightings, began, paid)
        if first.explained is not None and not any(near_to(finding) for finding in first.findings.values()):
            return first
    chosen = [allowed[k] for k in choose(len(allowed), MOST_FRAMES)]
    with paid.by(POINTS):
        sightings = gather(capture, chosen, progress, known=known)
    return look(sightings, began, paid)


def near_to(finding: Finding) -> bool:
    """Whether a closer look may find the effect: the number, and where points were kept out their gain, come near to what is asked."""
    if finding.there:
        return True
    least = {EXPOSURE: light.MARGIN[EXPOSURE], VIGNETTING: light.MARGIN[VIGNETTING]}.get(finding.effect)
    gain = 1.0 if least is None or not finding.before or finding.after is None else (1 - finding.after / finding.before) / least
    return finding.number > CLOSE * finding.threshold and gain > CLOSE


def look(seen: Sightings, began: float | None = None, paid: Paid | None = None) -> Survey:
    """The evidence that sightings hold; what each effect's costs is added to `paid`."""
    began, paid = time.monotonic() if began is None else began, paid or Paid()
    with paid.by(LENS, ROWS, POSES):
        explained = geometry.explain(seen) if len(seen.frame) else None
    frames = len(seen.names)
    if explained is None:
        nothing = {name: Finding(name, 0.0, 0.0, "too few points are shared between pictures to tell", False) for name in ORDER}
        facts = {"frames": frames, "points": seen.points, "points_seconds": paid.of(POINTS)}
        return Survey(nothing, None, None, None, np.zeros(frames), time.monotonic() - began, facts, paid)
    mine = np.zeros(len(seen.frame), dtype=bool)
    mine[explained.observation] = True
    kept = seen.where(mine)
    # `where` drops points that are left with one observation; the problem has none of these, so both number alike.
    with paid.by(EXPOSURE, VIGNETTING):
        found = light.explain(kept.tracks(), frames)
    depth = predict(explained.problem)[0][np.argsort(explained.observation, kind="stable"), 2]
    with paid.by(BLUR):
        blur = motion_blur.evidence(kept.slope[:, 0] + kept.slope[:, 2], depth, kept.frame, kept.point, frames, kept.linear)
    with paid.by(VIEWS):
        views = _of_patches(sheen.shiny(kept, explained.problem, depth, found))
    with paid.by(FAR):
        usual = float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0
        far = _of_patches(beyond.far(seen, explained.problem, usual))
    findings = {
        **{name: _of_light(found, name) for name in (EXPOSURE, VIGNETTING)},
        LENS: _lens(explained),
        ROWS: _rows(explained, seen),
        VIEWS: views,
        FAR: far,
        BLUR: _plain(blur),
        POSES: _poses(explained),
    }
    sharpness = np.array(blur.parameters.get("sharpness", np.zeros(frames)))
    points, observations = len(explained.problem.points), len(explained.observation)
    facts = {"frames": frames, "points": points, "observations": observations, "points_seconds": paid.of(POINTS)}
    return Survey(findings, seen, explained, found, sharpness, time.monotonic() - began, facts, paid)


def _plain(evidence: Evidence) -> Finding:
    return Finding(evidence.effect, evidence.number, evidence.threshold, evidence.reason, evidence.found)


def _of_patches(held_out: HeldOut) -> Finding:
    evidence = held_out.evidence
    return Finding(
        evidence.effect, evidence.number, evidence.threshold, evidence.reason, held_out.found, held_out.before, held_out.after, "stops"
    )


def _of_light(found: light.Light, name: str) -> Finding:
    evidence = found.evidence[name]
    before, after = found.before[name], found.after[name]
    return Finding(name, evidence.number, evidence.threshold, evidence.reason, name in found.kept, before, after, "stops")


def _gain(choice: geometry.Choice) -> float:
    return 1 - choice.after / choice.before if choice.before > 0 else 0.0


def _changed(choice: geometry.Choice, less: str = "lowers", more: str = "raises") -> tuple[str, str]:
    """Whether what held-out points are off by falls or grows, and by how many percent."""
    percent = round(100 * _gain(choice))
    return (more if percent < 0 else less), f"{abs(percent)}%"


def _lens(found: geometry.Explained) -> Finding:
    choice = found.choices[LENS]
    rings = ", ".join(f"{round(float(value), 2) + 0:+.2f}" for value in found.profile)
    does, percent = _changed(choice)
    reason = (
        f"a lens with k1 and k2 beyond the given one {does} what held-out points are off by {percent}; from the middle "
        f"to the corners points lie {rings} working pixels too far out"
    )
    return Finding(LENS, max(_gain(choice), 0.0), geometry.MARGIN[LENS], reason, choice.kept, choice.before, choice.after, PIXELS)


def _rows(found: geometry.Explained, seen: Sightings) -> Finding:
    choice = found.choices[ROWS]
    do, percent = _changed(choice, "lower", "raise")
    reason = f"rows read one after the other {do} what held-out points are off by {percent}"
    there = choice.kept
    if choice.kept:
        share, alike = geometry.readout(found.problem.motion, geometry.steps_of(found.problem.poses, seen.times))
        if alike > 0.5:
            reason += f"; the camera turns as if reading took {share:.2f} of the time between two pictures"
            there = share <= 1
        reason += "; this is not corrected: film with a global shutter, or move more slowly" if there else ", which no shutter takes"
    return Finding(ROWS, max(_gain(choice), 0.0), geometry.MARGIN[ROWS], reason, there, choice.before, choice.after, PIXELS)


def _poses(found: geometry.Explained) -> Finding:
    choice = found.choices[POSES]
    way, percent = _changed(choice, "less", "more")
    reason = (
        f"held-out points are {choice.before:.2f} working pixels off with the given poses, {choice.after:.2f} with refined ones: "
        f"{percent} {way}"
    )
    return Finding(POSES, max(_gain(choice), 0.0), geometry.MARGIN[POSES], reason, choice.kept, choice.before, choice.after, PIXELS)
