"""Pictures of a field along a path of cameras, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.pipelines.baking import baked_of
from fieldfuse.pipelines.rendered import to_picture
from fieldfuse.progress import Progress
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.pipelines.job import Job
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field

Camera = Callable[[Intrinsics, Array], Any]  # lens, pose → a `Rendered`


def camera_of(job: Job, field: Field, views: Views, scene: Scene, baked: bool) -> Camera:
    """What takes pictures of the field, or of its baked copy, as bright as the training pictures are."""
    from fieldfuse.render.bake_image import BakedRenderer
    from fieldfuse.render.image import make_renderer, render_view

    if baked:
        camera: Camera = BakedRenderer(baked_of(job, field, views, scene)).render
    else:
        camera = partial(render_view, field, view=make_renderer(field))
    exposure = views.exposure
    return camera if exposure == 1 else lambda lens, pose: _exposed(camera(lens, pose), exposure)


def _exposed(rendered: Any, exposure: float) -> Any:
    """Colours become bytes by it."""
    return replace(rendered, rgb=exposed(to_picture(rendered).rgb, exposure))


def pictures(camera: Camera, lenses: list[Intrinsics], poses: Array, progress: Progress) -> Iterator[Array]:
    """(H, W, 3) uint8 for each camera (working frame), one at a time."""
    for index, (lens, pose) in enumerate(zip(lenses, poses, strict=True)):
        progress.check()
        progress.update(index, len(lenses))
        yield to_picture(camera(lens, pose)).rgb


def even(lens: Intrinsics) -> Intrinsics:
    """The camera without its last odd row and column: video formats store colour at half the size."""
    return replace(lens, width=max(2, lens.width // 2 * 2), height=max(2, lens.height // 2 * 2))


def orbit_cameras(views: Views, scene: Scene, frames: int) -> tuple[list[str], list[Intrinsics], Array]:
    """A closed path around what the training cameras look at."""
    from fieldfuse.render.paths import orbit

    poses = orbit(views.world_from_camera, scene.centre, frames)
    lens = even(views.intrinsics[0])
    return [f"orbit_{index:03d}" for index in range(len(poses))], [lens] * len(poses), poses
