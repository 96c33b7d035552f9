"""Cameras: intrinsics, lens models, rigid poses, similarities, rays. The only place where conventions live.

Ours: OpenCV axes (x right, y down, z forward), `world_from_camera` 4×4 float64, pixel centres at (u + 0.5, v + 0.5),
depth along z. What other tools use is turned into this by the functions below, called by readers and writers only.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldfuse.errors import InputError

if TYPE_CHECKING:
    import torch

Array = NDArray[Any]

PINHOLE = "pinhole"
OPENCV = "opencv"  # k1, k2, p1, p2[, k3[, k4, k5, k6]] as in OpenCV
FISHEYE = "fisheye"  # k1, k2, k3, k4 of OpenCV's equidistant model
EQUIRECTANGULAR = "equirectangular"  # the whole sphere: longitude across, latitude down, the axis z in the middle
LENSES = (PINHOLE, OPENCV, FISHEYE, EQUIRECTANGULAR)
WIDEST = float(np.radians(100.0))  # off the axis: farther out fisheye lenses show hardly anything that is sharp


@dataclass(frozen=True)
class Intrinsics:
    """A camera's interior: size in pixels, focal lengths and principal point (pixel centres at +0.5), lens."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: str = PINHOLE
    distortion: tuple[float, ...] = ()

    def matrix(self) -> Array:
        """(3, 3) K with pixel centres at +0.5."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def matrix_integer_centres(self) -> Array:
        """(3, 3) K with pixel centres at whole numbers, as OpenCV's image functions and Open3D expect."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1]], dtype=np.float64)

    def scaled(self, width: int, height: int) -> Intrinsics:
        """The same camera for the image resized to width × height."""
        sx, sy = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def pinhole(self) -> Intrinsics:
        """The same camera without its lens."""
        return replace(self, lens=PINHOLE, distortion=())

    @classmethod
    def equirectangular(cls, width: int, height: int) -> Intrinsics:
        """The camera of a 360° panorama of that size: fx, fy are pixels a radian of longitude and latitude."""
        return cls(width, height, width / (2 * np.pi), height / np.pi, width / 2, height / 2, EQUIRECTANGULAR)

    @property
    def distorted(self) -> bool:
        return self.lens in (FISHEYE, EQUIRECTANGULAR) or any(abs(value) > 0 for value in self.distortion)

    def checked(self, where: str) -> Intrinsics:
        """Self, when it is a usable camera.

        Raises:
            InputError: naming `where` the camera came from.
        """
        numbers = [self.fx, self.fy, self.cx, self.cy, *self.distortion]
        if not np.all(np.isfinite(numbers)):
            raise InputError(f"{where}: the intrinsics hold a value that is not finite; correct or remove them")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"{where}: the focal length is {min(self.fx, self.fy):g} pixels, it must be positive; correct it")
        if self.width < 1 or self.height < 1:
            raise InputError(f"{where}: the image size {self.width}×{self.height} is not usable")
        if self.lens not in LENSES:
            raise InputError(f"{where}: the lens model {self.lens!r} is not known; known are {', '.join(LENSES)}")
        most = {PINHOLE: 0, FISHEYE: 4, EQUIRECTANGULAR: 0}.get(self.lens, 14)
        if len(self.distortion) > most and any(self.distortion[most:]):
            given = len(self.distortion)
            raise InputError(f"{where}: the lens model {self.lens!r} takes at most {most} coefficients, here are {given}; correct them")
        return self

    def centred(self, where: str, slack: float = 0.0) -> Intrinsics:
        """Self, when its principal point lies in the picture, or at most `slack` of a side outside it.

        Not part of `checked`: what was cut out of a larger picture may have it elsewhere. Read from a file, such a point mostly tells
        that the intrinsics are for pictures of another size.

        Raises:
            InputError: naming `where` the camera came from, and what is probably wrong.
        """
        point = f"{where}: the principal point ({self.cx:g}, {self.cy:g})"
        if abs(self.cx) < 2 and abs(self.cy) < 2 and min(self.width, self.height) >= 16:
            raise InputError(
                f"{point} lies in the corner of the {self.width}×{self.height} picture; the intrinsics seem to be shares of the picture's "
                "size: give them in pixels"
            )
        across, down = self.cx / self.width, self.cy / self.height
        if not (-slack <= across <= 1 + slack and -slack <= down <= 1 + slack):
            raise InputError(
                f"{point} lies outside the {self.width}×{self.height} picture; the intrinsics are probably for pictures of another size: "
                "give these, or intrinsics for the size at hand"
            )
        return self

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "distortion": list(self.distortion)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Intrinsics:
        return cls(**{**data, "distortion": tuple(data.get("distortion", ()))})


