"""From evidence and the user's wishes to what is corrected.

What evidence speaks for is corrected only if three guards let it pass: no correction is larger than cameras explain (`correct.beyond`),
held-out frames are placed by their own points or like their neighbours (`refine`), and a short fit to some training frames shows others
better with it than without (`Trial`). What the user switches on by name is corrected whatever the guards find.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.config import EffectsSettings, FieldSettings
from fieldfuse.effects import light
from fieldfuse.effects.adjust import LENS, POSES, ROWS, adjust, predict
from fieldfuse.effects.correct import Corrections, beyond, beyond_depth, bounded_gains, correctable
from fieldfuse.effects.depth_camera import DEPTH_OFFSET, UNKNOWN, look_for_offset
from fieldfuse.effects.depth_pose_refinement import DepthRefined
from fieldfuse.effects.diagnostics import FAR, POINTS, VIEWS, Diagnostics, Timing, diagnose
from fieldfuse.effects.evidence import BLUR, Finding
from fieldfuse.effects.light import EXPOSURE, VIGNETTING
from fieldfuse.effects.refine import refined_poses
from fieldfuse.effects.tracks import Look, Tracks, gather
from fieldfuse.poses.cloud import every
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tone import LINEAR, Gain, Tone

POWER = 2.0  # of a frame's sharpness: its weight in the fit, against that of sharp ones
SHARP = 0.75  # quantile of the sharpness from which on a frame counts in full
LEAST_WEIGHT = 0.1
CLIPS = 0.01  # share of the pixels that corrections may make too bright for an image …
DIMMEST = 2.0  # … unless all would have to become darker than by this
STRIDE = 4  # working pixels between those that are looked at
OF_FIELD = {  # no correction of images, but what the field is made of
    VIEWS: "what the decoder sees of the direction: field.view",
    FAR: "whether space beyond the region is modelled is decided with the scene (field.background)",
}
PLAIN_VIEW = "full"  # what the decoder sees of the direction where nothing speaks for view dependence
GROUPS = ((POSES, LENS), (EXPOSURE, VIGNETTING), (BLUR,))  # what a trial switches at once, in this order
# Decibels by which a trial has to be better with a group. Small images do not show blur: what little they gain by weights against it, a
# whole fit may lose again.
WINS = {POSES: 0.0, LENS: 0.0, EXPOSURE: 0.1, VIGNETTING: 0.1, BLUR: 0.3}
TRIED, VALIDATED = 56, 8  # training frames that take part in a trial, and those of them that it scores, at most
FEWEST_TRIED = 6  # training frames without which there is no trial
EVIDENCE, BOUND, CHECK, TRIAL = "evidence", "bound", "check", "trial"  # which guard had the last word
NEAR_TIE = 0.05  # decibels: so much last digits of one and the same fit move the outcome of a trial
SEEDS_OF_TIE = (1, 2)  # of the fits that are averaged with the first in a near tie


class Trial(Protocol):
    """A short fit with what is corrected."""

    def __call__(self, option: Corrections, seed: int = 0) -> Array | None:
        """(V,) decibels of validation frames after it; None: there is no answer."""


Trials = Callable[[Capture, Array], Trial]  # … made for training frames and (F,) bool those of them that are validation frames


@dataclass(frozen=True)
class Decision:
    """One effect: what was found, what was wished, what is done."""

    finding: Finding
    wish: str  # auto, on or off
    on: bool  # corrected
    note: str = ""
    decided_by: str = EVIDENCE
    trial: dict[str, float] = field(default_factory=dict)  # decibels of validation frames `without` and `with`; empty: none was made

    def to_dict(self) -> dict[str, Any]:
        tried = {"trial": {name: round(value, 2) for name, value in self.trial.items()}} if self.trial else {}
        return {
            **self.finding.to_dict(),
            "wish": self.wish,
            "on": bool(self.on),
            "note": self.note,
            "decided_by": self.decided_by,
            **tried,
        }

    def noted(self, note: str) -> Decision:
        """With one more note."""
        return replace(self, note="; ".join(filter(None, [self.note, note])))

    def dropped(self, guard: str, why: str, trial: dict[str, float] | None = None) -> Decision:
        """Not corrected after all."""
        return replace(self, on=False, note=f"not corrected: {why}", decided_by=guard, trial=trial or {})


@dataclass(frozen=True)
class Decided:
    """All decisions of a capture, what they come to, and what they cost."""

    decisions: tuple[Decision, ...]
    corrections: Corrections
    seconds: float
    facts: dict[str, Any]
    timing: Timing

    def to_dict(self) -> dict[str, Any]:
        return {
            "effects": [{**one.to_dict(), "seconds": self.timing.of(one.finding.effect)} for one in self.decisions],
            "seconds": round(self.seconds, 3),
            "looked_at": {**self.facts, "points_seconds": self.timing.of(POINTS)},
            "corrections": self.corrections.to_dict(),
        }


def wish(settings: EffectsSettings, effect: str) -> str:
    """`on`, `off` or `auto` for one effect."""
    if effect in settings.on:
        return "on"
    return "off" if effect in settings.off or settings.mode == "off" else "auto"


def asleep(settings: EffectsSettings) -> bool:
    """True when nothing is to be looked for."""
    return settings.mode == "off" and not settings.on


def decide(
    capture: Capture,
    test: Array,
    settings: EffectsSettings,
    progress: Progress = SILENT,
    found: Diagnostics | None = None,
    trials: Trials | None = None,
) -> Decided:
    """Look at the training frames of a posed capture, decide, and work out the corrections of all frames.

    Args:
        test: (N,) bool: held-out frames. They enter nothing that training frames get; afterwards they are brought to the same colours and
            poses by the points that training frames found.
        found: what `diagnose` found in these training frames before; None: they are looked at.
        trials: makes short fits that have the last word; None: there are none.

    Raises:
        InputError: an image cannot be read.
    """
    began = time.monotonic()
    train = [int(index) for index in np.flatnonzero(~test)]
    known: dict[int, Look] = {}
    found = found or diagnose(capture, train, progress, known=known, quick=not settings.on)
    decisions = {name: _first_decision(finding, wish(settings, name), capture, found) for name, finding in found.findings.items()}
    worked = _worked_out(capture, test, found, _on(decisions), progress, known)
    decisions, worked = _guarded(decisions, worked, capture, found)
    if trials is not None and any(one.on and one.wish == "auto" for name, one in decisions.items() if name in WINS):
        decisions = _judged(decisions, worked, capture, found, trials)
    corrections = worked.parts(_on(decisions))
    if worked.borrowed and decisions[EXPOSURE].on:
        which = ", ".join(worked.borrowed[:3]) + (", …" if len(worked.borrowed) > 3 else "")
        note = f"held-out frames whose points disagree about their exposure have that of their neighbours: {which}"
        decisions[EXPOSURE] = decisions[EXPOSURE].noted(note)
    if worked.agreed is not None and decisions[POSES].on:
        decisions[POSES] = replace(decisions[POSES], note=worked.agreed.note)
    if capture.has_depth:
        with found.timing.by(DEPTH_OFFSET):
            finding, pose = look_for_offset(corrections.on_capture(capture), train, worked.seen, progress, known)
        decision = _decision(finding, wish(settings, DEPTH_OFFSET), "" if pose is not None else f"cannot be worked out: {UNKNOWN}")
        why = beyond_depth(pose, capture.metric, usual_depth(found)) if pose is not None else None
        if decision.on and decision.wish == "auto" and why is not None:
            decision = decision.dropped(BOUND, why)
        decisions[DEPTH_OFFSET] = decision
        corrections = replace(corrections, depth=pose if decision.on else None)
    return Decided(tuple(decisions.values()), corrections, time.monotonic() - began, found.facts, found.timing)


def tried_frames(train: Sequence[int], count: int) -> tuple[list[int], Array]:
    """The training frames that a trial uses, evenly spread, and (count,) bool those of them that it scores."""
    chosen = [train[k] for k in every(len(train), TRIED)]
    aside = np.zeros(count, dtype=bool)
    if len(chosen) >= FEWEST_TRIED:
        step = max(len(chosen) // VALIDATED, 4)
        aside[chosen[step // 2 :: step]] = True
    return chosen, aside


def usual_depth(found: Diagnostics) -> float:
    """Median depth of the points that images share, units of the poses; 0: there are none."""
    depth = np.zeros(0) if found.explained is None else predict(found.explained.problem)[0][:, 2]
    return float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0


def better(without: Array, with_it: Array) -> float:
    """Decibels by which validation frames are better, less the standard error of their mean: a few frames may be so by chance."""
    gain = with_it - without
    return float(gain.mean() - gain.std(ddof=1) / np.sqrt(len(gain))) if len(gain) > 1 else float(gain.mean())


def _averaged(score: Trial, first: Array, option: Corrections) -> Array:
    """(V,) means over the first trial and those of other seeds that give an answer."""
    again = [score(option, seed) for seed in SEEDS_OF_TIE]
    return np.mean([first, *(one for one in again if one is not None)], axis=0)


def _on(decisions: dict[str, Decision]) -> frozenset[str]:
    return frozenset(name for name, decision in decisions.items() if decision.on)


def _guarded(
    decisions: dict[str, Decision], worked: Worked, capture: Capture, found: Diagnostics
) -> tuple[dict[str, Decision], Worked]:
    """Without what no camera explains, and without poses by which held-out frames cannot be placed."""
    cameras = [frame.intrinsics for frame in capture.frames if frame.intrinsics is not None]
    given = {frame.name: frame.world_from_camera for frame in capture.frames if frame.world_from_camera is not None}
    reasons = {name: (BOUND, why) for name, why in beyond(worked.all, cameras, given, usual_depth(found)).items()}
    if worked.misplaced is not None:
        reasons.setdefault(POSES, (CHECK, worked.misplaced))
    out = dict(decisions)
    for name, (guard, why) in reasons.items():
        if out[name].on and out[name].wish == "auto":
            out[name] = out[name].dropped(guard, why)
    if not out[LENS].on and decisions[LENS].on and out[POSES].on:
        out[POSES] = out[POSES].dropped(BOUND, "poses were refined beside a lens that no camera has")
    both, tried = (replace(one, gain=bounded_gains(one.gain) or one.gain) for one in (worked.all, worked.tried))
    return out, replace(worked, all=both, tried=tried)


def _judged(decisions: dict[str, Decision], worked: Worked, capture: Capture, found: Diagnostics, trials: Trials) -> dict[str, Decision]:
    """By short fits, group after group: what is not better with than without is not corrected."""
    out, chosen = dict(decisions), worked.chosen
    names = [group for group in GROUPS if any(out[name].on and out[name].wish == "auto" for name in group)]
    if len(chosen) < FEWEST_TRIED:
        for name in (name for group in names for name in group if out[name].on and out[name].wish == "auto"):
            out[name] = out[name].dropped(CHECK, f"{len(chosen)} training images are too few to see whether it helps")
        return out
    some = capture.with_frames([capture.frames[index] for index in chosen])
    if some.points is None and found.explained is not None:
        some = replace(some, points=found.explained.problem.points)
    score = trials(some, worked.aside[chosen])
    fixed = {name for name, decision in out.items() if decision.on and decision.wish != "auto"}
    with found.timing.by(*(name for group in names for name in group if out[name].on)):
        best = score(worked.parts(frozenset(fixed), tried=True))
        for group in names:
            members = {name for name in group if out[name].on}
            option = worked.parts(frozenset(fixed | members), tried=True)
            value = score(option)
            if best is None or value is None:
                out |= {name: out[name].noted("a trial was not possible") for name in members}
                fixed |= members
                continue
            least = max(WINS[name] for name in members)
            without, with_it = best, value
            if abs(better(best, value) - least) < NEAR_TIE:
                without = _averaged(score, best, worked.parts(frozenset(fixed), tried=True))
                with_it = _averaged(score, value, option)
            trial = {"without": float(without.mean()), "with": float(with_it.mean())}
            if better(without, with_it) >= least:
                fixed, best = fixed | members, value
                out |= {name: replace(out[name], decided_by=TRIAL, trial=trial) for name in members}
                continue
            unsure = ", which differs too much between them to be believed" if trial["with"] > trial["without"] else ""
            why = f"in a short fit validation images have {trial['with']:.2f} dB with it and {trial['without']:.2f} dB without{unsure}"
            out |= {name: out[name].dropped(TRIAL, why, trial) for name in members if out[name].wish == "auto"}
    return out


def choose_field(field: FieldSettings, effects: list[dict[str, Any]], off: Sequence[str] = ()) -> None:
    """Set what is left to `auto` in `field` by the decisions (as in `Decision.to_dict`); the scene decides on a background not found.

    Args:
        off: effects that are off by name. (That nothing is to be corrected, `effects.mode=off`, does not concern the field.)
    """
    for entry in effects:
        name, unwanted = entry["effect"], entry["effect"] in off
        if name == VIEWS and field.view == "auto":
            field.view = "full" if entry["on"] or (entry["wish"] == "off" and not unwanted) else "none" if unwanted else PLAIN_VIEW
        if name == FAR and field.background == "auto" and (entry["on"] or unwanted):
            field.background = "on" if entry["on"] else "off"


def _decision(finding: Finding, wished: str, obstacle: str = "") -> Decision:
    if wished == "off" or (wished == "auto" and not finding.there):
        return Decision(finding, wished, False, "there, and switched off" if finding.there and wished == "off" else "")
    if obstacle:
        return Decision(finding, wished, False, obstacle)
    return Decision(finding, wished, True, "" if finding.there else "switched on by hand, nothing speaks for it")


def _first_decision(finding: Finding, wished: str, capture: Capture, found: Diagnostics) -> Decision:
    """By evidence and wish alone."""
    name, obstacle = finding.effect, ""
    if name in OF_FIELD:
        return Decision(finding, wished, wished == "on" or (wished == "auto" and finding.there), OF_FIELD[name])
    if name == ROWS:
        return Decision(finding, wished, False, "only reported, not corrected")
    cameras = {frame.intrinsics for frame in capture.frames}
    if found.explained is None:
        obstacle = "cannot be worked out: too few points are shared between pictures"
    elif capture.alpha and name in (EXPOSURE, VIGNETTING):
        obstacle = "not corrected where pictures have alpha: their background is known"
    elif name == LENS and (len({(c.width, c.height) for c in cameras if c}) > 1 or not all(c and correctable(c) for c in cameras)):
        obstacle = "not corrected: the pictures have different cameras, or a lens of another kind"
    return _decision(finding, wished, obstacle)


@dataclass(frozen=True)
class Worked:
    """Corrections of everything that evidence speaks for, of which some will be used."""

    all: Corrections
    tried: Corrections  # the same for a trial: its validation frames are placed and toned as if they were held out
    chosen: list[int]  # training frames of a trial
    aside: Array  # (N,) bool those of them that it holds out
    seen: Tracks | None  # in most images
    agreed: DepthRefined | None = None  # poses that agree with a sensor's depth, where it took part
    misplaced: str | None = None  # why poses cannot be used; None: they can
    borrowed: Sequence[str] = ()  # held-out frames, by name, whose gain is their neighbours'

    def parts(self, on: frozenset[str], tried: bool = False) -> Corrections:
        """What is corrected with the effects `on`."""
        whole = self.tried if tried else self.all
        gain, corner = whole.gain if EXPOSURE in on else {}, whole.corner if VIGNETTING in on else None
        return Corrections(
            gain=gain,
            corner=corner,
            dimmed=room_for_light(self.seen, corner, gain),
            lens=whole.lens if LENS in on else None,
            poses=whole.poses if POSES in on else {},
            by_depth=whole.by_depth and POSES in on,
            weight=whole.weight if BLUR in on else {},
        )


def _worked_out(
    capture: Capture, test: Array, found: Diagnostics, on: frozenset[str], progress: Progress, known: dict[int, Look]
) -> Worked:
    """Corrections for the effects `on`. Those of single frames need every frame: then all are looked at, and only then."""
    chosen, aside = tried_frames([int(index) for index in np.flatnonzero(~test)], len(test))
    seen, corner = found.seen, found.light.corner if found.light is not None and VIGNETTING in on else None
    lens = None
    if found.explained is not None and LENS in on:
        explained = found.explained
        with found.timing.by(LENS):
            lens = (explained.problem if LENS in explained.kept else adjust(explained.problem, explained.kept | {LENS}).problem).lens
    weight: dict[str, float] = {}
    if seen is not None and BLUR in on:
        weight = _weights([frame.name for frame, held in zip(capture.frames, test, strict=True) if not held], seen.names, found.sharpness)
    both = Corrections(corner=corner, lens=lens, weight=weight)
    if seen is None or not on & {EXPOSURE, POSES}:
        return Worked(both, both, chosen, aside, seen)
    tried, agreed, misplaced, borrowed = both, None, None, list[int]()
    with found.timing.by(POINTS):
        whole = gather(capture, range(len(capture.frames)), progress, known=known)
    if EXPOSURE in on:
        with found.timing.by(EXPOSURE):
            tracks = whole.light() if corner is None else whole.light().without_vignetting(corner)
            (gain, borrowed), (gain_aside, _) = (light.frame_gains(tracks, len(whole.names), train) for train in (~test, ~test & ~aside))
        both = replace(both, gain=_by_name(whole.names, gain))
        tried = replace(tried, gain=_by_name(whole.names, gain_aside))
    if POSES in on:
        kept = found.explained.kept if found.explained is not None else frozenset[str]()
        with found.timing.by(POSES):
            refined = refined_poses(whole, ~test, kept | on, capture, progress, aside)
        agreed, lens = refined.agreed, refined.lens if LENS in on else None
        placed = refined.poses if refined.aside is None else refined.aside
        both = replace(both, poses=dict(zip(whole.names, refined.poses, strict=True)), lens=lens, by_depth=agreed is not None)
        tried = replace(tried, poses=dict(zip(whole.names, placed, strict=True)), lens=lens, by_depth=agreed is not None)
        if refined.fails:
            misplaced = f"{refined.borrowed} of {refined.placed} held-out frames cannot be placed by the points that the others share"
    return Worked(both, tried, chosen, aside, whole, agreed, misplaced, [whole.names[frame] for frame in borrowed])


def _by_name(names: Sequence[str], gains: Array) -> dict[str, Gain]:
    return {name: (float(r), float(g), float(b)) for name, (r, g, b) in zip(names, gains, strict=True)}


def room_for_light(seen: Tracks | None, corner: float | None, gain: dict[str, Gain]) -> float:
    """What canonical light is divided by so that hardly any of it is too bright for an image, `DIMMEST` at most: what is clipped there
    is lost, and agrees with no photo that shows it because it was exposed less."""
    if seen is None or not (gain or corner is not None):
        return 1.0
    brightness = []
    for name, grey, camera in zip(seen.names, seen.images, seen.cameras, strict=True):
        factor = Tone(gain.get(name, (1.0, 1.0, 1.0)), corner).factor(camera.scaled(grey.shape[1], grey.shape[0]))
        brightness.append((LINEAR[grey] / factor.min(-1))[::STRIDE, ::STRIDE].ravel())
    return round(float(np.clip(np.quantile(np.concatenate(brightness), 1 - CLIPS), 1.0, DIMMEST)), 4)


def _weights(train: Sequence[str], names: Sequence[str], sharpness: Array) -> dict[str, float]:
    """What each training frame counts for, by its sharpness; those that were not looked at count as much as most do."""
    share = np.clip(np.exp2(POWER * (sharpness - np.quantile(sharpness, SHARP))), LEAST_WEIGHT, 1)
    known = dict(zip(names, share, strict=True))
    usual = float(np.median(share))
    weight = {name: round(float(known.get(name, usual)), 3) for name in train}
    return {name: value for name, value in weight.items() if value < 1}
