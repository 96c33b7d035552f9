"""Each effect switched on by hand on captures whose effects nobody knows: whether what was found pays, and what was not found would not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out
from fieldfuse.config import load_settings
from fieldfuse.effects.survey import Survey, survey
from fieldfuse.errors import InputError
from fieldfuse.evaluation.effects_fits import FIXED, fit_with
from fieldfuse.files import read_json, write_json
from fieldfuse.progress import SILENT, Progress

ALONE = ("exposure", "vignetting", "distortion", "poses", "motion_blur")
SWITCHES: dict[str, list[str]] = {
    "all_off": ["effects=off"],
    "auto": ["effects=auto"],
    **{name: ["effects=off", f"effects.on=[{name}]"] for name in ALONE},
    "no_view": ["effects=off", "field.view=none"],
    "background": ["effects=off", "field.background=on"],
    "no_background": ["effects=off", "field.background=off"],
}
KEYS = ("psnr", "psnr_corrected", "seconds")


def switched(
    captures: dict[str, Path],
    folder: Path,
    seconds: float,
    long_side: int,
    seeds: int = 1,
    modes: Sequence[str] = tuple(SWITCHES),
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Fit each capture with everything off, with what is found, and with each effect alone; a fit that is in `folder` is not done again.

    Args:
        captures: by the names that the table shows.
        seconds: processor time of each fit.
        seeds: fits of each, of which the mean is told.
        modes: of `SWITCHES`.

    Raises:
        InputError, PoseError: a capture cannot be used, or there is no such switch.
        Interrupted: stopped by the user; fits that are done stay.
    """
    for mode in modes:
        if mode not in SWITCHES:
            raise InputError(f"there is no switch {mode!r}; known are {', '.join(SWITCHES)}")
    each: list[dict[str, Any]] = []
    total = len(captures) * seeds * len(modes)
    for name, path in captures.items():
        found: Survey | None = None  # the same for every effect that is switched on alone
        for seed in range(seeds):
            for mode in modes:
                progress.check()
                progress.update(len(each), total, f"{name}, {mode.replace('_', ' ')}")
                kept = folder / name / f"{mode}-{long_side}-{seconds:g}s-{seed}.json"
                if not kept.is_file():
                    capture = open_capture(path)
                    fixed = [f"budget={seconds}", f"image_size={long_side}", f"seed={seed}", *FIXED]
                    settings = load_settings(pairs=[*SWITCHES[mode], *fixed])
                    if mode in ALONE and found is None:
                        train = np.flatnonzero(~held_out(capture, settings.capture.holdout))
                        found = survey(capture, [int(index) for index in train], progress, quick=False)
                    write_json(kept, fit_with(capture, settings, progress, found=found if mode in ALONE else None))
                each.append({"name": name, "mode": mode, "seed": seed, **read_json(kept)})
    return {"each": each, "budget": seconds, "long_side": long_side, "seeds": seeds, "mean": _means(each, list(captures), modes)}


def _means(each: Sequence[dict[str, Any]], names: list[str], modes: Sequence[str]) -> dict[str, Any]:
    """Capture → switch → mean over the seeds of what `KEYS` names."""
    out: dict[str, Any] = {}
    for name in names:
        rows = {mode: [one for one in each if one["name"] == name and one["mode"] == mode] for mode in modes}
        out[name] = {mode: {key: float(np.mean([one[key] for one in fits])) for key in KEYS} for mode, fits in rows.items()}
    return out