# --------------------------------------------------------------------------------------------------- lens


def distort(intrinsics: Intrinsics, points: Array) -> Array:
    """(N, 2) ideal image-plane points (x/z, y/z) → (N, 2) distorted image-plane points."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if not intrinsics.distorted or len(points) == 0:
        return points.copy()
    if intrinsics.lens == EQUIRECTANGULAR:
        return np.stack([np.arctan(points[:, 0]), np.arctan2(points[:, 1], np.hypot(points[:, 0], 1.0))], axis=1)
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    coefficients = _coefficients(intrinsics)
    if intrinsics.lens == FISHEYE:
        out, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), coefficients)
    else:
        out, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
    return out.reshape(-1, 2)


def _coefficients(intrinsics: Intrinsics) -> Array:
    """The lens coefficients, padded with zeros to a number that OpenCV takes (4; or 4, 5, 8, 12 or 14)."""
    values = [float(value) for value in intrinsics.distortion]
    length = 4 if intrinsics.lens == FISHEYE else next((n for n in (4, 5, 8, 12, 14) if len(values) <= n), 14)
    return np.array((values + [0.0] * length)[:length], dtype=np.float64)


def lens_limit(intrinsics: Intrinsics, radius: float) -> float:
    """How far from the axis (x/z, up to `radius`) the lens model is one-to-one.

    A polynomial with negative terms turns back at some radius; beyond it, different rays would claim the same pixel.
    """
    if not intrinsics.distorted:
        return radius
    radial = _coefficients(intrinsics)
    if intrinsics.lens == OPENCV:
        radial[2:4] = 0  # tangential terms shift, they do not fold
    steps = np.linspace(0, radius, 2049)
    bent = distort(replace(intrinsics, distortion=tuple(radial)), np.stack([steps, np.zeros_like(steps)], axis=1))[:, 0]
    folded = np.flatnonzero(~(np.diff(bent) > 0))
    return float(steps[folded[0]]) if len(folded) else radius


def seen_at(intrinsics: Intrinsics, directions: Array) -> tuple[Array, Array]:
    """Where a camera shows directions (..., 3) in its own axes, whatever their length; also those beside and behind it that its lens shows.

    Returns:
        pixels (..., 2), centres at +0.5, and (...) bool whether the direction lies in the image: there the lens model is one-to-one, and of
        a fisheye lens at most `WIDEST` off the axis. Pixels of other directions mean nothing.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # coefficients may be anybody's
        return _seen_at(intrinsics, *np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0))


def _seen_at(intrinsics: Intrinsics, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    flat = np.hypot(x, y)
    if intrinsics.lens == EQUIRECTANGULAR:
        place, seen = np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1), np.ones(x.shape, dtype=bool)
    elif intrinsics.lens == FISHEYE:
        angle = np.arctan2(flat, z)
        seen = angle < _fisheye_limit(intrinsics)
        place = np.stack([x, y], axis=-1) * (_fisheye_radius(intrinsics, angle) / np.maximum(flat, 1e-12))[..., None]
    else:
        ideal = np.stack([x, y], axis=-1) / np.where(z > 1e-9, z, 1.0)[..., None]
        seen = (z > 1e-9) & (np.hypot(ideal[..., 0], ideal[..., 1]) <= lens_limit(intrinsics, float(np.tan(np.radians(80)))))
        place = distort(intrinsics, ideal.reshape(-1, 2)).reshape(ideal.shape)
    pixels = place * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
    u, v = pixels[..., 0], pixels[..., 1]
    if intrinsics.lens != EQUIRECTANGULAR:
        seen &= (u >= 0) & (u <= intrinsics.width) & (v >= 0) & (v <= intrinsics.height)
    return pixels, seen


def directions_of(intrinsics: Intrinsics, pixels: Array) -> Array:
    """(N, 2) pixels, centres at +0.5, of a camera without OpenCV's polynomial → (N, 3) unit directions in its axes, the reverse of
    `seen_at`. Beyond what a fisheye lens shows, the direction is that of its rim."""
    x, y = ((np.asarray(pixels, dtype=np.float64) - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]).T
    if intrinsics.lens == EQUIRECTANGULAR:
        return np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], axis=1)
    if intrinsics.lens == FISHEYE:
        radius = np.hypot(x, y)
        angles = np.linspace(0, _fisheye_limit(intrinsics), 8193)  # inverted by a table: to a thousandth of a pixel, and better
        with np.errstate(over="ignore", invalid="ignore"):
            angle = np.interp(radius, _fisheye_radius(intrinsics, angles), angles)
        aside = np.sin(angle) / np.maximum(radius, 1e-12)
        return np.stack([x * aside, y * aside, np.cos(angle)], axis=1)
    if intrinsics.distorted:
        raise ValueError("the polynomial of OpenCV's lens is inverted elsewhere")
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _fisheye_radius(intrinsics: Intrinsics, angle: Array) -> Array:
    """θ(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸) of OpenCV's fisheye model."""
    square, total = angle * angle, np.zeros_like(angle)
    for value in reversed(_coefficients(intrinsics)):
        total = (total + value) * square
    return np.asarray(angle * (1 + total))


