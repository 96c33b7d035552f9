"""A camera's pixels as rays, through its lens and with a pose for each row, and the exact picture that they make of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, pixel_grid
from fieldfuse.effects.models import Distortion
from fieldfuse.simulate.cast import FAR, tile_order
from fieldfuse.simulate.seen import Rays, Scenery

Tensor = torch.Tensor


@dataclass(frozen=True)
class Eye:
    """Directions of a camera's pixels in its own axes, tile by tile (see `cast`)."""

    intrinsics: Intrinsics
    side: int  # rays across a pixel, each way, where it holds an edge
    order: Tensor  # (H · W,) number of the pixel (row · width + column) at each place of the tile order
    back: Tensor  # (H · W,) its inverse: where each pixel stands in the tile order
    rows: Tensor  # (H · W,) int64 row of each pixel
    directions: Tensor  # (H · W, 3) unit, through pixel centres
    cosine: Tensor  # (H · W,) depth along z = distance · cosine
    finer: Tensor | None  # (H · W, side², 3) unit, through the places of a pixel; None when side is 1


@dataclass(frozen=True)
class Picture:
    """One exposure at one instant: linear light and geometry, aligned, on the scene's device."""

    linear: Tensor  # (H, W, 3) float32, not clipped
    depth: Tensor  # (H, W) float32 metres along z at pixel centres, 0 where nothing is hit
    normals: Tensor  # (H, W, 3) unit, world axes; 0 where nothing is hit
    albedo: Tensor  # (H, W, 3) linear reflectance; 0 where nothing is hit
    gloss: Tensor  # (H, W)


@lru_cache(maxsize=4)
def eye_of(intrinsics: Intrinsics, side: int, device: torch.device) -> Eye:
    """The rays of a camera: made once, used for every frame."""
    order, back = tile_order(intrinsics.width, intrinsics.height)
    grid = pixel_grid(intrinsics.width, intrinsics.height)[order.numpy()]
    directions, cosine = _directions(intrinsics, grid)
    finer = None
    if side > 1:
        steps = (np.arange(side) + 0.5) / side - 0.5
        inside = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)
        finer = _directions(intrinsics, (grid[:, None] + inside).reshape(-1, 2))[0].reshape(len(grid), side * side, 3).to(device)
    rows = torch.from_numpy(grid[:, 1].astype(np.int64))
    return Eye(intrinsics, side, order.to(device), back.to(device), rows.to(device), directions.to(device), cosine.to(device), finer)


def _directions(intrinsics: Intrinsics, pixels: Array) -> tuple[Tensor, Tensor]:
    """Unit directions (N, 3) in camera axes through (N, 2) pixels, and their cosines with the optical axis (N,)."""
    place = (pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    ideal = Distortion.of(intrinsics).invert(torch.from_numpy(place)) if intrinsics.distorted else torch.from_numpy(place)
    cosine = (1 + ideal.square().sum(1)).rsqrt()
    return torch.cat([ideal * cosine[:, None], cosine[:, None]], dim=1).float(), cosine.float()


def take(scene: Scenery, eye: Eye, poses: Array) -> Picture:
    """The picture of a scene.

    Args:
        poses: (1, 4, 4) world_from_camera, or (H, 4, 4): one a row of pixels.
    """
    height, width = eye.intrinsics.height, eye.intrinsics.width
    spread = 1 / eye.intrinsics.fx
    seen = scene.see(_beam(poses, eye.directions, eye.rows, spread))
    linear = seen.linear
    if eye.finer is not None:
        chosen = edges(seen.part[eye.back].reshape(height, width)).reshape(-1)[eye.order].nonzero()[:, 0]
        if len(chosen):
            count = eye.side**2
            fine = eye.finer[chosen].reshape(-1, 3)
            light = scene.see(_beam(poses, fine, eye.rows[chosen].repeat_interleave(count), spread / eye.side)).linear
            linear[chosen] = light.reshape(-1, count, 3).mean(1)
    hit = seen.distance < FAR
    depth = torch.where(hit, seen.distance * eye.cosine, 0.0)
    flat = [values[eye.back] for values in (linear, depth, seen.normals, seen.albedo, seen.gloss)]
    return Picture(*(values.reshape(height, width, *values.shape[1:]) for values in flat))


def take_all(scene: Scenery, eye: Eye, poses: Array) -> list[Picture]:
    """Pictures of a scene from poses (B, 4, 4), as `take` makes them, all rays at once: that is fewer launches on a device."""
    count, height, width = len(poses), eye.intrinsics.height, eye.intrinsics.width
    pixels, spread = height * width, 1 / eye.intrinsics.fx
    device = eye.directions.device
    row = torch.arange(count, device=device).repeat_interleave(pixels)  # which pose
    seen = scene.see(_beam(poses, eye.directions.repeat(count, 1), row, spread))
    linear = seen.linear
    if eye.finer is not None:
        part = seen.part.view(count, pixels)[:, eye.back].view(count, height, width)
        chosen = torch.stack([edges(one) for one in part]).view(count, pixels)[:, eye.order].reshape(-1).nonzero()[:, 0]
        if len(chosen):
            each = eye.side**2
            fine = eye.finer[chosen % pixels].reshape(-1, 3)
            light = scene.see(_beam(poses, fine, row[chosen].repeat_interleave(each), spread / eye.side)).linear
            linear[chosen] = light.reshape(-1, each, 3).mean(1)
    depth = torch.where(seen.distance < FAR, seen.distance * eye.cosine.repeat(count), 0.0)
    made = [values.view(count, pixels, -1)[:, eye.back] for values in (linear, depth, seen.normals, seen.albedo, seen.gloss)]
    return [Picture(*(values[k].reshape(height, width, *([-1] if values.shape[2] > 1 else [])) for values in made)) for k in range(count)]


def measure(scene: Scenery, eye: Eye, poses: Array) -> tuple[Tensor, Tensor]:
    """Depth (H, W) and normals (H, W, 3) alone, without light."""
    seen = scene.see(_beam(poses, eye.directions, eye.rows, 1 / eye.intrinsics.fx), lit=False)
    height, width = eye.intrinsics.height, eye.intrinsics.width
    depth = torch.where(seen.distance < FAR, seen.distance * eye.cosine, 0.0)
    return depth[eye.back].reshape(height, width), seen.normals[eye.back].reshape(height, width, 3)


def _beam(poses: Array, directions: Tensor, rows: Tensor, spread: float) -> Rays:
    """Camera directions (N, 3) → rays in the world; `rows` (N,) choose among the poses when there are several."""
    pose = torch.from_numpy(np.asarray(poses, dtype=np.float64)[:, :3]).float().to(directions.device)  # (1 or H, 3, 4)
    if len(pose) > 1:
        pose = pose[rows]  # (N, 3, 4)
    x, y, z = directions[:, 0, None], directions[:, 1, None], directions[:, 2, None]
    turned = torch.addcmul(torch.addcmul(x * pose[:, :, 0], y, pose[:, :, 1]), z, pose[:, :, 2])
    return Rays(pose[:, :, 3], turned, spread)


def edges(part: Tensor) -> Tensor:
    """(H, W) bool: pixels whose right, left, upper or lower neighbour shows another part."""
    out = torch.zeros_like(part, dtype=torch.bool)
    across, down = part[:, 1:] != part[:, :-1], part[1:] != part[:-1]
    out[:, 1:] |= across
    out[:, :-1] |= across
    out[1:] |= down
    out[:-1] |= down
    return out
