"""From evidence and the user's wishes to what is corrected."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toolkit.camera import Array
from toolkit.capture.types import Capture
from toolkit.config import EffectsSettings, FieldSettings
from toolkit.effects import light, vignetting
from toolkit.effects.adjust import LENS, POSES, ROWS, adjust
from toolkit.effects.correct import Corrections, correctable
from toolkit.effects.depth_camera import NOTHING, look_for_offset
from toolkit.effects.light import EXPOSURE, VIGNETTING
from toolkit.effects.motion_blur import POWER
from toolkit.effects.paid import POINTS, Paid
from toolkit.effects.refine import refined_poses
from toolkit.effects.registration import DEPTH_OFFSET
from toolkit.effects.sensed import Agreed
from toolkit.effects.sightings import Look, Sightings, gather
from toolkit.effects.survey import BLUR, FAR, VIEWS, Finding, Survey, survey
from toolkit.progress import SILENT, Progress
from toolkit.tone import LINEAR, Gain, Tone

SHARP = 0.75  # quantile of the sharpness from which on a frame counts in full
LEAST_WEIGHT = 0.1
CLIPS = 0.01  # share of the pixels that corrections may make too bright for a picture …
DIMMEST = 2.0  # … unless all would have to become darker than by this
STRIDE = 4  # working pixels between those that tell
TOLD_ONLY = {
    ROWS: "only told, not corrected",
}
OF_FIELD = {  # no correction of pictures, but what the field is made of
    VIEWS: "what the decoder sees of the direction: field.view",
    FAR: "whether space beyond the region is modelled is decided with the scene (field.background)",
}
PLAIN_VIEW = "full"  # what the decoder sees of the direction where nothing speaks for view dependence


@dataclass(frozen=True)
class Decision:
    """One effect: what was found, what was wished, what is done."""

    finding: Finding
    wish: str  # auto, on or off
    on: bool  # corrected
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        return {**self.finding.to_dict(), "wish": self.wish, "on": bool(self.on), "note": self.note}


@dataclass(frozen=True)
class Decided:
    """All decisions of a capture, what they come to, and what they cost."""

    decisions: tuple[Decision, ...]
    corrections: Corrections
    seconds: float
    facts: dict[str, Any]
    paid: Paid

    def to_dict(self) -> dict[str, Any]:
        return {
            "effects": [{**one.to_dict(), "seconds": self.paid.of(one.finding.effect)} for one in self.decisions],
            "seconds": round(self.seconds, 3),
            "looked_at": {**self.facts, "points_seconds": self.paid.of(POINTS)},
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


def decide(capture: Capture, test: Array, settings: EffectsSettings, progress: Progress = SILENT, found: Survey | None = None) -> Decided:
    """Look at the training frames of a posed capture, decide, and work out the corrections of all frames.

    Args:
        test: (N,) bool: held-out frames. They enter nothing that training frames get; afterwards they are brought to the same colours and
            poses by the points that training frames found.
        found: what a survey of these training frames found before; None: they are looked at.

    Raises:
        InputError: a picture cannot be read.
    """
    began = time.monotonic()
    train = [int(index) for index in np.flatnonzero(~test)]
    known: dict[int, Look] = {}
    found = found or survey(capture, train, progress, known=known, quick=not settings.on)
    decisions = [_decision(finding, wish(settings, name), capture, found) for name, finding in found.findings.items()]
    on = frozenset(decision.finding.effect for decision in decisions if decision.on)
    corrections, seen, agreed = _corrections(capture, test, found, on, progress, known)
    if agreed is not None:
        decisions = [replace(one, note=agreed.note) if one.finding.effect == POSES else one for one in decisions]
    if capture.has_depth:
        with found.paid.by(DEPTH_OFFSET):
            finding, pose = look_for_offset(corrections.on_capture(capture), train, seen, progress, known)
        decision = _of_depth(finding, wish(settings, DEPTH_OFFSET), pose is not None)
        decisions.append(decision)
        corrections = replace(corrections, depth=pose if decision.on else None)
    return Decided(tuple(decisions), corrections, time.monotonic() - began, found.facts, found.paid)


def choose_field(field: FieldSettings, effects: list[dict[str, Any]], off: Sequence[str] = ()) -> None:
    """Set what is left to `auto` in `field` by the decisions (as in `Decision.to_dict`); the scene decides on a background not found.

    Args:
        off: effects that are off by name. (That nothing is to be corrected, `effects.mode=off`, says nothing about the field.)
    """
    for entry in effects:
        name, unwanted = entry["effect"], entry["effect"] in off
        if name == VIEWS and field.view == "auto":
            field.view = "full" if entry["on"] or (entry["wish"] == "off" and not unwanted) else "none" if unwanted else PLAIN_VIEW
        if name == FAR and field.background == "auto" and (entry["on"] or unwanted):
            field.background = "on" if entry["on"] else "off"


def _decision(finding: Finding, wished: str, capture: Capture, found: Survey) -> Decision:
    name = finding.effect
    wanted = wished == "on" or (wished == "auto" and finding.there)
    if name in OF_FIELD:
        return Decision(finding, wished, wanted, OF_FIELD[name])
    if name in TOLD_ONLY:
        return Decision(finding, wished, False, TOLD_ONLY[name])
    if not wanted:
        return Decision(finding, wished, False, "there, and switched off" if finding.there and wished == "off" else "")
    if found.explained is None:
        return Decision(finding, wished, False, "cannot be worked out: too few points are shared between pictures")
    if capture.alpha and name in (EXPOSURE, VIGNETTING):
        return Decision(finding, wished, False, "not corrected where pictures have alpha: their background is known")
    cameras = {frame.intrinsics for frame in capture.frames}
    if name == LENS and (len({(c.width, c.height) for c in cameras if c}) > 1 or not all(c and correctable(c) for c in cameras)):
        return Decision(finding, wished, False, "not corrected: the pictures have different cameras, or a lens of another kind")
    return Decision(finding, wished, True, "" if finding.there else "switched on by hand, nothing speaks for it")


def _of_depth(finding: Finding, wished: str, told: bool) -> Decision:
    """Depth is used where it was measured, or is carried to where the pictures were taken."""
    if not (wished == "on" or (wished == "auto" and finding.there)):
        return Decision(finding, wished, False, "there, and switched off" if finding.there and wished == "off" else "")
    if not told:
        return Decision(finding, wished, False, f"cannot be worked out: {NOTHING}")
    return Decision(finding, wished, True, "" if finding.there else "switched on by hand, nothing speaks for it")


def _corrections(
    capture: Capture, test: Array, found: Survey, on: frozenset[str], progress: Progress, known: dict[int, Look]
) -> tuple[Corrections, Sightings | None, Agreed | None]:
    """Corrections, what was seen in most pictures, and how poses agree with a sensor's depth where it took part.

    Per-frame corrections need every frame: then all are looked at, and only then.
    """
    seen, corner = found.seen, found.light.corner if found.light is not None and VIGNETTING in on else None
    lens = None
    if found.explained is not None and LENS in on:
        explained = found.explained
        with found.paid.by(LENS):
            lens = (explained.problem if LENS in explained.kept else adjust(explained.problem, explained.kept | {LENS}).problem).lens
    if seen is None or not on & {EXPOSURE, POSES, BLUR}:
        return Corrections(corner=corner, dimmed=room_for_light(seen, corner, {}), lens=lens), seen, None
    gain: dict[str, Gain] = {}
    poses: dict[str, Array] = {}
    weight: dict[str, float] = {}
    every: Sightings | None = None
    agreed: Agreed | None = None
    if BLUR in on:
        weight = _weights([frame.name for frame, held in zip(capture.frames, test, strict=True) if not held], seen.names, found.sharpness)
    if on & {EXPOSURE, POSES}:
        with found.paid.by(POINTS):
            every = gather(capture, range(len(capture.frames)), progress, known=known)
        if EXPOSURE in on:
            with found.paid.by(EXPOSURE):
                tracks = every.tracks()
                flat = tracks if corner is None else vignetting.corrected(tracks, corner)
                gains = light.frame_gains(flat, len(every.names), ~test)
            gain = {name: (float(r), float(g), float(b)) for name, (r, g, b) in zip(every.names, gains, strict=True)}
        if POSES in on:
            kept = found.explained.kept if found.explained is not None else frozenset[str]()
            with found.paid.by(POSES):
                refined = refined_poses(every, ~test, kept | on, capture, progress)
            poses = dict(zip(every.names, refined.poses, strict=True))
            lens, agreed = refined.lens if LENS in on else None, refined.agreed
    dimmed = room_for_light(seen, corner, gain)
    return (
        Corrections(gain, corner=corner, dimmed=dimmed, lens=lens, poses=poses, by_depth=agreed is not None, weight=weight),
        every or seen,
        agreed,
    )


def room_for_light(seen: Sightings | None, corner: float | None, gain: dict[str, Gain]) -> float:
    """What canonical light is divided by so that hardly any of it is too bright for a picture, `DIMMEST` at most: what is clipped there
    is lost, and agrees with no photo that shows it because it was exposed less."""
    if seen is None or not (gain or corner is not None):
        return 1.0
    brightness = []
    for name, grey, camera in zip(seen.names, seen.pictures, seen.cameras, strict=True):
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
