"""The baked copy of a run's field: where it lies, how it is made, when it is made again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.pipelines.job import Job
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.bake import BakedField
    from fieldfuse.render.field import Field

SEEN = 0.01  # see `fieldfuse bake --seen`


def default_place(job: Job) -> Path:
    """Where a run's baked field lies."""
    return job.folder / "exports" / "baked.safetensors"


def write(job: Job, field: Field, views: Views, scene: Scene, seen: float, place: Path) -> BakedField:
    """Bake `field` (on the CPU) into the file `place` and open that.

    Raises:
        InputError: a decoder that cannot be baked.
        OutputError: the file cannot be written.
    """
    from fieldfuse.render.bake_file import read_baked, write_baked

    write_baked(place, baked(job, field, views, seen), scene.working_from_input)
    return read_baked(place)


def baked(job: Job, field: Field, views: Views, seen: float = SEEN) -> BakedField:
    """Bake `field` (on the CPU) in memory.

    Raises:
        InputError: a decoder that cannot be baked.
    """
    import numpy as np
    import torch

    from fieldfuse.memory import require_baking
    from fieldfuse.render.bake import bake as quantise
    from fieldfuse.render.bake_views import seen_voxels

    require_baking(field)
    keep, train = None, np.flatnonzero(~views.test)
    if seen > 0:
        lenses = [views.intrinsics[i] for i in train]
        keep = seen_voxels(field, lenses, views.world_from_camera[train], seen, torch.get_num_threads(), job.progress)
    return quantise(field, keep)


def baked_of(job: Job, field: Field, views: Views, scene: Scene) -> BakedField:
    """The run's baked field; made first where there is none, or one of an earlier fit."""
    from fieldfuse.render.bake_file import read_baked

    place, source = default_place(job), job.folder / "field.safetensors"
    if place.is_file() and source.is_file() and place.stat().st_mtime_ns >= source.stat().st_mtime_ns:
        return read_baked(place)
    return write(job, field.to("cpu"), views, scene, SEEN, place)
