"""Sparse coloured points that go with exported cameras: programs that start from points need some, and their colours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, pixel_grid, project, unproject
from fieldfuse.capture.types import Views
from fieldfuse.export.surface import at_most, spread

if TYPE_CHECKING:
    from fieldfuse.render.field import Field

MOST = 20_000  # points
NEAREST = 5  # images whose median is a point's colour
VIEWS, SIDE = 24, 160  # renders that points of a field are taken from, and their long side in pixels


def thinned(points: Array, most: int = MOST) -> Array:
    """(P,) at most `most` indices of (N, 3) points, evenly chosen."""
    return np.linspace(0, len(points) - 1, min(most, len(points))).astype(int)


def stored_points(path: Path) -> tuple[Array, Array] | None:
    """At most `MOST` points (P, 3) of an exported cloud, and their colours (P, 3) uint8; None where there is none."""
    import trimesh

    if not path.is_file():
        return None
    cloud: Any = trimesh.load(path, process=False)
    chosen = thinned(cloud.vertices)
    return np.asarray(cloud.vertices)[chosen], np.asarray(cloud.colors)[chosen, :3]


def colours_in(points: Array, views: Views) -> Array:
    """(P, 3) uint8 colours of (P, 3) points (working frame): the median over the images that show each from nearest, since what stands
    before it in some of them is not known; grey where none shows it."""
    found = np.full((NEAREST, len(points), 3), np.nan, np.float32)
    nearness = np.zeros((NEAREST, len(points)), np.float32)
    for image, camera, pose in zip(views.images, views.intrinsics, views.world_from_camera, strict=True):
        pixels, depth = project(camera, pose, points)
        inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        scale = np.where(inside, camera.fx / np.maximum(depth, 1e-12), 0).astype(np.float32)
        column, row = np.where(inside[:, None], pixels, 0).astype(int).T
        slot = nearness.argmin(axis=0)
        better = np.flatnonzero(scale > nearness[slot, np.arange(len(points))])
        nearness[slot[better], better] = scale[better]
        found[slot[better], better] = image[row[better], column[better]]
    unseen = np.isnan(found[..., 0]).all(axis=0)
    found[:, unseen] = 128
    return np.asarray(np.nanmedian(found, axis=0)).round().astype(np.uint8)


def points_of_field(field: Field, views: Views, engine: str = "auto") -> tuple[Array, Array]:
    """(P, 3) points of a field's surface (working frame) as some of the views show it, at most `MOST`, and their colours (P, 3) uint8."""
    from fieldfuse.render.image import make_renderer, render_view
    from fieldfuse.tsdf.mesh import as_bytes

    view, points, colours = make_renderer(field, engine), [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for index in spread(len(views), VIEWS):
        lens, pose = at_most(views.intrinsics[index], SIDE), views.world_from_camera[index]
        shown = render_view(field, lens, pose, view)
        depth = shown.depth.reshape(-1)
        there = np.isfinite(depth) & (depth > 0)
        points.append(unproject(lens, pose, pixel_grid(lens.width, lens.height)[there], depth[there]))
        colours.append(as_bytes(shown.rgb).reshape(-1, 3)[there])
    every, shades = np.concatenate(points), np.concatenate(colours)
    chosen = thinned(every)
    return every[chosen], shades[chosen]
