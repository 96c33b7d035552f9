"""A textured room seen by cameras of any lens: panoramas, fisheye and plain ones."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, directions_of, pixel_grid
from tests.poses.textured import texture

SIZE = 512
HALF = np.array([2.4, 1.3, 3.1])  # metres from the middle to the walls; y points down


def room(camera: Intrinsics, world_from_camera: Array, soft: float = 0) -> tuple[Array, Array]:
    """What a camera sees of the room from a place within: (H, W, 3) uint8, and (H, W) metres along the ray. Its pictures are blurred by
    `soft` of their 512 pixels."""
    rays = directions_of(camera, pixel_grid(camera.width, camera.height)) @ world_from_camera[:3, :3].T
    place = world_from_camera[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.sign(rays) * HALF - place) / rays
    wall = np.argmin(np.where(np.isfinite(reach), reach, np.inf), axis=1)
    distance = reach[np.arange(len(rays)), wall]
    points = place + distance[:, None] * rays
    shape = camera.height, camera.width
    out = np.zeros((*shape, 3), dtype=np.uint8)
    on_wall = ((points / HALF * 0.5 + 0.5) * (SIZE - 1)).astype(np.float32).reshape(*shape, 3)
    for axis in range(3):
        across, down = (on_wall[..., other] for other in range(3) if other != axis)
        for side in (False, True):
            mine = ((wall == axis) & ((points[:, axis] > 0) == side)).reshape(shape)
            if mine.any():
                out[mine] = cv2.remap(_picture(2 * axis + side, soft), across, down, cv2.INTER_LINEAR)[mine]
    return out, distance.reshape(shape)


@cache
def _picture(wall: int, soft: float) -> Array:
    sharp = np.dstack([texture(3 * wall + channel, SIZE) for channel in range(3)])
    return cv2.GaussianBlur(sharp, (0, 0), soft) if soft else sharp


def walk(count: int, step: float = 0.25) -> Array:
    """(count, 4, 4) poses on a slow way through the room, turning to the right by 8° a step, upright."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for number in range(count):
        turn = np.radians(8 * number)
        poses[number, :3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        poses[number, :3, 3] = [0.15 * np.sin(number) - 0.3, 0.1 * np.cos(2 * number), step * (number - count / 2)]
    return poses