def _fisheye_limit(intrinsics: Intrinsics) -> float:
    """Radians off the axis, at most `WIDEST`, up to which a fisheye lens is one-to-one."""
    angles = np.linspace(0, WIDEST, 2049)
    with np.errstate(over="ignore", invalid="ignore"):
        folded = np.flatnonzero(~(np.diff(_fisheye_radius(intrinsics, angles)) > 0))
    return float(angles[folded[0]]) if len(folded) else WIDEST


def resample_maps(source: Intrinsics, target: Intrinsics) -> tuple[Array, Array, Array]:
    """Where each pixel of the pinhole camera `target` lies in the image of `source`, a camera at the same place looking the same way.

    Two such cameras see each point along the same ray, so the map does not depend on depth.

    Returns:
        map x and map y (height, width) float32 in OpenCV's whole-number pixel coordinates, and a (height, width) bool mask of
        pixels that have a source.
    """
    shape = target.height, target.width
    map_x, map_y, valid = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, bool)
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx
    y = (np.arange(target.height) + 0.5 - target.cy) / target.fy
    limit = lens_limit(source, float(np.hypot(np.abs(x).max(), np.abs(y).max())))
    rows = max(1, 500_000 // target.width)  # in strips: the float64 steps in between take much more memory than the maps
    for start in range(0, target.height, rows):
        part = slice(start, min(start + rows, target.height))
        ideal = np.stack(np.meshgrid(x, y[part]), axis=-1).reshape(-1, 2)
        bent = distort(source, ideal)
        u = bent[:, 0] * source.fx + source.cx - 0.5
        v = bent[:, 1] * source.fy + source.cy - 0.5
        # A rounding error's worth of tolerance: without a lens, the outermost samples lie on the border itself.
        seen = (u >= -0.5 - 1e-6) & (u <= source.width - 0.5 + 1e-6) & (v >= -0.5 - 1e-6) & (v <= source.height - 0.5 + 1e-6)
        seen &= np.hypot(ideal[:, 0], ideal[:, 1]) <= limit
        map_x[part], map_y[part], valid[part] = u.reshape(-1, shape[1]), v.reshape(-1, shape[1]), seen.reshape(-1, shape[1])
    return map_x, map_y, valid


def undistort_maps(intrinsics: Intrinsics, width: int, height: int) -> tuple[Intrinsics, Array, Array, Array]:
    """Maps that undistort and resize in one `cv2.remap`, so that an image is resampled once.

    Returns:
        the pinhole camera of the result (width × height), map x and map y (height, width) float32 into the source image in
        OpenCV's whole-number pixel coordinates, and a (height, width) bool mask of pixels that have a source.
    """
    target = intrinsics.pinhole().scaled(width, height)
    return target, *resample_maps(intrinsics, target)


def pinhole_share(intrinsics: Intrinsics) -> float:
    """Share of a distorted image's pixels that the pinhole image of the same size and focal length shows."""
    across = 64
    height = max(2, round(across * intrinsics.height / intrinsics.width))
    seen = np.zeros((height, across), dtype=bool)
    fine = intrinsics.pinhole().scaled(4 * across, 4 * height)
    map_x, map_y, valid = resample_maps(intrinsics, fine)
    column = np.clip(map_x[valid] / intrinsics.width * across, 0, across - 1).astype(int)
    row = np.clip(map_y[valid] / intrinsics.height * height, 0, height - 1).astype(int)
    seen[row, column] = True
    return float(seen.mean())


# --------------------------------------------------------------------------------------------------- poses


def world_from_opengl(pose: Array) -> Array:
    """OpenGL/Blender camera-to-world (x right, y up, z back) → world_from_camera in OpenCV axes."""
    return np.asarray(pose, dtype=np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])


opengl_from_world = world_from_opengl  # flipping two axes is its own inverse


