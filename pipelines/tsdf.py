"""`fieldfuse tsdf`: the classic surface alone, for captures with depth."""

from __future__ import annotations

from typing import Annotated

import typer

from fieldfuse.pipelines.options import Options, Place, takes
from fieldfuse.pipelines.work import work


@takes("image_size holdout poses depth_scale threads config pairs quiet json")
def tsdf(
    place: Place,
    voxel_size: Annotated[
        float | None, typer.Option(help="Side of a voxel in working units (metres for metric captures).", show_default=False)
    ] = None,
    depth_max: Annotated[float | None, typer.Option(help="Depth beyond this is ignored, same unit.", show_default=False)] = None,
    *,
    options: Options,
) -> None:
    """Fuse the depth pictures into a surface: mesh, points, pictures and scores at the held-out views."""
    flags = {"tsdf.enabled": "on", "tsdf.voxel_size": voxel_size, "tsdf.depth_max": depth_max}
    work(place, options, ("tsdf",), options.settings(**flags))
