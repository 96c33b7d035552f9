"""The part of a run's field that its exports hold, by `export.crop` and `export.clean`."""

from __future__ import annotations

from dataclasses import replace

from fieldfuse.errors import InputError
from fieldfuse.export.crop import LEAST_INSIDE, LEAST_KEPT, cleaned, cropped, kept_share, region_of
from fieldfuse.pipelines.fields import Fitted
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.prepare import Prepared
from fieldfuse.poses.region import Region


def shown_part(job: Job, ready: Prepared, fitted: Fitted, notes: list[str], strict: bool) -> tuple[Fitted, Region | None]:
    """The field as `export.crop` and `export.clean` have it exported, and the region (working frame), if it was cropped; `notes` gets what
    was done, or why it was not.

    Raises:
        InputError: with `strict`, a crop that is not possible.
    """
    settings, views, whole = job.settings.export, ready.training, fitted.field
    if settings.clean:
        part = cleaned(whole, views.intrinsics, views.world_from_camera, job.progress)
        notes.append(f"floaters: {whole.voxels - part.voxels} of {whole.voxels} voxels were left out of exports")
        whole = part
    if settings.crop == "off":
        return replace(fitted, field=whole), None
    try:
        region = region_of(settings.crop, ready.scene, views)
        if region is None:
            notes.append("export.crop=auto cropped nothing, since the cameras do not look at one object")
            return replace(fitted, field=whole), None
        part = cropped(whole, region)
        kept, inside = kept_share(whole, part, region, views)
        if part.voxels == 0:
            raise InputError("nothing of the field lies in the region; its numbers are in the frame of the input, as points.ply has it")
        if settings.crop == "auto" and (kept < LEAST_KEPT or inside < LEAST_INSIDE):
            raise InputError(f"{100 * kept:.0f}% of what training images show would stay, and {100 * inside:.0f}% of what lies in the box")
    except InputError as error:
        if strict and settings.crop != "auto":
            job.folder.restore()  # the next export does not try it again
            raise InputError(f"export.crop={settings.crop} is not possible: {error}") from error
        notes.append(f"nothing was cropped: {error}")
        return replace(fitted, field=whole), None
    notes.append(f"exports are cropped ({settings.crop}): they hold {100 * kept:.0f}% of what training images show")
    return replace(fitted, field=part), region