def world_from_llff(pose: Array) -> Array:
    """LLFF camera-to-world, (3, 4) with axes (down, right, back) → world_from_camera in OpenCV axes."""
    pose = np.asarray(pose, dtype=np.float64)
    down, right, back, centre = pose[:, 0], pose[:, 1], pose[:, 2], pose[:, 3]
    out = np.eye(4)
    out[:3] = np.stack([right, down, -back, centre], axis=1)
    return out


def invert(pose: Array) -> Array:
    """Inverse of rigid (..., 4, 4) poses."""
    pose = np.asarray(pose, dtype=np.float64)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    out = np.zeros_like(pose)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, pose[..., :3, 3])
    out[..., 3, 3] = 1
    return out




@dataclass(frozen=True)
class Similarity:
    """x_to = scale · rotation · x_from + translation, float64. Kept with a run: working frame from the input's frame."""

    scale: float
    rotation: Array  # (3, 3)
    translation: Array  # (3,)

    @classmethod
    def identity(cls) -> Similarity:
        return cls(1.0, np.eye(3), np.zeros(3))

    def points(self, points: Array) -> Array:
        """(..., 3) → (..., 3)."""
        return self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation

    def directions(self, directions: Array) -> Array:
        """(..., 3) unit vectors (normals) → (..., 3)."""
        return np.asarray(directions, dtype=np.float64) @ self.rotation.T

    def poses(self, poses: Array) -> Array:
        """(..., 4, 4) rigid world_from_camera → the same cameras in the other frame, still rigid."""
        poses = np.asarray(poses, dtype=np.float64)
        out = poses.copy()
        out[..., :3, :3] = self.rotation @ poses[..., :3, :3]
        out[..., :3, 3] = self.points(poses[..., :3, 3])
        return out

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def after(self, first: Similarity) -> Similarity:
        """The similarity that applies `first`, then self."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self.points(first.translation))

    def to_dict(self) -> dict[str, Any]:
        return {"scale": self.scale, "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Similarity:
        return cls(float(data["scale"]), np.array(data["rotation"], dtype=np.float64), np.array(data["translation"], dtype=np.float64))


# --------------------------------------------------------------------------------------------------- rays


def project(intrinsics: Intrinsics, world_from_camera: Array, points: Array) -> tuple[Array, Array]:
    """(N, 3) world points → (N, 2) pixels (centres at +0.5, through the lens) and (N,) depth along z.

    Points at or behind the camera get depth ≤ 0 and a pixel of NaN.
    """
    camera = np.asarray(points, dtype=np.float64) @ invert(world_from_camera)[:3, :3].T + invert(world_from_camera)[:3, 3]
    depth = camera[:, 2]
    pixels = np.full((len(camera), 2), np.nan)
    front = depth > 1e-12
    bent = distort(intrinsics, camera[front, :2] / depth[front, None])
    pixels[front] = bent * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
    return pixels, depth


def unproject(intrinsics: Intrinsics, world_from_camera: Array, pixels: Array, depth: Array) -> Array:
    """(N, 2) pixels (centres at +0.5) of a pinhole camera and (N,) z-depth → (N, 3) world points."""
    pixels = np.asarray(pixels, dtype=np.float64)
    depth = np.asarray(depth, dtype=np.float64)
    x = (pixels[:, 0] - intrinsics.cx) / intrinsics.fx * depth
    y = (pixels[:, 1] - intrinsics.cy) / intrinsics.fy * depth
    camera = np.stack([x, y, depth], axis=1)
    return camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


def pixel_grid(width: int, height: int) -> Array:
    """(height · width, 2) pixel centres, row by row."""
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1)


def rays(intrinsics: Intrinsics, world_from_camera: Array, pixels: Array) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rays of a pinhole camera through (N, 2) pixels.

    Returns:
        origins (N, 3) and unit directions (N, 3) float32, and (N,) float32 cosines: depth along z = distance × cosine.
    """
    import torch  # here: more than a second, and whoever only reads cameras or finds poses needs none of it

    x = (pixels[:, 0] - intrinsics.cx) / intrinsics.fx
    y = (pixels[:, 1] - intrinsics.cy) / intrinsics.fy
    camera = np.stack([x, y, np.ones_like(x)], axis=1)
    cosine = 1.0 / np.linalg.norm(camera, axis=1)
    directions = (camera * cosine[:, None]) @ world_from_camera[:3, :3].T
    origins = np.broadcast_to(world_from_camera[:3, 3], directions.shape)
    return (
        torch.from_numpy(np.ascontiguousarray(origins, dtype=np.float32)),
        torch.from_numpy(directions.astype(np.float32)),
        torch.from_numpy(cosine.astype(np.float32)),
    )
