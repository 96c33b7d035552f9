"""Small pictures with known cameras: a corner of textured walls, a post whose sides look alike, and a panorama seen by a camera that only
turns."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import PosesSettings
from fieldfuse.poses import database as store
from fieldfuse.poses.job import Job, plan
from fieldfuse.poses.mapping import Model, plain
from fieldfuse.poses.match import match

CAMERA = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
# Point, two edges: floor, two walls that meet, and a box's face and top before them.
PLANES = [
    ((-4, 0, -2), (8, 0, 0), (0, 0, 8)),
    ((-4, 0, 4), (8, 0, 0), (0, -5, 0)),
    ((-2.5, 0, -2), (0, 0, 8), (0, -5, 0)),
    ((-0.7, 0, 1.2), (1.4, 0, 0), (0, -0.9, 0)),
    ((-0.7, -0.9, 1.2), (1.4, 0, 0), (0, 0, 1.4)),
]


def texture(seed: int, size: int = 512) -> Array:
    """(size, size) uint8: noise at several scales, blobs at each, so that SIFT finds keypoints."""
    random = np.random.default_rng(seed)
    out = np.zeros((size, size))
    for cells, weight in ((16, 1.0), (48, 1.0), (128, 0.8)):
        out += weight * cv2.resize(random.standard_normal((cells, cells)), (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 50 * out, 0, 255).astype(np.uint8)


def look_at(eye: Array, target: Array) -> Array:
    """world_from_camera of an upright camera; the world's y points down."""
    z = np.asarray(target, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return pose


def arc(count: int, degrees: float = 50.0) -> Array:
    """(count, 4, 4) cameras on an arc before the corner, at different heights."""
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, count) + 10)
    eyes = np.stack([3.2 * np.sin(angles), -1.3 + 0.25 * np.sin(3 * angles), 2.0 - 3.4 * np.cos(angles)], axis=1)
    return np.array([look_at(eye, np.array([-0.1, -0.7, 2.0])) for eye in eyes])


def orbit(count: int, turns: float) -> Array:
    """(count, 4, 4) cameras on a way around the post, at changing heights and distances."""
    angles = np.radians(np.linspace(0, 360 * turns, count, endpoint=False))
    far = 3 + 0.2 * np.sin(3 * angles)
    eyes = np.stack([far * np.sin(angles), -1.2 + 0.3 * np.sin(2.3 * angles), -far * np.cos(angles)], axis=1)
    return np.array([look_at(eye, np.array([0, -0.6, 0])) for eye in eyes])


def post(sides: tuple[int, int, int, int]) -> list[tuple[Any, Any, Any, Array]]:
    """Planes of a post with these textures on its sides, on a dull floor."""
    w, h = 0.5, 1.4
    floor = cv2.GaussianBlur((120 + 0.1 * texture(101).astype(np.float64)).astype(np.uint8), (0, 0), 1.0)
    corners = [(-w, 0, -w), (w, 0, -w), (w, 0, w), (-w, 0, w)]
    along = [(2 * w, 0, 0), (0, 0, 2 * w), (-2 * w, 0, 0), (0, 0, -2 * w)]
    walls = [(corner, edge, (0, -h, 0), texture(side, 256)) for corner, edge, side in zip(corners, along, sides, strict=True)]
    return [*walls, ((-w, -h, -w), (2 * w, 0, 0), (0, 0, 2 * w), texture(5, 256)), ((-4, 0, -4), (8, 0, 0), (0, 0, 8), floor)]


