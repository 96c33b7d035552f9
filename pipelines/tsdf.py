"""`fieldfuse tsdf`: the classic surface alone, for captures with depth."""

from __future__ import annotations

from typing import Annotated

import typer

from fieldfuse.pipelines.options import Config, Holdout, ImageSize, Json, OptionalOut, Pairs, PosesFrom, Quiet, Target, Threads, gather


def tsdf(
    target: Target,
    out: OptionalOut = None,
    voxel_size: Annotated[
        float | None, typer.Option(help="Side of a voxel in working units (metres for metric captures).", show_default=False)
    ] = None,
    depth_max: Annotated[float | None, typer.Option(help="Depth beyond this is ignored, same unit.", show_default=False)] = None,
    image_size: ImageSize = None,
    holdout: Holdout = None,
    poses: PosesFrom = None,
    threads: Threads = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Fuse the depth pictures into a surface: mesh, points, pictures and scores at the held-out views."""
    from fieldfuse.pipelines.work import work

    flags = {"tsdf.enabled": "on", "tsdf.voxel_size": voxel_size, "tsdf.depth_max": depth_max, "poses.source": poses}
    flags |= {"image_size": image_size, "holdout": holdout, "threads": threads}
    work(target, out, gather(None, config, pairs, **flags), ("tsdf",), quiet=quiet, as_json=json)
