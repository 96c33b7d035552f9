"""Short fits of one capture under different settings of its effects: what corrections gain, and what they cost.

Seconds are of the processor, so that other work on the machine does not blur the comparison.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.prepare import held_out, prepare_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import Settings
from fieldfuse.effects.correct import Corrections
from fieldfuse.effects.decide import asleep, choose_field, decide
from fieldfuse.effects.diagnostics import Diagnostics
from fieldfuse.evaluation.metrics import psnr, right_half_psnr
from fieldfuse.evaluation.score import RenderedView, as_photo, entry, mean
from fieldfuse.poses.scene import describe_scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.tone import Tone
from fieldfuse.training.engine import warm_up

FIXED = ("field.init=classical", "threads=1", "device=cpu", "tsdf.enabled=off")


def fit_with(
    capture: Capture,
    settings: Settings,
    progress: Progress = SILENT,
    truth: Capture | None = None,
    known: Corrections | None = None,
    found: Diagnostics | None = None,
) -> dict[str, Any]:
    """Look for effects as the settings say, fit for `fit.budget` processor seconds, score the held-out views.

    Args:
        truth: the same capture with its held-out pictures in canonical colour.
        known: what is corrected, so that nothing is looked for.
        found: what `diagnose` found in the training frames before.

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
