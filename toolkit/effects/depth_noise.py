"""Noise of a depth camera: errors that grow with z², steps of disparity, holes.

    z' = z + Normal(0, (sigma · z²)²)                     triangulation (Khoshelham and Elberink 2012, equation 10)
    1/z'' = step · round(1 / (z' · step))                 disparity comes in whole steps, so depth in steps of about step · z²
    0 where there is no measurement:
        outside [nearest, farthest]
        next to a jump: the `edge` pixels on both sides of neighbours that differ by more than 5%, with probability `edge_loss`
        on dark surfaces:   probability dark_loss · clamp(1 − albedo / dark, 0, 1)
        on glossy surfaces: probability gloss_loss · gloss

Losses come in patches of `patch` × `patch` pixels, as they do in real sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.camera import Array

JUMP = 0.05  # relative difference of depth that makes an edge


@dataclass(frozen=True)
class DepthNoise:
    """Parameters of the effect; lengths in metres."""

    sigma: float = 0.0015  # 1 / metre: the deviation is sigma · z²
    step: float = 0.002  # 1 / metre: one step of disparity as a difference of 1/z; 0: none
    edge: int = 1  # pixels
    edge_loss: float = 0.6
    dark: float = 0.06  # linear albedo below which light is lost
    dark_loss: float = 0.9
    gloss_loss: float = 0.8
    nearest: float = 0.2
    farthest: float = 10.0
    patch: int = 3


PRESETS = {
    "weak": DepthNoise(0.0006, 0.0007, 1, 0.3, 0.03, 0.5, 0.4),
    "medium": DepthNoise(),
    "strong": DepthNoise(0.005, 0.006, 3, 0.9, 0.1, 1.0, 1.0, 0.3, 6.0, 5),
}


def forward(effect: DepthNoise, depth: Array, albedo: Array, gloss: Array, rng: np.random.Generator) -> Array:
    """What the sensor tells.

    Args:
        depth: (H, W) true metres along z, 0 = nothing there.
        albedo: (H, W) linear reflectance, mean of the channels.
        gloss: (H, W) in [0, 1].

    Returns:
        (H, W) float32 metres, 0 = no measurement.
    """
    z = depth.astype(np.float64)
    noisy = z + rng.normal(0, 1, z.shape) * effect.sigma * z**2
    noisy = quantise(effect, noisy)
    lost = loss(effect, z, albedo, gloss)
    rows, columns = (-(-size // effect.patch) for size in z.shape)
    dice = np.kron(rng.uniform(0, 1, (rows, columns)), np.ones((effect.patch, effect.patch)))[: z.shape[0], : z.shape[1]]
    gone = (dice < lost) | (z <= 0) | (noisy < effect.nearest) | (noisy > effect.farthest)
    return np.where(gone, 0, noisy).astype(np.float32)


def quantise(effect: DepthNoise, depth: Array) -> Array:
    """(…) metres rounded to whole steps of inverse depth; what rounds to infinity becomes 0."""
    if effect.step <= 0:
        return depth
    steps = np.round(1 / (np.maximum(depth, 1e-6) * effect.step))
    return np.asarray(np.where((steps > 0) & (depth > 0), 1 / np.maximum(steps * effect.step, 1e-12), 0))


def loss(effect: DepthNoise, depth: Array, albedo: Array, gloss: Array) -> Array:
    """(H, W) float64 probability that a pixel has no measurement, for its surroundings, darkness or gloss."""
    near = np.zeros(depth.shape, dtype=np.uint8)
    for axis in (0, 1):
        before, after = (slice(None),) * axis + (slice(None, -1),), (slice(None),) * axis + (slice(1, None),)
        jump = np.abs(depth[after] - depth[before]) > JUMP * np.minimum(depth[after], depth[before])
        near[before] |= jump
        near[after] |= jump
    if effect.edge > 1:
        near = np.asarray(cv2.dilate(near, np.ones((2 * effect.edge - 1,) * 2, np.uint8)))
    at_edge = effect.edge_loss * (near > 0) * (effect.edge > 0)
    dark = effect.dark_loss * np.clip(1 - albedo / effect.dark, 0, 1)
    shiny = effect.gloss_loss * np.clip(gloss, 0, 1)
    return np.asarray(1 - (1 - at_edge) * (1 - dark) * (1 - shiny), dtype=np.float64)
