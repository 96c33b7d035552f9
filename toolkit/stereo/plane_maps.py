"""Planes of a scene as one camera sees them: which of them its pixels lie on, and how far they are."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.stereo.check import numbers


def in_camera(planes: Array, pose: Array) -> Array:
    """(K, 4) planes n · p = d of the world (`planes.find_planes`) in the frame of a camera that stands at `pose` (world from camera)."""
    return np.column_stack([planes[:, :3] @ pose[:3, :3], planes[:, 3] - planes[:, :3] @ pose[:3, 3]])


def numbers_of(depth: Array, camera: Intrinsics, local: Array, on: float, slant: float) -> Array:
    """(H, W) int32 the first of the planes that each pixel lies on; len(local): none of them, −1: there is no depth.

    Args:
        depth: (H, W) along z, 0 = missing.
        local: (K, 4) of `in_camera`.
        on: share of its depth by which a pixel may miss its plane.
        slant: degrees between view and normal beyond which a plane tells no depth: a small error of it is a large one of the depth.
    """
    out = np.empty(depth.shape, np.int32)
    _numbers(depth, numbers(camera), local, on, float(np.cos(np.deg2rad(slant))), out)
    return out


def depth_of(which: Array, camera: Intrinsics, local: Array, slant: float) -> Array:
    """(H, W) float32 depth of plane which[v, u]; 0 where that is −1, behind the camera, or more than `slant` degrees aslant."""
    out = np.zeros(which.shape, np.float32)
    _depths(np.ascontiguousarray(which, dtype=np.int32), numbers(camera), local, float(np.cos(np.deg2rad(slant))), out)
    return out


@numba.njit(cache=True, nogil=True)
def _inverse_on(planes: Array, which: Any, x: float, y: float, slant: float) -> float:
    """Inverse depth of the plane `which` on the ray (x, y, 1), 0: behind the camera, or too much aslant."""
    along = planes[which, 0] * x + planes[which, 1] * y + planes[which, 2]
    offset = planes[which, 3]
    if along * offset <= 0 or abs(along) <= slant * np.sqrt(x * x + y * y + 1):
        return 0.0
    return float(along / offset)


@numba.njit(cache=True, nogil=True)
def _numbers(depth: Array, camera: Array, planes: Array, on: float, slant: float, out: Array) -> None:
    fx, fy, cx, cy = camera
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            out[v, u] = -1
            z = depth[v, u]
            if z <= 0:
                continue
            out[v, u] = len(planes)
            for plane in range(len(planes)):
                inverse = _inverse_on(planes, plane, (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, slant)
                if inverse > 0 and abs(inverse * z - 1) < on:
                    out[v, u] = plane
                    break


@numba.njit(cache=True, nogil=True)
def _depths(which: Array, camera: Array, planes: Array, slant: float, out: Array) -> None:
    fx, fy, cx, cy = camera
    for v in range(which.shape[0]):
        for u in range(which.shape[1]):
            if which[v, u] >= 0:
                inverse = _inverse_on(planes, np.int64(which[v, u]), (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, slant)
                if inverse > 0:
                    out[v, u] = 1 / inverse