def render(pose: Array, camera: Intrinsics = CAMERA, planes: list[tuple[Any, Any, Any, Array]] | None = None) -> tuple[Array, Array]:
    """(H, W, 3) uint8 picture and (H, W) float32 z-depth of the planes (the corner's without any); twofold supersampled."""
    planes = planes or [(*plane, texture(index)) for index, plane in enumerate(PLANES)]
    fine = camera.scaled(2 * camera.width, 2 * camera.height)
    rays = _directions(fine) @ pose[:3, :3].T
    depth = np.full(rays.shape[:2], np.inf)
    picture = np.full(rays.shape[:2], 90, np.uint8)
    for corner, first, second, painted in planes:
        corner, first, second = (np.array(values, float) for values in (corner, first, second))
        part = _shown(np.array([corner, corner + first, corner + second, corner + first + second]), pose, fine)
        if rays[part].size == 0:
            continue
        normal = np.cross(first, second)
        t = ((corner - pose[:3, 3]) @ normal) / (rays[part] @ normal)
        hit = pose[:3, 3] + t[..., None] * rays[part] - corner
        a, b = hit @ first / (first @ first), hit @ second / (second @ second)
        nearer = (t > 1e-6) & (t < depth[part]) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        size = len(painted)
        surface = cv2.remap(
            painted, (a * size).astype(np.float32), (b * size).astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        picture[part][nearer], depth[part][nearer] = surface[nearer], t[nearer]
    small = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    z = depth[::2, ::2].astype(np.float32)
    return cv2.cvtColor(small, cv2.COLOR_GRAY2RGB), np.where(np.isfinite(z), z, 0)


@cache
def _directions(camera: Intrinsics) -> Array:
    """(H, W, 3) through the pixels' centres, in the camera's frame, 1 long along z."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)


def _shown(corners: Array, pose: Array, camera: Intrinsics) -> tuple[slice, slice]:
    """Rows and columns of a picture outside which nothing of what lies between the corners (4, 3) is seen."""
    local = (corners - pose[:3, 3]) @ pose[:3, :3]
    if local[:, 2].min() < 1e-3:
        return slice(None), slice(None)
    u, v = camera.fx * local[:, 0] / local[:, 2] + camera.cx, camera.fy * local[:, 1] / local[:, 2] + camera.cy
    rows, columns = ((max(0, int(np.floor(x.min())) - 1), max(0, int(np.ceil(x.max())) + 1)) for x in (v, u))
    return slice(*rows), slice(*columns)


def turning(count: int, step_degrees: float = 4.0) -> list[Array]:
    """Pictures of one distant texture from a camera that only turns: homographies K R K⁻¹."""
    far = cv2.resize(texture(9, 1024), (1600, 1200), interpolation=cv2.INTER_CUBIC)
    k = CAMERA.matrix_integer_centres()
    wide = np.array([[300.0, 0, 799.5], [0, 300.0, 599.5], [0, 0, 1]])
    pictures = []
    for n in range(count):
        yaw = np.radians((n - count / 2) * step_degrees)
        pitch = np.radians(3 * np.sin(n))
        rotation = cv2.Rodrigues(np.array([0, yaw, 0]))[0] @ cv2.Rodrigues(np.array([pitch, 0, 0]))[0]
        pictures.append(
            cv2.warpPerspective(far, k @ invert(_rigid(rotation))[:3, :3] @ np.linalg.inv(wide), (320, 240), flags=cv2.INTER_AREA)
        )
    return pictures


def _rigid(rotation: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def write_capture(folder: Path, pictures: list[Array], ordered: bool = False) -> Capture:
    """PNG files, as a capture of bare photos."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for n, picture in enumerate(pictures):
        path = folder / f"{n:03d}.png"
        cv2.imwrite(str(path), picture if picture.ndim == 2 else picture[..., ::-1])
        frames.append(Frame(path.stem, path))
    return Capture("photos", folder, tuple(frames), ordered=ordered)


def silent(done: float, total: float, note: str) -> None:
    """A report that goes nowhere."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    return list(combinations(range(count), 2))


def made_job(capture: Capture, pairs: Iterable[tuple[int, int]], settings: PosesSettings | None = None, **how: Any) -> Job:
    """A job beside the capture's images, with its features in the database and these pairs matched."""
    job = plan(capture, capture.root.parent / "sparse", settings or PosesSettings(), seed=3, threads=1, **how)
    Path(job.folder).mkdir()
    database = store.open_database(job)
    job = store.tolerant(job, store.extract(job, database, silent))
    database.close()
    match(job, list(pairs), silent)
    return job


def centre_error(model: Model, poses: Array) -> float:
    """`aligned_error` of the cameras of a model of some of these poses."""
    found = plain(model)
    return aligned_error(np.array(found["world_from_camera"])[:, :3, 3], poses[found["pictures"], :3, 3])


def aligned_error(found: Array, true: Array) -> float:
    """Largest distance of (N, 3) centres after the best similarity (Umeyama 1991), relative to the path's length."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ flip) / (a**2).sum()
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(np.linalg.norm(scale * a @ (u @ flip @ vt).T - b, axis=1).max() / length)
