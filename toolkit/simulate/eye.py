"""What a scene answers, rays in, light and geometry out; a camera's pixels as rays; and the exact image that they make of a scene.

Rays go through the camera's lens, with a pose for each row if it has a rolling shutter. Procedural and mesh scenes are both a `Scenery`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch

from fieldfuse.camera import EQUIRECTANGULAR, FISHEYE, Array, Intrinsics, directions_of, pixel_grid
from fieldfuse.effects.models import Distortion, encode_srgb
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.simulate.solids import FAR, Mesh

Tensor = torch.Tensor


@dataclass(frozen=True)
class Rays:
    """Rays of an image or of any other list."""

    origins: Tensor  # (N, 3), or (1, 3) when they start at one place
    directions: Tensor  # (N, 3) unit
    spread: float  # angle between neighbouring rays in radians: what a pixel covers is spread · distance


@dataclass(frozen=True)
class Seen:
    """What rays see, one row a ray."""

    linear: Tensor  # (N, 3) linear light, not clipped
    distance: Tensor  # (N,) metres along the ray, `FAR` where nothing is hit
    normals: Tensor  # (N, 3) unit, world axes, towards the viewer; 0 where nothing is hit
    albedo: Tensor  # (N, 3) linear reflectance
    gloss: Tensor  # (N,)
    part: Tensor  # (N,) int64: changes across visible edges (solid, face, shadow)


class Scenery(Protocol):
    """A scene that can be filmed. z is up, lengths are metres.

    Attributes:
        free: (2, 3) box in which a camera can move; `clearance` finds what stands in it.
        focus: (3,) what there is to look at.
        background: what rays see that hit nothing; None: black, at no cost.
        highlights: the lamps' reflection on glossy surfaces; None: none, at no cost.
    """

    free: Array
    focus: Array
    background: Background | None
    highlights: Highlights | None

    @property
    def device(self) -> torch.device:
        """Where tensors live."""

    def see(self, beam: Rays) -> Seen:
        """What rays see."""

    def clearance(self, points: Tensor) -> Tensor:
        """(N,) metres from (N, 3) points to the nearest surface."""

    def mesh(self) -> Mesh:
        """All surfaces as triangles."""


@dataclass(frozen=True)
class Eye:
    """Directions of a camera's pixels in its own axes, row by row."""

    intrinsics: Intrinsics
    side: int  # rays across a pixel, each way, where it holds an edge
    rows: Tensor  # (H · W,) int64 row of each pixel
    directions: Tensor  # (H · W, 3) unit, through pixel centres
    cosine: Tensor  # (H · W,) depth along z = distance · cosine; 1 for fisheye lenses and panoramas
    finer: Tensor | None  # (H · W, side², 3) unit, through the places of a pixel; None when side is 1


@dataclass(frozen=True)
class Picture:
    """One exposure at one instant: linear light and geometry, aligned, on the scene's device."""

    linear: Tensor  # (H, W, 3) float32, not clipped
    depth: Tensor  # (H, W) float32 metres along z (fisheye, panorama: along the ray) at pixel centres, 0 where nothing is hit
    normals: Tensor  # (H, W, 3) unit, world axes; 0 where nothing is hit
    albedo: Tensor  # (H, W, 3) linear reflectance; 0 where nothing is hit
    gloss: Tensor  # (H, W)

    @property
    def rgb(self) -> Tensor:
        """(H, W, 3) float32 sRGB in [0, 1]."""
        return encode_srgb(self.linear)


@lru_cache(maxsize=4)
def eye_of(intrinsics: Intrinsics, side: int, device: torch.device) -> Eye:
    """The rays of a camera: made once, used for every frame."""
    grid = pixel_grid(intrinsics.width, intrinsics.height)
    directions, cosine = _directions(intrinsics, grid)
    finer = None
    if side > 1:
        steps = (np.arange(side) + 0.5) / side - 0.5
        inside = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)
        finer = _directions(intrinsics, (grid[:, None] + inside).reshape(-1, 2))[0].reshape(len(grid), side * side, 3).to(device)
    rows = torch.from_numpy(grid[:, 1].astype(np.int64))
    return Eye(intrinsics, side, rows.to(device), directions.to(device), cosine.to(device), finer)


