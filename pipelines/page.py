"""The field of a run as a page that any browser walks through."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fieldfuse.pipelines.baking import baked
from fieldfuse.pipelines.pictures import orbit_cameras

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.pipelines.job import Job
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field

PAGE = "page"  # as `export.formats` has it
NAME = "field.html"
FLIGHT = 90  # cameras along the flight


def put_page(job: Job, path: Path, field: Field, views: Views, scene: Scene) -> Path:
    """The baked field as a page that any browser walks through, with the places of all pictures (not the pictures) and a flight.

    Raises:
        InputError: a decoder that cannot be baked, or is too wide for a page.
        OutputError: the file cannot be written.
    """
    from fieldfuse.export.page import Tour, require_page, write_page

    require_page(field)
    _, _, around = orbit_cameras(views, scene, FLIGHT)
    cameras = (views.names, views.intrinsics, views.world_from_camera, views.test)
    write_page(path, baked(job, field.to("cpu"), views), Tour(*cameras, around, scene.median_depth, views.exposure), job.source.name)
    return path
