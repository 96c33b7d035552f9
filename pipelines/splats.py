"""Gaussian splats of a run's field: made once, written for other programs, and scored at the held-out views like every method."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.files import remove
from fieldfuse.pipelines.rendered import Pictures
from fieldfuse.pipelines.stages import EndlessStage, Stage
from fieldfuse.pipelines.surfaces import pictures_stage, render_views
from fieldfuse.tone import exposed, unexposed

if TYPE_CHECKING:
    from fieldfuse.camera import Array, Intrinsics
    from fieldfuse.pipelines.fields import Fitted
    from fieldfuse.pipelines.job import Job
    from fieldfuse.pipelines.prepare import Prepared
    from fieldfuse.render.splats import Splats

SPLATS, RENDERED = "splats", "splats_render"  # the stages
SPLAT, SPZ = "splat", "spz"  # as `export.formats` has them
SPLAT_FILES = {SPLAT: "splat.ply", SPZ: "splat.spz"}


def splats_or_why_not(job: Job, ready: Prepared, fitted: Fitted, formats: Iterable[str]) -> Splats | str | None:
    """The run's splats, or a sentence why there can be none; None where `formats` name none."""
    try:
        return make_splats(job, ready, fitted) if set(formats) & set(SPLAT_FILES) else None
    except InputError as error:
        return f"the splats were left out: {error}"


def remove_old_splats(job: Job) -> set[str]:
    """Remove what is of an earlier field; the names of the files."""
    record = job.stages.record(SPLATS)
    if record is None or job.stages.usable(SPLATS):
        return set()
    there = {path.name: path for path in map(job.folder.path.joinpath, record.outputs) if path.is_file()}
    for path in there.values():
        remove(path)
    return set(there)


def make_splats(job: Job, ready: Prepared, fitted: Fitted) -> Splats:
    """The stage `splats`, whose file is `exports/splat.ply`.

    Raises:
        InputError: none can be made of this field.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.pipelines.cropping import shown_part
    from fieldfuse.render.splat_files import open_splats, save_splats
    from fieldfuse.training.splats import SplatSettings, splats_of_field

    path, export = job.folder / "exports" / SPLAT_FILES[SPLAT], job.settings.export
    settings = SplatSettings(export.splats, export.sh_degree, export.splat_seconds, job.settings.seed)
    frame = ready.scene.working_from_input
    views = ready.views if fitted.left_out is None else fitted.left_out.without(ready.views)

    def make() -> Splats:
        made, (_, region) = splats_of_field(fitted.field, views, frame, settings, job.progress), shown_part(job, ready, fitted, [], False)
        # The steps need all that the images show; what is not wanted goes afterwards.
        return made if region is None else made.take(region.inside(frame.points(made.centres)))

    def save(splats: Splats) -> list[Path]:
        save_splats(path, splats)
        return [path]

    chosen = [settings.most, settings.degree, settings.seconds, settings.seed, export.crop]
    return job.run(EndlessStage(SPLATS, make, save, lambda: open_splats(path), ["field", "scene", "views"], chosen))


def render_splats(job: Job, ready: Prepared, splats: Splats) -> Pictures:
    """The splats' renders at the held-out views, in the colours of the field's, on what is behind an object that is cut out."""
    views, back = ready.views, ready.scene.working_from_input.inverse()

    def show(lens: Intrinsics, pose: Array) -> Any:
        behind = None if views.background is None else exposed(np.round(255 * np.array(views.background)).astype(np.uint8), views.exposure)
        made = splats.render(lens, back.poses(pose), None if behind is None else behind / 255)
        return replace(made, rgb=unexposed(made.rgb, views.exposure), depth=made.depth / np.float32(back.scale))

    def make() -> Pictures:
        shown = render_views(job, views, show)
        return replace(shown, facts={"gaussians": len(splats), "degree": splats.degree, "bytes": splats.bytes})

    return job.run(pictures_stage(job, ready, Stage(RENDERED, make, lambda _: [], Pictures, [SPLATS, "views"]), SPLATS))
