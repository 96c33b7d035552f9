"""Points seen in several posed images: where their rays meet, and how exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.poses.points import undistorted

LEAST_PIXELS = 0.3  # standard deviation, at least, that marks are taken to have
PARALLAX = 1.0  # degrees: rays that differ by less do not give a depth


@dataclass(frozen=True)
class Sights:
    """One point as several cameras see it."""

    ideal: Array  # (K, 2) image-plane points, without the lens
    focal: Array  # (K,) pixels
    pose: Array  # (K, 4, 4) world_from_camera

    @classmethod
    def of(cls, cameras: list[Intrinsics], poses: Array, pixels: Array) -> Sights:
        """Of pixels (K, 2), centres at +0.5, one a camera; those where a lens cannot be inverted are left out."""
        ideal = np.array([undistorted(camera, pixel[None])[0] for camera, pixel in zip(cameras, pixels, strict=True)]).reshape(-1, 2)
        fine = np.isfinite(ideal).all(axis=1)
        focal = np.array([0.5 * (camera.fx + camera.fy) for camera in cameras])
        return cls(ideal[fine], focal[fine], np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)[fine])

    def __len__(self) -> int:
        return len(self.focal)

    def without(self, drop: int) -> Sights:
        keep = np.arange(len(self)) != drop
        return Sights(self.ideal[keep], self.focal[keep], self.pose[keep])

    @property
    def rays(self) -> Array:
        """(K, 3) unit directions in the world."""
        rays = np.concatenate([self.ideal, np.ones((len(self), 1))], axis=1)
        rays = np.einsum("kij,kj->ki", self.pose[:, :3, :3], rays)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    @property
    def parallax(self) -> float:
        """Largest angle between two of the rays, degrees."""
        rays = self.rays
        return float(np.rad2deg(np.arccos(np.clip(rays @ rays.T, -1, 1).min()))) if len(self) else 0.0

    def off(self, point: Array) -> Array:
        """(K, 2) pixels by which the cameras see a point (3,) beside where they do; infinite where it lies behind one."""
        local = np.einsum("kij,j->ki", invert(self.pose)[:, :3, :3], point) + invert(self.pose)[:, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            off = (local[:, :2] / local[:, 2:] - self.ideal) * self.focal[:, None]
        return np.where(local[:, 2:] > 0, off, np.inf)


@dataclass(frozen=True)
class Found:
    """A point with its uncertainty."""

    point: Array  # (3,)
    covariance: Array  # (3, 3)
    pixels: float  # root mean square of how far off its image it lies, over views and both axes
    views: int


def meet(sights: Sights, most: float = np.inf, pixels: float = LEAST_PIXELS) -> Found | None:
    """Where rays meet by least squares over pixels; None: they hardly differ, or do not meet before the cameras.

    Args:
        most: pixels; while there are more than two rays, those that are farther off are left out, the worst first.
        pixels: standard deviation that sights have at least: two rays that meet well by chance are no surer than that.
    """
    while True:
        if len(sights) < 2 or sights.parallax < PARALLAX:
            return None
        found = _meet(sights, pixels)
        worst = np.inf if found is None else float(np.linalg.norm(sights.off(found.point), axis=1).max())
        if worst <= most:
            return found
        if len(sights) == 2:
            return None
        off = [_off_without(sights, index, pixels) for index in range(len(sights))]
        sights = sights.without(int(np.argmin(off)))


def _off_without(sights: Sights, index: int, pixels: float) -> float:
    rest = sights.without(index)
    found = _meet(rest, pixels)
    return np.inf if found is None else float(np.linalg.norm(rest.off(found.point), axis=1).max())


def _meet(sights: Sights, pixels: float) -> Found | None:
    centres, rays = sights.pose[:, :3, 3], sights.rays
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    if np.linalg.cond(across.sum(axis=0)) > 1e12:
        return None
    point = np.linalg.solve(across.sum(axis=0), np.einsum("kij,kj->i", across, centres))
    turn = invert(sights.pose)[:, :3, :3]
    normal = np.eye(3)
    for _ in range(10):  # Gauss-Newton
        off = sights.off(point)
        if not np.isfinite(off).all():
            return None
        local = np.einsum("kij,kj->ki", turn, point - centres)
        slope = np.zeros((len(sights), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = 1 / local[:, 2]
        slope[:, :, 2] = -local[:, :2] / local[:, 2:] ** 2
        design = (sights.focal[:, None, None] * np.einsum("kij,kjl->kil", slope, turn)).reshape(-1, 3)
        normal = design.T @ design
        step = np.linalg.lstsq(normal, -design.T @ off.ravel(), rcond=None)[0]
        point = point + step
        if np.linalg.norm(step) < 1e-10 * max(1.0, float(np.linalg.norm(local, axis=1).max())):
            break
    off = sights.off(point)
    if not np.isfinite(off).all():
        return None
    variance = max(float((off**2).sum()) / max(1, off.size - 3), pixels**2)
    return Found(point, variance * np.linalg.pinv(normal), float(np.sqrt((off**2).mean())), len(sights))
