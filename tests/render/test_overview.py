"""Which view is taken for the first that a visitor sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.render.overview import overview
from fieldfuse.render.paths import look_at

LENS = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)


@dataclass(frozen=True)
class Depth:
    depth: Array


def wall(lens: Intrinsics, pose: Array) -> Depth:
    """A wall at y = 0, four units wide and high; nothing beside it."""
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -pose[1, 3] / rays[..., 1]
        place = pose[:3, 3] + depth[..., None] * rays
    return Depth(np.where((depth > 0) & (np.abs(place[..., [0, 2]]) < 2).all(-1), depth, 0.0))


def test_the_view_of_most_is_found() -> None:
    """Neither one that is close, nor one that looks past it, nor one at what nobody else filmed: that which has all of the wall."""
    up = np.array([0.0, 0.0, 1.0])
    places = np.array([[0.0, -0.4, 0.0], [0.5, -1.5, 0.2], [0.0, -4.5, 0.0], [-1.0, -1.0, 0.0], [0.0, -4.5, 0.0], [1.0, -9.0, 0.0]])
    targets = np.array([[0.0, 0, 0], [0.5, 0, 0.2], [0.0, 0, 0], [-1.0, 0, 0], [4.0, 0, 0], [1.0, 0, 0.0]])
    poses = look_at(places, targets, up)
    assert overview(wall, [LENS] * len(poses), poses, 2.0) == 2
