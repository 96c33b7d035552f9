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

from toolkit.capture import open_capture
from toolkit.capture.prepare import held_out, prepare_views
from toolkit.capture.types import Capture
from toolkit.config import Settings, load_settings
from toolkit.effects.correct import Corrections
from toolkit.effects.decide import asleep, choose_field, decide
from toolkit.evaluate.effects_plan import Planned, film
from toolkit.evaluate.score import score_views
from toolkit.poses.scene import describe_scene
from toolkit.progress import SILENT, Progress
from toolkit.render.image import make_renderer, render_view
from toolkit.training.engine import warm_up


def fit_with(capture: Capture, settings: Settings, progress: Progress = SILENT) -> dict[str, Any]:
    """Look for effects as the settings say, fit for `fit.budget` processor seconds, score the held-out views.

    Returns:
        `on` (what is corrected), `psnr` in canonical colour, `psnr_corrected` (each test picture's colours fitted on its left half, scored
        on its right), `effects_seconds`, `seconds` (the whole, without warming up), `steps`.

    Raises:
        InputError, PoseError: the capture cannot be used.
    """
    from toolkit.training.fit import fit_field

    settings = replace(settings, field=replace(settings.field))
    warm_up(settings, progress)
    began = time.process_time()
    test = held_out(capture, settings.capture.holdout)
    corrections, on = Corrections(), []
    if not asleep(settings.effects):
        decided = decide(capture, test, settings.effects, progress)
        corrections, on = decided.corrections, [one.finding.effect for one in decided.decisions if one.on]
        choose_field(settings.field, decided.to_dict()["effects"], settings.effects.off)
    looked = time.process_time() - began
    posed = corrections.on_capture(capture)
    scene = describe_scene(posed, progress)
    views = corrections.on_views(prepare_views(posed, scene.working_from_input, settings.capture, progress))
    result = fit_field(views, scene, settings, progress, ticks=time.process_time)
    whole = time.process_time() - began
    view = make_renderer(result.field, settings.engine)
    indices = np.flatnonzero(views.test)
    shown = (render_view(result.field, views.intrinsics[i], views.world_from_camera[i], view) for i in indices)
    scores = score_views(shown, views, indices)
    return {
        "on": on,
        "psnr": scores["psnr"],
        "psnr_corrected": scores["psnr_corrected"],
        "effects_seconds": round(looked, 3),
        "seconds": round(whole, 3),
        "steps": result.steps,
    }


MODES: dict[str, list[str]] = {
    "auto": ["effects=auto"],
    "all_off": ["effects=off"],
    "all_on": ["effects.on=[exposure,vignetting,distortion,poses,motion_blur,view_dependence,background]"],
}
SHOWN = ("psnr", "psnr_corrected", "effects_seconds", "seconds")


def compared(
    planned: Iterable[Planned], folder: Path, seconds: float, against: Sequence[str] = ("all_on",), progress: Progress = SILENT
) -> dict[str, Any]:
    """Fit each capture with what was found (`auto`) and with each mode of `against` (of `MODES`), `seconds` of the processor each.

    Returns:
        `each` capture with its `found` effects and what `fit_with` says of every mode, and the `mean` of `SHOWN`.
    """
    modes = ("auto", *against)
    todo, each = list(planned), []
    for number, one in enumerate(todo):
        progress.check()
        progress.update(number, len(todo), one.name)
        capture = open_capture(film(one, folder))
        fits = {}
        for mode in modes:
            fixed = [f"budget={seconds}", "field.init=classical", "threads=1", "device=cpu"]
            fits[mode] = fit_with(capture, load_settings(pairs=[*MODES[mode], *fixed]), progress)
        each.append({"name": one.name, "found": fits["auto"]["on"], **fits})
    return {
        "each": each,
        "modes": modes,
        "budget": seconds,
        "mean": {mode: {key: float(np.mean([one[mode][key] for one in each])) for key in SHOWN} for mode in modes},
    }
