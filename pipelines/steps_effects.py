"""The stage that looks for effects in the training pictures and decides what is taken out of them before anything is fitted."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldfuse import steps
from fieldfuse.effects.correct import Corrections
from fieldfuse.files import write_json
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.kept import EFFECTS, read_kept
from fieldfuse.pipelines.source_state import pixel_state
from fieldfuse.steps import apply_effects, looks_for_effects, set_seeds

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture

NAME = "effects.json"
SEES = {
    "none": "colours do not hang on the direction of view",
    "low": "colours hang on the direction of view in first order",
    "full": "colours hang on the direction of view",
}


def find_effects(job: Job, posed: Capture) -> Corrections:
    """What is to be corrected; `effects.json` tells the evidence, the decisions and what they cost. With `effects: off` nothing is read."""
    settings = job.settings
    if not looks_for_effects(settings) or _did_without(job):
        return Corrections()
    path = job.folder / NAME

    def make() -> dict[str, Any]:
        set_seeds(settings.seed)
        return steps.find_effects(posed, settings, job.progress)

    def save(data: dict[str, Any]) -> list[Path]:
        write_json(path, data)
        return [path]

    data = job.stages.run(
        "effects",
        make=make,
        save=save,
        load=lambda: read_kept(path, EFFECTS),
        uses=[asdict(settings.effects), settings.capture.holdout, [frame.name for frame in posed.frames], pixel_state(posed)],
        after=["poses"],
        version=4,
    )
    return apply_effects(data, settings)


def _did_without(job: Job) -> bool:
    """Whether what this folder has was made without looking for effects, by settings that were not kept: a total budget may leave no time
    for it. Work on it goes on from there."""
    scene = job.stages.record("scene")
    return scene is not None and "effects" not in scene.after and "scene" in job.stages.trusted and job.stages.usable("scene")


def effects_part(job: Job, background: bool | None) -> dict[str, Any] | None:
    """The report's part `effects`: decisions without the corrections' many numbers; None when nothing was looked for."""
    if "effects" not in job.stages.records:
        return None
    data = read_kept(job.folder / NAME, EFFECTS)
    effects, view = data["effects"], job.settings.field.view
    for entry in effects:
        if entry["effect"] == "view_dependence" and view != "auto":
            entry["on"] = view != "none"
            entry["note"] = f"{SEES[view]}: field.view={view}"
        if entry["effect"] == "background" and background is not None:
            entry["on"] = background
            entry["note"] = "space beyond the region of interest is modelled" if background else "nothing beyond the region is modelled"
    dimmed = (data.get("corrections") or {}).get("dimmed", 1.0)
    return {"effects": effects, "seconds": data["seconds"], "looked_at": data["looked_at"], "dimmed": dimmed}


def moved_cameras(job: Job, capture: Capture) -> list[str]:
    """How far cameras that came with the capture were moved by what pictures and depth show: what is exported lies with the moved ones."""
    import numpy as np

    from fieldfuse.effects.correct import apart

    given = {frame.name: frame.world_from_camera for frame in capture.frames if frame.world_from_camera is not None}
    names = [name for name in (job.corrections.poses if job.corrections else {}) if name in given]
    if job.corrections is None or not names:
        return []
    way, turn = apart(np.stack([given[name] for name in names]), np.stack([job.corrections.poses[name] for name in names]))
    length = f"{100 * np.median(way):.1f} cm" if capture.metric else f"{np.median(way):.3g} of the capture's units"
    held = job.corrections.by_depth
    unregistered = capture.has_depth and job.corrections.depth is None and not held
    depth = "; a sensor's depth that is not registered with the colours fits those better" if unregistered else ""
    return [
        f"the poses that came with the capture were refined by its pictures{' and depth' if held else ''}: cameras moved by {length} and "
        f"turned by {np.median(turn):.2f}°"
        f" in the median, and surfaces lie with them; --set effects.off=[poses] keeps the poses as they came{depth}"
    ]


def moved_depth(job: Job, capture: Capture) -> list[str]:
    """How far the depth camera stands from the pictures', where depth is carried from the one to the other."""
    import numpy as np

    from fieldfuse.effects.correct import apart

    found = job.corrections.depth if job.corrections else None
    if found is None:
        return []
    way, turn = (float(value[0]) for value in apart(np.eye(4)[None], found[None]))
    length = f"{100 * way:.1f} cm" if capture.metric else f"{way:.3g} of the capture's units"
    return [
        f"the depth camera was found to stand {length} beside the pictures' and to be turned by {turn:.2f}°, and its depth is carried over;"
        " --set effects.off=[depth_offset] uses depth as it came"
    ]


def effects_warnings(job: Job) -> list[str]:
    """What a user has to know: effects that are there and cannot be corrected."""
    part = effects_part(job, None)
    if part is None:
        return []
    told = {
        "rolling_shutter": "the pictures' rows were read one after the other while the camera moved",
        "motion_blur": "some pictures are blurred",
    }
    return [
        f"{told[entry['effect']]}: {entry['reason']}"
        for entry in part["effects"]
        if entry["there"] and not entry["on"] and entry["effect"] in told and entry["wish"] != "off"
    ]
