"""Each effect switched on by hand on captures whose effects nobody knows: whether what was found pays, and what was not found would not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.capture import open_capture
from toolkit.config import load_settings
from toolkit.evaluate.effects_fits import FIXED, fit_with
from toolkit.files import read_json, write_json
from toolkit.progress import SILENT, Progress

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
    captures: dict[str, Path], folder: Path, seconds: float, long_side: int, seeds: int = 1, progress: Progress = SILENT
) -> dict[str, Any]:
    """Fit each capture with everything off, with what is found, and with each effect alone; a fit that is in `folder` is not done again.

    Args:
        captures: by the names that the table shows.
        seconds: processor time of each fit.
        seeds: fits of each, of which the mean is told.

    Raises:
        InputError, PoseError: a capture cannot be used.
        Interrupted: stopped by the user; fits that are done stay.
    """
    each: list[dict[str, Any]] = []
    total = len(captures) * seeds * len(SWITCHES)
    for seed in range(seeds):
        for mode, pairs in SWITCHES.items():
            for name, path in captures.items():
                progress.check()
                progress.update(len(each), total, f"{name}, {mode.replace('_', ' ')}")
                kept = folder / name / f"{mode}-{long_side}-{seconds:g}s-{seed}.json"
                if not kept.is_file():
                    settings = load_settings(pairs=[*pairs, f"budget={seconds}", f"image_size={long_side}", f"seed={seed}", *FIXED])
                    write_json(kept, fit_with(open_capture(path), settings, progress))
                each.append({"name": name, "mode": mode, "seed": seed, **read_json(kept)})
    return {"each": each, "budget": seconds, "long_side": long_side, "seeds": seeds, "mean": _means(each, list(captures))}


def _means(each: Sequence[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Capture → switch → mean over the seeds of what `KEYS` names."""
    out: dict[str, Any] = {}
    for name in names:
        rows = {mode: [one for one in each if one["name"] == name and one["mode"] == mode] for mode in SWITCHES}
        out[name] = {mode: {key: float(np.mean([one[key] for one in fits])) for key in KEYS} for mode, fits in rows.items()}
    return out
