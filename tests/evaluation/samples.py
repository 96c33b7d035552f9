"""Small made-up views and renderings that the tests of this folder share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views


@dataclass
class Drawn:
    """What a renderer answers; `mask` None: everywhere."""

    rgb: Array
    depth: Array
    mask: Array | None = None


def picture(height: int = 72, width: int = 96, phase: float = 0.0) -> Array:
    """(H, W, 3) float64 in [0, 1]: smooth waves, the same on every machine."""
    v, u = np.mgrid[0:height, 0:width] / 32.0
    waves = [np.sin(u * 3 + phase) * np.cos(v * 2), np.sin(u * v + phase), np.cos(u - 2 * v)]
    return np.stack([0.5 + 0.5 * wave for wave in waves], axis=-1)


def ripple(image: Array) -> Array:
    """The picture with a fine ripple over it."""
    return np.clip(image + 0.1 * np.sin(np.arange(image.size) * 12.9898).reshape(image.shape), 0, 1)


def bytes_of(image: Array) -> Array:
    return np.round(image * 255).astype(np.uint8)


def make_views(count: int = 6, height: int = 40, width: int = 56, depth: bool = True, every: int = 3) -> Views:
    """Views along a straight line; every third is a test view."""
    poses = np.repeat(np.eye(4)[None], count, axis=0)
    poses[:, 0, 3] = np.arange(count)
    plane = np.linspace(1, 3, width, dtype=np.float32)[None].repeat(height, axis=0)
    return Views(
        names=[f"{i:04d}.jpg" for i in range(count)],
        images=[bytes_of(picture(height, width, 0.3 * i)) for i in range(count)],
        intrinsics=[Intrinsics(width, height, 50, 50, width / 2, height / 2)] * count,
        world_from_camera=poses,
        test=np.arange(count) % every == 0,
        depths=[plane.copy() for _ in range(count)] if depth else [],
    )


def draw(views: Views, index: int, masked: bool = False) -> Drawn:
    """The true picture with a ripple and the true depth made 10% too large; with `masked` the left half has no surface."""
    rgb = ripple(views.images[index] / 255).astype(np.float32)
    depth = 1.1 * (views.depths[index] if views.depths else np.ones(rgb.shape[:2], np.float32))
    if not masked:
        return Drawn(rgb, depth)
    mask = np.zeros(depth.shape, dtype=bool)
    mask[:, depth.shape[1] // 2 :] = True
    return Drawn(rgb * mask[..., None], depth * mask, mask)
