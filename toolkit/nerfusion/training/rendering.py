"""Rendering for training across scenes: rays of target images, the losses on them, and numbers that show whether the networks are alive.

The paper trains on colours alone. Two terms are additions: the opacity term says that rays which meet a surface end, and the depth term,
which is annealed to zero early, keeps the networks from settling in fog that explains the colours just as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.render.composite import ray_sum
from fieldfuse.render.field import Field
from fieldfuse.render.rays import render_with_gradients

HIDDEN = 0.05  # relative: what lies this much behind what an image shows is not shown by it
THRESHOLD = 1e-3  # samples of smaller weight are not decoded; they keep their gradient as obstacles
WIDTH = 0.03  # relative: how close to the true distance a weight counts as right
FLOOR = 1e-3  # smallest likelihood: a ray with no weight near the truth costs this much and no more
ALIVE = 0.1  # spatial deviation of features below this means that the encoder no longer distinguishes places


@dataclass(frozen=True)
class TargetRays:
    """R rays through pixels and what they should show."""

    origins: Tensor  # (R, 3)
    directions: Tensor  # (R, 3) of unit length
    colour: Tensor  # (R, 3) true colour
    distance: Tensor  # (R,) true distance along the ray, 0 = unknown or nothing there
    cosine: Tensor  # (R,) depth along z = distance · cosine
    solid: Tensor  # (R,) bool, the ray meets something for certain

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, kept: Tensor | slice) -> TargetRays:
        """The rays at `kept` (indices, bool or slice)."""
        return TargetRays(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))


def rays_through(pictures: Pictures, view: Tensor, row: Tensor, column: Tensor) -> TargetRays:
    """Rays through pixel centres; `view`, `row`, `column` (R,) int64 into `pictures`."""
    fx, fy, cx, cy = pictures.intrinsics[view].unbind(1)
    local = torch.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, torch.ones_like(fx)], 1)
    cosine = 1 / local.norm(dim=1)
    pose = pictures.world_from_camera[view]
    directions = (pose[:, :3, :3] @ (local * cosine[:, None])[:, :, None])[:, :, 0]
    depth = pictures.depths[view, row, column]
    solid = torch.ones_like(depth, dtype=torch.bool) if pictures.background is None else depth > 0
    return TargetRays(pose[:, :3, 3], directions, pictures.images[view, :, row, column], depth / cosine, cosine, solid)


def random_rays(pictures: Pictures, targets: Tensor, count: int, generator: torch.Generator) -> TargetRays:
    """`count` random pixels, evenly over the images at `targets` (any shape). The generator is a CPU one, on every device."""
    height, width = pictures.images.shape[2:]
    flat = targets.reshape(-1).cpu()
    view = flat[torch.arange(count) % len(flat)]
    pixel = torch.randint(height * width, (count,), generator=generator)
    chosen = torch.stack([view, pixel // width, pixel % width]).numpy()
    return rays_through(pictures, *to_device_async(chosen, pictures.images.device).unbind())


def picture_rays(pictures: Pictures, view: int) -> TargetRays:
    """All pixels of one image, row by row."""
    height, width = pictures.images.shape[2:]
    pixel = torch.arange(height * width, device=pictures.images.device)
    return rays_through(pictures, torch.full_like(pixel, view), pixel // width, pixel % width)


def in_sight(rays: TargetRays, pictures: Pictures, references: Tensor) -> Tensor:
    """(R,) bool: at least one of the images at `references` (any shape) shows where a ray ends, or its end is unknown.

    What no reference shows cannot be predicted; such rays would only add noise to the gradient. A reference without depth at a pixel
    counts as showing it.
    """
    points = rays.origins + rays.directions * rays.distance[:, None]
    height, width = pictures.images.shape[2:]
    views = references.reshape(-1)
    pose, lens = pictures.world_from_camera[views], pictures.intrinsics[views]
    fx, fy, cx, cy = (value[:, None] for value in lens.unbind(1))
    local = (points - pose[:, None, :3, 3]) @ pose[:, :3, :3]  # (V, R, 3)
    depth = local[..., 2].clamp_min(1e-9)
    u, v = local[..., 0] / depth * fx + cx, local[..., 1] / depth * fy + cy
    inside = (local[..., 2] > 0) & (u >= 0) & (u <= width) & (v >= 0) & (v <= height)
    there = pictures.depths[views[:, None], v.long().clamp(0, height - 1), u.long().clamp(0, width - 1)]
    return (rays.distance == 0) | (inside & ((there == 0) | (depth <= (1 + HIDDEN) * there))).any(0)


@dataclass(frozen=True)
class Traced:
    """What the differentiable renderer gives for R rays."""

    colour: Tensor  # (R, 3), over its background
    opacity: Tensor  # (R,)
    weight: Tensor  # (S,) of all samples
    distance: Tensor  # (S,) along the rays
    ray: Tensor  # (S,) int64

    @torch.no_grad()
    def median_distance(self) -> Tensor:
        """(R,) distance at which half of a ray's own opacity is reached; 0 where it is empty."""
        rays = len(self.opacity)
        total = torch.cumsum(self.weight.double(), 0)
        before = torch.zeros(rays, dtype=torch.float64, device=total.device)
        opacity = ray_sum(self.weight.double(), self.ray, rays)
        before[1:] = opacity.cumsum(0)[:-1]
        reached = total - before[self.ray] >= 0.5 * opacity[self.ray]
        far = self.distance.new_full((rays,), torch.inf)
        found = far.scatter_reduce(0, self.ray, torch.where(reached, self.distance, torch.inf), "amin")
        return torch.where(torch.isfinite(found) & (self.opacity > 1e-3), found, 0.0)