def _directions(intrinsics: Intrinsics, pixels: Array) -> tuple[Tensor, Tensor]:
    """Unit directions (N, 3) in camera axes through (N, 2) pixels, and their cosines with the optical axis (N,)."""
    if intrinsics.lens in (FISHEYE, EQUIRECTANGULAR):
        rays = torch.from_numpy(directions_of(intrinsics, pixels))
        return rays.float(), torch.ones(len(rays))  # what lies beside and behind has no depth along the axis: it is the distance
    place = torch.from_numpy((pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy])
    ideal = Distortion.of(intrinsics).invert(place) if intrinsics.distorted else place
    cosine = (1 + ideal.square().sum(1)).rsqrt()
    return torch.cat([ideal * cosine[:, None], cosine[:, None]], dim=1).float(), cosine.float()


def take(scene: Scenery, eye: Eye, poses: Array) -> Picture:
    """The picture of a scene.

    Args:
        poses: (1, 4, 4) world_from_camera, or (H, 4, 4): one a row of pixels.
    """
    return _exposed(scene, eye, poses, eye.rows, 1)[0]


def take_all(scene: Scenery, eye: Eye, poses: Array) -> list[Picture]:
    """Pictures of a scene from poses (B, 4, 4), as `take` makes them, all rays at once: that is fewer launches on a device."""
    which = torch.arange(len(poses), device=eye.directions.device).repeat_interleave(len(eye.directions))
    return _exposed(scene, eye, poses, which, len(poses))


def _exposed(scene: Scenery, eye: Eye, poses: Array, which: Tensor, count: int) -> list[Picture]:
    """`count` pictures; `which` (count · H · W,) is the pose of each pixel."""
    shape, spread, pixels = (count, eye.intrinsics.height, eye.intrinsics.width), 1 / eye.intrinsics.fx, len(eye.directions)
    seen = scene.see(_beam(poses, eye.directions.repeat(count, 1), which, spread))
    linear = seen.linear
    if eye.finer is not None:
        chosen = edges(seen.part.view(shape)).view(-1).nonzero()[:, 0]
        if len(chosen):
            each = eye.side**2
            fine = eye.finer[chosen % pixels].reshape(-1, 3)
            light = scene.see(_beam(poses, fine, which[chosen].repeat_interleave(each), spread / eye.side)).linear
            linear[chosen] = light.reshape(-1, each, 3).mean(1)
    depth = torch.where(seen.distance < FAR, seen.distance * eye.cosine.repeat(count), 0.0)
    made = [values.reshape(*shape, *values.shape[1:]) for values in (linear, depth, seen.normals, seen.albedo, seen.gloss)]
    return [Picture(*(values[number] for values in made)) for number in range(count)]


def _beam(poses: Array, directions: Tensor, which: Tensor, spread: float) -> Rays:
    """Camera directions (N, 3) → rays in the world; `which` (N,) choose among the poses when there are several."""
    pose = torch.from_numpy(np.asarray(poses, dtype=np.float64)[:, :3]).float().to(directions.device)  # (B, 3, 4)
    if len(pose) > 1:
        pose = pose[which]  # (N, 3, 4)
    x, y, z = directions[:, 0, None], directions[:, 1, None], directions[:, 2, None]
    turned = torch.addcmul(torch.addcmul(x * pose[:, :, 0], y, pose[:, :, 1]), z, pose[:, :, 2])
    return Rays(pose[:, :, 3], turned, spread)


def edges(part: Tensor) -> Tensor:
    """(…, H, W) bool: pixels whose right, left, upper or lower neighbour shows another part."""
    out = torch.zeros_like(part, dtype=torch.bool)
    across, down = part[..., 1:] != part[..., :-1], part[..., 1:, :] != part[..., :-1, :]
    out[..., 1:] |= across
    out[..., :-1] |= across
    out[..., 1:, :] |= down
    out[..., :-1, :] |= down
    return out
