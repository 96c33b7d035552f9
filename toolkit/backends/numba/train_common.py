"""What the passes over a batch of rays share, compiled: training pixels, losses, and what is gathered for the lattice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.constants import REACH as REACH_
from fieldfuse.backends.numba import common as K

if TYPE_CHECKING:
    from fieldfuse.training.rays import PixelPool

F, ZERO, ONE, TWO = K.F, K.ZERO, K.ONE, K.TWO
REACH = F(REACH_)


GUESS = 12  # bits: of so many pixels the first one's view is known


class Pixels(NamedTuple):
    """The training pixels: see `rays.PixelPool`."""

    colour: Any  # (N, 3) uint8
    places: Any  # (N,) int32 in their pictures; of length 0 where all pixels of all views are there
    starts: Any  # (V + 1,) int64 first pixel of each view
    first_view: Any  # (N >> GUESS,) int32 view of every 2^GUESS-th pixel
    camera: Any  # (V, 5) float32 fx, fy, cx, cy, width
    pose: Any  # (V, 4, 4) float32
    distance: Any  # (N,) float32 to the surface along the ray, 0: unknown; or of length 0


def pixels_of(pool: PixelPool) -> Pixels:
    """What compiled code needs of a pool on the CPU, without a copy."""
    starts, count = pool.starts.numpy(), len(pool)
    first_view = np.searchsorted(starts[1:], np.arange(0, count, 1 << GUESS), side="right").astype(np.int32)
    camera, pose, distance = (of.numpy() for of in (pool.camera, pool.pose, pool.distance))
    return Pixels(pool.colour.numpy(), pool.places.numpy(), starts, first_view, camera, pose, distance)


@njit(**K.LEAF)
def seen_at(pixels: Any, pick: Any) -> Any:
    """Pixel → its view, row and column."""
    view = np.int64(pixels.first_view[pick >> GUESS])
    while pick >= pixels.starts[view + 1]:
        view += 1
    place = np.int32(pick - pixels.starts[view]) if pixels.places.shape[0] == 0 else pixels.places[pick]
    width = np.int32(pixels.camera[view, 4])
    row = place // width
    return view, row, place - row * width


@njit(**K.LEAF)
def ask_for(pixels: Any, pick: Any) -> None:
    """Ask for the memory of a pixel that will be looked at soon."""
    K.prefetch(pixels.colour, pick)
    if pixels.places.shape[0] > 0:
        K.prefetch(pixels.places, pick)
    if pixels.distance.shape[0] > 0:
        K.prefetch(pixels.distance, pick)


class Gradients(NamedTuple):
    """What one thread gathers of a batch."""

    touched: Any  # (T,) int32 rows
    density: Any  # (T,) float32 sums over the rays, in the order of `touched`
    feature: Any  # (T, C) float32


class Losses(NamedTuple):
    """Weights of a step's losses, float32."""

    distortion: Any
    opacity: Any
    depth: Any
    depth_noise: Any
    threshold: Any
    stop: Any
    slow_within: Any  # working units; samples nearer than this move slowly (`near`), 0: none


@njit(**K.LEAF)
def pixel_ray(pixels: Any, pick: Any, rays: Any, at: Any) -> None:
    """Origin and unit direction of pixel `pick` into rays[at, 0 … 5]."""
    view, row, column = seen_at(pixels, pick)
    camera, pose = pixels.camera, pixels.pose
    x = (F(column) + K.HALF - camera[view, 2]) / camera[view, 0]
    y = (F(row) + K.HALF - camera[view, 3]) / camera[view, 1]
    dx = pose[view, 0, 0] * x + pose[view, 0, 1] * y + pose[view, 0, 2]
    dy = pose[view, 1, 0] * x + pose[view, 1, 1] * y + pose[view, 1, 2]
    dz = pose[view, 2, 0] * x + pose[view, 2, 1] * y + pose[view, 2, 2]
    scale = ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
    rays[at, 0], rays[at, 1], rays[at, 2] = pose[view, 0, 3], pose[view, 1, 3], pose[view, 2, 3]
    rays[at, 3], rays[at, 4], rays[at, 5] = dx * scale, dy * scale, dz * scale


@njit(**K.LEAF)
def depth_pull(along: Any, distance: Any, noise: Any) -> Any:
    """`depth.depth_gradient` of one sample."""
    if distance <= ZERO:
        return ZERO
    return min(max(abs(along - distance) / distance - noise, ZERO) / REACH, ONE) - ONE


@njit(**K.LEAF)
def slow_near(along: Any, within: Any) -> Any:
    """`near.slowness` of one sample."""
    share = max(along, ZERO) / within if along < within and within > ZERO else ONE  # a sample may lie behind its camera
    return share * share