def trace(field: Field, rays: TargetRays, background: Tensor, generator: torch.Generator | None) -> Traced:
    """Render rays over `background` (3,) or (R, 3); with a generator, samples are moved along the rays by chance."""
    jitter = None if generator is None else to_device_async(torch.rand(len(rays), generator=generator).numpy(), rays.origins.device)
    seen = render_with_gradients(field, rays.origins, rays.directions, jitter, background, THRESHOLD)
    return Traced(seen.colour, seen.opacity, seen.weight, seen.samples.distance, seen.samples.ray)


def background_of(pictures: Pictures, count: int, generator: torch.Generator | None) -> Tensor:
    """(3,) or (count, 3) colour behind everything.

    Where every ray meets something it is random for each ray, so that nothing cannot stand in for a surface; grey without a generator.
    """
    device = pictures.images.device
    if pictures.background is not None:
        return torch.tensor(pictures.background, device=device)
    if generator is None:
        return torch.full((3,), 0.5, device=device)
    return to_device_async(torch.rand(count, 3, generator=generator).numpy(), device)


def depth_likelihood(traced: Traced, distance: Tensor, voxel_size: float = 0.0) -> Tensor:
    """How much of each ray's weight lies where the surface truly is.

    Args:
        distance: (R,) true distances, 0 = unknown.
        voxel_size: what is nearer than half of it cannot be distinguished.

    Returns:
        (R,) natural logarithm of Σ_i w_i exp(−½ ((t_i − t*) / s)²) with s = max(`WIDTH` · t*, voxel_size / 2), not below log `FLOOR`;
        not a number where the distance is unknown.
    """
    known = distance > 0
    true = torch.where(known, distance, 1.0)[traced.ray]
    window = torch.exp(-0.5 * ((traced.distance - true) / (WIDTH * true).clamp_min(0.5 * voxel_size)).square())
    mass = ray_sum(traced.weight * window, traced.ray, len(distance))
    return torch.where(known, torch.log(mass.clamp(0, 1) + FLOOR), torch.nan)


@dataclass(frozen=True)
class LossParts:
    """The loss of one rendering and what it is made of."""

    total: Tensor
    colour: Tensor
    opacity: Tensor
    depth: Tensor


def rendering_loss(traced: Traced, rays: TargetRays, opacity_weight: float, depth_weight: float, voxel_size: float = 0.0) -> LossParts:
    """colour: mean squared error over rays and channels. opacity: mean of (1 − A)² over solid rays. depth: mean −log likelihood.

    `voxel_size`: see `depth_likelihood`.
    """
    colour = (traced.colour - rays.colour).square().mean()
    # Sums over what counts, divided by how many: choosing them would wait for the device.
    opacity = torch.where(rays.solid, (1 - traced.opacity).square(), 0.0).sum() / rays.solid.sum().clamp_min(1)
    depth = colour.new_zeros(())
    if depth_weight > 0:
        known = rays.distance > 0
        likelihood = depth_likelihood(traced, rays.distance, voxel_size)
        depth = -torch.where(known, likelihood, 0.0).sum() / known.sum().clamp_min(1)
    return LossParts(colour + opacity_weight * opacity + depth_weight * depth, colour, opacity, depth)


def annealed(start: float, step: int, steps: int) -> float:
    """A weight that falls from `start` to exactly zero over `steps` steps, first slowly, then faster (half a cosine)."""
    if steps <= 0 or step >= steps:
        return 0.0
    return float(start * 0.5 * (1 + torch.cos(torch.tensor(step / steps * torch.pi, dtype=torch.float64))))


# Health: a dead encoder, gates stuck at their ends, or a fog that explains every image equally well all train with a healthy-looking loss.


def decibels(error: Tensor) -> Tensor:
    """Mean squared error → PSNR, on its device."""
    return -10 * torch.log10(error.double().clamp_min(1e-10))


def feature_deviation(features: Tensor) -> Tensor:
    """(V, C, H, W) maps → mean over images and channels of the standard deviation over the image."""
    return features.detach().float().flatten(2).std(2).mean()


def relative_depth_error(distance: Tensor, truth: Tensor) -> Tensor:
    """Median of |d − d*| / d* where the truth is known and the ray is not empty; not a number when there is none."""
    known = (truth > 0) & (distance > 0)
    return torch.where(known, (distance - truth).abs() / truth, torch.nan).nanmedian()


@torch.no_grad()
def rendering_health(traced: Traced, rays: TargetRays) -> dict[str, Tensor]:
    """PSNR, shares of rays by opacity, log depth likelihood and depth error of one rendering, left on its device; the last two are not
    numbers where no depth is known."""
    low, high = (traced.opacity < 1 / 3).double().mean(), (traced.opacity > 2 / 3).double().mean()
    return {
        "psnr": decibels((traced.colour - rays.colour).square().mean()),
        "opacity_low": low,
        "opacity_middle": (1 - low - high).clamp_min(0),
        "opacity_high": high,
        "depth_likelihood": depth_likelihood(traced, rays.distance).nanmean(),
        "depth_error": relative_depth_error(traced.median_distance(), rays.distance),
    }
