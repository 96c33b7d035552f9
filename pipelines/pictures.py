"""Renders of a field along a path of cameras, its baked copy, and the page that any browser walks through."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.export.surface import spread
from fieldfuse.pipelines.rendered import to_picture
from fieldfuse.progress import Progress
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.pipelines.job import Job
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.bake import BakedField
    from fieldfuse.render.field import Field

Camera = Callable[[Intrinsics, Array], Any]  # lens, pose → a `Rendered`
PAGE = "page"  # as `export.formats` has it
NAME = "field.html"
FLIGHT = 90  # cameras along the page's flight
CANDIDATES = 40  # training views that are looked at for the first view


def camera_of(job: Job, field: Field, views: Views, scene: Scene, baked: bool) -> Camera:
    """What renders the field, or its baked copy, as bright as the training images are."""
    from fieldfuse.render.image import make_renderer, render_view

    if baked:
        field = baked_of(job, field, views, scene).to_field()
    camera = partial(render_view, field, view=make_renderer(field))
    exposure = views.exposure
    if exposure == 1:
        return camera

    def brighter(lens: Intrinsics, pose: Array) -> Any:
        rendered = camera(lens, pose)
        return replace(rendered, rgb=exposed(to_picture(rendered).rgb, exposure))  # colours become bytes by it

    return brighter


def pictures(camera: Camera, lenses: list[Intrinsics], poses: Array, progress: Progress) -> Iterator[Array]:
    """(H, W, 3) uint8 for each camera (working frame), one at a time."""
    for index, (lens, pose) in enumerate(zip(lenses, poses, strict=True)):
        progress.check()
        progress.update(index, len(lenses))
        yield to_picture(camera(lens, pose)).rgb


def orbit_cameras(views: Views, scene: Scene, frames: int) -> tuple[list[str], list[Intrinsics], Array]:
    """A closed path around what the training cameras look at. Video formats store colour at half the size, so sides are even."""
    from fieldfuse.render.paths import orbit

    poses, lens = orbit(views.world_from_camera, scene.centre, frames), views.intrinsics[0]
    lens = replace(lens, width=max(2, lens.width // 2 * 2), height=max(2, lens.height // 2 * 2))
    return [f"orbit_{index:03d}" for index in range(len(poses))], [lens] * len(poses), poses


def baked(job: Job, field: Field, views: Views, seen: float | None = None) -> BakedField:
    """The field baked in memory, without voxels of which no training view shows more than `seen`.

    Raises:
        InputError: a decoder that cannot be baked.
    """
    from fieldfuse.memory import require_baking
    from fieldfuse.render.bake import SEEN, bake, seen_voxels

    field = field.to("cpu")
    require_baking(field)
    keep, train, seen = None, np.flatnonzero(~views.test), SEEN if seen is None else seen
    if seen > 0:
        keep = seen_voxels(field, [views.intrinsics[i] for i in train], views.world_from_camera[train], seen, job.progress)
    return bake(field, keep)


def baked_place(job: Job) -> Path:
    """Where a run's baked field lies."""
    return job.folder / "exports" / "baked.safetensors"


def baked_of(job: Job, field: Field, views: Views, scene: Scene) -> BakedField:
    """The run's baked field; made first where there is none, or one of an earlier fit."""
    from fieldfuse.render.bake_file import read_baked, write_baked

    place, source = baked_place(job), job.folder / "field.safetensors"
    if not (place.is_file() and source.is_file() and place.stat().st_mtime_ns >= source.stat().st_mtime_ns):
        write_baked(place, baked(job, field, views), scene.working_from_input)
    return read_baked(place)


def put_page(job: Job, path: Path, field: Field, views: Views, scene: Scene) -> list[Path]:
    """The baked field as a page that any browser walks through, with the places of all images (not the images) and a flight; answers the
    page and the files beside it that a large field has.

    Args:
        field: without what no training view sees (`crop.seen_part`).

    Raises:
        InputError: a decoder that cannot be baked, or is too wide for a page.
        OutputError: the file cannot be written.
    """
    from fieldfuse.export.page import Tour, require_page, write_page
    from fieldfuse.poses.region import ROOM

    require_page(field)
    _, _, around = orbit_cameras(views, scene, FLIGHT)
    bytes_ = baked(job, field, views, seen=0.0)
    tour = Tour(
        *(views.names, views.intrinsics, views.world_from_camera, views.test),
        path=around,
        depth=scene.median_depth,
        exposure=views.exposure,
        start=_start(field, views, scene),
        working_from_input=scene.working_from_input,
        metric=scene.metric,
        region=scene.surface_box(),
        inside=scene.layout == ROOM,
    )
    return write_page(path, bytes_, tour, job.source.name, field.to("cpu"))


def _start(field: Field, views: Views, scene: Scene) -> int:
    """The training view that shows most."""
    from fieldfuse.render.image import make_renderer, render_view
    from fieldfuse.render.overview import overview

    train = np.flatnonzero(~views.test)
    train = train[spread(len(train), CANDIDATES)]
    render = partial(render_view, field, view=make_renderer(field))
    return int(train[overview(render, [views.intrinsics[i] for i in train], views.world_from_camera[train], scene.median_depth)])
