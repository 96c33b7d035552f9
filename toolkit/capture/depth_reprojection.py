"""A depth map reprojected from the camera that measured it into one that stands and looks a little differently."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from fieldfuse.backends.numba.depth_reprojection import close_cracks, splat_nearest
from fieldfuse.camera import FISHEYE, Array, Intrinsics, distort, pixel_grid


def reprojected(depth: Array, camera: Intrinsics, moved: Array) -> Array:
    """What the same camera would measure from another place, as far as the depth map reaches.

    Each pixel goes where its point is seen; of several the nearest stays. Where pixels move apart, lines one pixel wide stay open or
    show what lies behind; they get the mean of the neighbours on either side.

    Args:
        depth: (H, W) float32 along z, 0 = missing.
        camera: of exactly this size; its lens is that of both places.
        moved: (4, 4) the new camera from the old one.

    Returns:
        (H, W) float32 along the new z, 0 where nothing that was measured is seen.
    """
    x, y = _rays(camera)
    rotation, translation = moved[:3, :3].astype(np.float32), moved[:3, 3].astype(np.float32)
    z = depth * (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]) + translation[2]
    valid = (depth > 0) & (z > 0)
    safe = np.where(valid, z, np.float32(1))
    u = (depth * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) + translation[0]) / safe
    v = (depth * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) + translation[1]) / safe
    if camera.distorted:
        bent = distort(camera, np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32)
        u, v = bent[:, 0].reshape(u.shape), bent[:, 1].reshape(v.shape)
    out = np.zeros_like(depth)
    splat_nearest(u * np.float32(camera.fx) + np.float32(camera.cx), v * np.float32(camera.fy) + np.float32(camera.cy), z, valid, out)
    for axis in (0, 1, 0, 1):  # where two lines cross, more than one pixel is open
        close_cracks(out, axis)
    return out


@lru_cache(maxsize=2)
def _rays(camera: Intrinsics) -> tuple[Array, Array]:
    """(H, W) float32 x/z and y/z of the pixels' centres, through the lens."""
    pixels = pixel_grid(camera.width, camera.height)
    if not camera.distorted:
        ideal = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    else:
        values = np.array([*camera.distortion, *[0.0] * 4][: max(4, len(camera.distortion))])
        undo = cv2.fisheye.undistortPoints if camera.lens == FISHEYE else cv2.undistortPoints
        ideal = np.asarray(undo(pixels[:, None], camera.matrix(), values)[:, 0], dtype=np.float64)
    shape = camera.height, camera.width
    return ideal[:, 0].astype(np.float32).reshape(shape), ideal[:, 1].astype(np.float32).reshape(shape)
