"""A small made-up scene with exactly known cameras, for tests that write it in some layout and read it back.

Cameras are kept as three axes and a centre, and are projected with dot products here: nothing of `fieldfuse.camera` is used to make
what the readers are measured against.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.capture.types import Capture

BALL = np.array([0.1, -0.2, 0.6])
RADIUS = 0.6


@dataclass(frozen=True)
class Pinhole:
    """Size, focal lengths and principal point with pixel centres at +0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Eye:
    """Where a camera stands, and its axes in the world (z up)."""

    right: Array
    down: Array
    forward: Array
    centre: Array

    def rotation(self) -> Array:
        """(3, 3) camera from world."""
        return np.stack([self.right, self.down, self.forward])

    def pose(self) -> Array:
        """(4, 4) world from camera, OpenCV axes."""
        out = np.eye(4)
        out[:3] = np.stack([self.right, self.down, self.forward, self.centre], axis=1)
        return out

    def opengl(self) -> Array:
        """(4, 4) camera to world with x right, y up, z back."""
        out = np.eye(4)
        out[:3] = np.stack([self.right, -self.down, -self.forward, self.centre], axis=1)
        return out


def eyes(count: int = 5) -> list[Eye]:
    """Cameras on an arc, looking at the ball, none of them level."""
    out = []
    for index in range(count):
        angle = 0.4 + 0.22 * index
        centre = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), 2.0 + 0.12 * index])
        forward = BALL + np.array([0.1 * index, 0.05, 0.0]) - centre
        forward /= np.linalg.norm(forward)
        level = np.cross(forward, [0, 0, 1.0])
        level /= np.linalg.norm(level)
        sinking = np.cross(forward, level)
        roll = 0.15 - 0.07 * index
        out.append(Eye(np.cos(roll) * level + np.sin(roll) * sinking, np.cos(roll) * sinking - np.sin(roll) * level, forward, centre))
    return out


def pixels_of(eye: Eye, camera: Pinhole, points: Array) -> Array:
    """(N, 3) world → (N, 2) pixels."""
    offset = points - eye.centre
    depth = offset @ eye.forward
    return np.stack([camera.fx * (offset @ eye.right) / depth + camera.cx, camera.fy * (offset @ eye.down) / depth + camera.cy], axis=1)


def render(eye: Eye, camera: Pinhole) -> tuple[Array, Array]:
    """(H, W, 3) uint8 RGB and (H, W) float64 depth along z (0 where nothing is hit): a ball on a plane, smooth colours."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = eye.forward + ((u - camera.cx) / camera.fx)[..., None] * eye.right + ((v - camera.cy) / camera.fy)[..., None] * eye.down
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(rays[..., 2] < 0, -eye.centre[2] / rays[..., 2], np.inf)
        a, b, c = (rays * rays).sum(-1), rays @ (eye.centre - BALL), ((eye.centre - BALL) ** 2).sum() - RADIUS**2
        ball = np.where(b * b > a * c, (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, np.inf)
    depth = np.minimum(plane, ball)
    depth[depth > 12] = 0
    points = eye.centre + rays * depth[..., None]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    waves = [np.sin(2.1 * x + 0.6 * y + z), np.sin(1.7 * y - 0.9 * z), np.cos(1.3 * x - 1.9 * y + 2 * z)]
    colour = np.stack([127 + 110 * wave for wave in waves], axis=-1)
    colour[depth == 0] = 20
    return colour.round().astype(np.uint8), depth


def save_picture(path: Path, rgb: Array) -> None:
    """(H, W, 3) RGB or (H, W, 4) RGBA uint8."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[..., [2, 1, 0, 3]] if rgb.shape[2] == 4 else rgb[..., ::-1])


def save_depth(path: Path, depth: Array, scale: float = 1000.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), (depth * scale).round().astype(np.uint16))


def surface_points() -> Array:
    """(60, 3) points in front of all cameras."""
    return np.random.default_rng(3).uniform([-0.8, -0.8, 0], [0.8, 0.8, 1], (60, 3))


def pixel_error(capture: Capture, made: list[Eye], camera: Pinhole) -> float:
    """The largest distance, in pixels, between where the capture's cameras and the true ones see the same points."""
    worst = 0.0
    points = surface_points()
    assert len(capture.frames) == len(made)
    for frame, eye in zip(capture.frames, made, strict=True):
        assert frame.intrinsics is not None
        assert frame.world_from_camera is not None
        assert (frame.intrinsics.width, frame.intrinsics.height) == (camera.width, camera.height)
        seen, _ = project(frame.intrinsics, frame.world_from_camera, points)
        worst = max(worst, float(np.abs(seen - pixels_of(eye, camera, points)).max()))
    return worst


def left_out(capture: Capture, why: str) -> None:
    """One frame of five was left out, and the remark on that says `why` (a pattern)."""
    told = [warning for warning in capture.warnings if "is left out (" in warning]
    assert len(told) == 1 and len(capture.frames) == 4 and re.search(why, told[0]), capture.warnings


def sample(picture: Array, pixels: Array) -> Array:
    """(N, C) values of an (H, W, C) picture at (N, 2) pixels with centres at +0.5, bilinear."""
    maps = (pixels - 0.5).astype(np.float32)
    return cv2.remap(picture.astype(np.float32), maps[:, None, 0], maps[:, None, 1], cv2.INTER_LINEAR).reshape(len(pixels), -1)


def reprojection(
    source: tuple[Intrinsics, Array, Array],
    target: tuple[Intrinsics, Array, Array],
    step: int = 1,
) -> tuple[Array, Array]:
    """Every `step`-th pixel of a depth picture seen in another frame.

    `source` and `target` are (depth camera, world_from_camera, (H, W) depth, 0 = missing).

    Returns:
        (N, 3) world points that lie inside the target's picture in front of it, and (N,) the relative difference between their
        depth and the target's stored depth (points over missing depth are left out).
    """
    camera, pose, depth = source
    v, u = np.mgrid[0 : depth.shape[0] : step, 0 : depth.shape[1] : step]
    z = depth[v, u]
    ok = z > 0
    pixels = np.stack([u[ok] + 0.5, v[ok] + 0.5], axis=1)
    points = unproject(camera, pose, pixels, z[ok])
    other, other_pose, other_depth = target
    seen, expected = project(other, other_pose, points)
    height, width = other_depth.shape
    ok = (expected > 0) & (seen[:, 0] > 0) & (seen[:, 0] < width) & (seen[:, 1] > 0) & (seen[:, 1] < height)
    points, seen, expected = points[ok], seen[ok].astype(int), expected[ok]
    stored = other_depth[seen[:, 1], seen[:, 0]]
    return points[stored > 0], (stored / expected - 1)[stored > 0]


def colour_difference(points: Array, views: list[tuple[Intrinsics, Array, Array]]) -> float:
    """Mean difference (levels of 255, each at most 40) between what two (camera, pose, picture) views show at the same world points.

    Their median is taken out first: cameras change their exposure on the way.
    """
    colours = []
    inside = np.ones(len(points), dtype=bool)
    for camera, pose, picture in views:
        pixels, _ = project(camera, pose, points)
        inside &= (pixels > 1).all(axis=1) & (pixels[:, 0] < picture.shape[1] - 1) & (pixels[:, 1] < picture.shape[0] - 1)
        colours.append(sample(picture, np.nan_to_num(pixels)))
    assert inside.sum() > 30, "the two views must overlap"
    difference = (colours[0] - colours[1])[inside]
    return float(np.minimum(np.abs(difference - np.median(difference, axis=0)), 40).mean())
