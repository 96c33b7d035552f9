"""Short fits of one capture under different settings of its effects: what corrections gain, and what they cost.

Seconds are of the processor, so that other work on the machine does not blur the comparison.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out, prepare_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import Settings, load_settings
from fieldfuse.effects.correct import Corrections
from fieldfuse.effects.decide import asleep, choose_field, decide
from fieldfuse.effects.survey import Survey
from fieldfuse.evaluation.affine import right_half_psnr
from fieldfuse.evaluation.effects_plan import Planned, film
from fieldfuse.evaluation.effects_truth import canonical_capture, known_light
from fieldfuse.evaluation.images import psnr
from fieldfuse.evaluation.score import RenderedView, as_photo, entry, mean
from fieldfuse.files import read_json, write_json
from fieldfuse.poses.scene import describe_scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.tone import Tone
from fieldfuse.training.engine import warm_up

FITS = "fits"


def fit_with(
    capture: Capture,
    settings: Settings,
    progress: Progress = SILENT,
    truth: Capture | None = None,
    known: Corrections | None = None,
    found: Survey | None = None,
) -> dict[str, Any]:
    """Look for effects as the settings say, fit for `fit.budget` processor seconds, score the held-out views.

    Args:
        truth: the same capture with its held-out pictures in canonical colour.
        known: what is corrected, so that nothing is looked for.
        found: what a survey of the training frames found before.

    Returns:
        `on` (what is corrected), `psnr` (in the colours of the photos), `psnr_corrected` (each test picture's colours fitted on
        its left half, scored on its right), with `truth` the same two against its pictures, `canonical` and `canonical_corrected`,
        `effects_seconds`, `seconds` (the whole, without warming up), `steps`.

    Raises:
        InputError, PoseError: the capture cannot be used.
        Interrupted: stopped by the user.
    """
    from fieldfuse.training.fit import fit_field

    settings = replace(settings, field=replace(settings.field))
    warm_up(settings, progress)
    began = time.process_time()
    test = held_out(capture, settings.capture.holdout)
    corrections, on = known or Corrections(), []
    if known is None and not asleep(settings.effects):
        decided = decide(capture, test, settings.effects, progress, found)
        corrections, on = decided.corrections, [one.finding.effect for one in decided.decisions if one.on]
        choose_field(settings.field, decided.to_dict()["effects"], settings.effects.off)
    looked = time.process_time() - began
    posed = corrections.on_capture(capture)
    scene = describe_scene(posed, progress)
    views = corrections.on_views(prepare_views(posed, scene.working_from_input, settings.capture, progress))
    result = fit_field(views, scene, settings, progress, ticks=time.process_time)
    progress.check()  # a fit that was stopped gives what it has, which says nothing here
    whole = time.process_time() - began
    view = make_renderer(result.field, settings.engine)
    indices = np.flatnonzero(views.test)
    shown = [render_view(result.field, views.intrinsics[i], views.world_from_camera[i], view) for i in indices]
    out = {"on": on, **_scores(shown, views, indices, ("psnr", "psnr_corrected"))}
    if truth is not None:
        right = prepare_views(corrections.on_capture(truth), scene.working_from_input, settings.capture, progress)
        brighter = Tone((corrections.dimmed,) * 3)  # as bright as these are
        shown = [replace(one, rgb=brighter.applied(one.rgb, views.intrinsics[i])) for one, i in zip(shown, indices, strict=True)]
        out |= _scores(shown, right, indices, ("canonical", "canonical_corrected"))
    return {**out, "effects_seconds": round(looked, 3), "seconds": round(whole, 3), "steps": result.steps}


def _scores(shown: Sequence[RenderedView], views: Views, indices: Array, names: tuple[str, str]) -> dict[str, Any]:
    """Under two `names`: the mean PSNR, and that with the left half's correction of colour."""
    plain, corrected = [], []
    for picture, index in zip(shown, indices, strict=True):
        valid = entry(views.valid, int(index))
        rgb, truth = as_photo(picture, views, int(index)), views.photo(int(index))
        plain.append(psnr(rgb, truth, valid))
        corrected.append(right_half_psnr(rgb, truth, valid))
    return {names[0]: mean(plain), names[1]: mean(corrected)}


MODES: dict[str, list[str]] = {
    "auto": ["effects=auto"],
    "all_off": ["effects=off"],
    "all_on": ["effects.on=[exposure,vignetting,distortion,poses,motion_blur,view_dependence,background]"],
    "known": ["effects=off"],  # exposure and vignetting as they were simulated
}
SHOWN = ("canonical", "canonical_corrected", "psnr", "psnr_corrected", "effects_seconds", "seconds")
FIXED = ("field.init=classical", "threads=1", "device=cpu", "tsdf.enabled=off")


def compared(
    planned: Iterable[Planned], folder: Path, seconds: float, against: Sequence[str] = ("all_on",), progress: Progress = SILENT
) -> dict[str, Any]:
    """Fit each capture with what was found (`auto`) and with each mode of `against` (of `MODES`), `seconds` of the processor each.

    What a fit gave is kept in the capture's folder, and used again by the next call with the same seconds.

    Returns:
        `each` capture with its `found` effects and what `fit_with` says of every mode, and the `mean` of `SHOWN`.

    Raises:
        Interrupted: stopped by the user; fits that are done stay.
    """
    modes = ("auto", *against)
    todo, each = list(planned), []
    for number, one in enumerate(todo):
        place = film(one, folder)
        capture = open_capture(place)
        test = held_out(capture, Settings().capture.holdout)
        fits = {}
        for mode in modes:
            progress.check()
            progress.update(number, len(todo), f"{one.name}, {mode.replace('_', ' ')}")
            kept = place / FITS / f"{mode}-{seconds:g}s.json"
            if not kept.is_file():
                settings = load_settings(pairs=[*MODES[mode], f"budget={seconds}", *FIXED])
                known = known_light(place, capture, test) if mode == "known" else None
                write_json(kept, fit_with(capture, settings, progress, canonical_capture(place, capture, test), known))
            fits[mode] = read_json(kept)
        each.append({"name": one.name, "found": fits["auto"]["on"], **fits})
    return {
        "each": each,
        "modes": modes,
        "budget": seconds,
        "mean": {mode: {key: float(np.mean([one[mode][key] for one in each])) for key in SHOWN} for mode in modes},
    }
