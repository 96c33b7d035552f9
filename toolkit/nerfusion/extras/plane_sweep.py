"""A plane sweep along the pixels of a key view: where the surface is likely to be, read off at voxels.

A voxel is large against the step in depth that its views can tell apart, so that what they show at its corner alone says little about
surfaces between corners. The sweep asks at even steps of inverse depth of less than a pixel, and a voxel reads from it in closed form how
far in front of or behind the surface it lies on average, and how likely it is not hidden. The paper's networks have to find both in mean
and variance of features; these are known terms beside them, which the networks learn to correct.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion import compiled
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.matching import COLOUR_GAIN, LARGE, SMALL, TEMPERATURE, UNKNOWN, difference, smoothed_softmax, together
from fieldfuse.nerfusion.extras.pixel_motion import movement

SPACING = 2  # pixels of the compared pictures between those whose depth is asked for …
WITHIN = 1  # … and where silhouettes bound it: fine things then stand alone, and most pixels meet nothing
STEP = 0.75  # pixels that the view which moves most moves by from plane to plane
PLANES = (32, 192)  # fewest and most
RANGE = 50.0  # farthest by nearest depth, where the caller does not bound them
PEAK = 2  # planes on either side of the likeliest one that count as the same depth
NOISE = 0.01  # of a depth that a sensor measured, as a part of it; at least as wide as planes lie apart
TRUST = 0.98  # in a measured depth, against what the pictures say
WHOLE = (0.0, 0.0, 1.0, 1.0)
PART = 256  # pixels at a time, whose places then stay in a processor's cache
AT_ONCE = 16384  # pixels whose descriptors are looked up at once as tensors: 0.3 GB a view
LOST = 1e-4  # likelihood that is left where a silhouette takes the rest, below which nothing is known of where the surface is inside

Empty = Callable[[Tensor], Tensor]  # (N, 3) points of the working frame → (N,) bool, for sure nothing there


@dataclass(frozen=True)
class SdfEstimate:
    """What a sweep says of N voxels.

    Attributes:
        expected_sdf: (N,) in [−1, 1]: expected distance from the voxel to the surface behind it in units of the truncation, cut at
            ±1 before the mean is taken; positive in front of the surface.
        visibility: (N,) in [0, 1]: likelihood that nothing more than a truncation in front of the voxel hides it.
        confidence: (N,) in [0, 1]: how much of the pixel's likelihood lies about one depth.
    """

    expected_sdf: Tensor
    visibility: Tensor
    confidence: Tensor

    @property
    def stacked(self) -> Tensor:
        """(N, 3) all three."""
        return torch.stack([self.expected_sdf, self.visibility, self.confidence], 1)

    def __getitem__(self, kept: Tensor) -> SdfEstimate:
        """The voxels at `kept`."""
        return SdfEstimate(self.expected_sdf[kept], self.visibility[kept], self.confidence[kept])


@dataclass(frozen=True)
class DepthDistribution:
    """The likelihood of surface along the pixels of one camera.

    Attributes:
        camera: one.
        table: (3, D, h, w) over inverse depths, farthest first: the likelihood that the surface is nearer, its integral over inverse depth,
            and `sure`.
        lowest, step: inverse depth of the first entry, and between entries.
    """

    camera: Cameras
    table: Tensor
    lowest: float
    step: float

    def look(self, points: Tensor, truncation: Tensor) -> SdfEstimate:
        """Read at voxels (N, 3) of the working frame, with a truncation (N,) in working units each.

        Voxels outside the picture read its border.
        """
        if compiled.fits(points, truncation, self.table):
            pose, lens = self.camera.world_from_camera[0], self.camera.lens(0)
            return SdfEstimate(*compiled.look(points, truncation, self.table, pose, lens, self.lowest, self.step).T)
        if dispatch.can_use_triton(points, truncation, self.table):
            from fieldfuse.backends.triton import reading

            return SdfEstimate(*reading.look(points, truncation, self.table, self.camera, self.lowest, self.step))
        local = self.camera.local(points)[0]
        depth = local[:, 2].clamp_min(1e-6)
        focal, middle = self.camera.intrinsics[0, :2], self.camera.intrinsics[0, 2:]
        pixel = (local[:, :2] / depth[:, None] * focal + middle) / self.camera.size[0] * 2 - 1  # (N, 2) in [−1, 1] inside
        inverse = 1 / depth
        half = inverse * (truncation / depth).clamp_max(0.9)  # the truncation as a difference of inverse depths
        near, far = self._read(pixel, inverse + half), self._read(pixel, inverse - half)
        # E[clamp(x, −1, 1)] of x = (inverse − surface) / half, by parts, from the integral of the likelihood.
        signed = 1 - (near[1] - far[1]) / half
        return SdfEstimate(signed.clamp(-1, 1), (1 - near[0]).clamp(0, 1), near[2].clamp(0, 1))

    def _read(self, pixel: Tensor, inverse: Tensor) -> Tensor:
        """(3, N) entries; beyond the farthest plane everything is hidden, before the nearest nothing is."""
        count = self.table.shape[1]
        place = (inverse - self.lowest) / self.step
        w = (place + 0.5) / count * 2 - 1
        grid = torch.cat([pixel, w[:, None]], 1)[None, None, None]
        found = F.grid_sample(self.table[None], grid, padding_mode="border", align_corners=False)[0, :, 0, 0]
        beyond = (-place).clamp_min(0) * self.step  # of the integral, where the likelihood to be hidden is one
        return torch.stack([found[0], found[1] - beyond, found[2]])


@dataclass(frozen=True)
class CostVolume:
    """How badly the pictures of a key view and its neighbours fit at planes, before anything is decided.

    Attributes:
        camera: one, of the window alone.
        rays: (h · w, 3) of the working frame, through pixels of the key view, of unit depth along its axis.
        inverses: (D,) inverse depths of the planes, evenly spaced, ascending.
        lowest, step: the first of them, and from one to the next.
        cost: (D, h, w) in [0, 1].
        empty: (D, h, w) bool, where silhouettes say that there is nothing; None without any.
        window: left, upper, right and lower edge in the key view's whole picture, 0 to 1. Beyond it nothing is but what is `empty`.
        spacing: pixels of the compared pictures from one to the next here.
    """

    camera: Cameras
    rays: Tensor
    inverses: Tensor
    lowest: float
    step: float
    cost: Tensor
    empty: Tensor | None = None
    window: tuple[float, float, float, float] = WHOLE
    spacing: int = SPACING


@torch.no_grad()
def cost_volume(descriptors: Sequence[Tensor], cameras: Cameras, near: float, far: float, empty: Empty | None = None) -> CostVolume:
    """Compare the first view with all others at planes between `near` and `far` along its axis; the others may come in any order.

    Args:
        described: K times (21, h, w) of `matching.patch_descriptors`.
        cameras: K.
        near, far: 0 and ∞ where unknown.
        empty: where there is for sure no surface, as silhouettes tell; pixels that meet nothing else are not compared.

    Raises:
        ValueError: neither is known, or the nearest does not lie before the farthest.
    """
    with torch.autocast(cameras.intrinsics.device.type, enabled=False):  # planes lie less than a pixel apart
        return _compared(descriptors, cameras, *_bounded(near, far), empty)


def _compared(descriptors: Sequence[Tensor], cameras: Cameras, near: float, far: float, empty: Empty | None) -> CostVolume:
    """`cost_volume`, with both ends known."""
    count = _planes([view.shape[2] for view in descriptors], cameras.to("cpu"), near, far)
    ladder = torch.linspace(1 / far, 1 / near, count)
    first, second = ladder.numpy()[:2]  # without asking the device
    lowest, step = float(first), float(second - first)
    spacing = SPACING if empty is None else WITHIN
    shape = _shape(descriptors[0], spacing)
    if dispatch.can_use_triton(cameras.intrinsics, *descriptors):
        from fieldfuse.backends.triton.describe import pixels

        world, own, inverses = pixels(descriptors[0], cameras, shape, count, 1 / far, 1 / near)
        rays = world  # the kernel takes them in working axes
    else:
        inverses = ladder.to(cameras.intrinsics.device, non_blocking=True)
        rays, own = _pixels(descriptors[0], cameras, shape)
        world = rays @ cameras.world_from_camera[0, :3, :3].T
    if empty is None:
        return CostVolume(cameras[0], world, inverses, lowest, step, _volume(_costs(descriptors, cameras, inverses, rays, own), shape))
    depths, origin = (1 / inverses)[:, None], cameras.positions[0]
    few = PART if world.device.type == "cpu" else AT_ONCE
    nothing = torch.cat([empty(torch.addcmul(origin, part[:, None], depths).view(-1, 3)) for part in world.split(few)]).view(*shape, -1)
    camera, window, rows, columns = _cropped(cameras[0], ~nothing.all(2))
    nothing, rays, own, world = (
        values.view(*shape, -1)[rows, columns].reshape(-1, values.shape[-1]) for values in (nothing, rays, own, world)
    )
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    some = (~nothing).any(1).nonzero().view(-1)
    cost = rays.new_full(nothing.shape, UNKNOWN).index_copy(0, some, _costs(descriptors, cameras, inverses, rays[some], own[some]))
    return CostVolume(camera, world, inverses, lowest, step, _volume(cost, shape), _volume(nothing, shape), window, spacing)


def _cropped(camera: Cameras, wanted: Tensor) -> tuple[Cameras, tuple[float, float, float, float], slice, slice]:
    """The part of the picture about the `wanted` (h, w) cells with one more on each side, which says that there is nothing beyond: its
    camera, its window, and its rows and columns of cells."""
    (upper, lower), (left, right) = (_span(wanted.any(1)), _span(wanted.any(0)))
    height, width = wanted.shape
    cell = camera.size[0] / camera.size.new_tensor([width, height])
    first, count = (camera.size.new_tensor(pair) for pair in ([left, upper], [right - left, lower - upper]))
    intrinsics = torch.cat([camera.intrinsics[:, :2], camera.intrinsics[:, 2:] - first * cell], 1)
    window = (left / width, upper / height, right / width, lower / height)
    return Cameras(intrinsics, (count * cell)[None], camera.world_from_camera), window, slice(upper, lower), slice(left, right)


def _span(wanted: Tensor) -> tuple[int, int]:
    """From the first to behind the last that is `wanted` (N,), and one more on each side where there is one; never nothing."""
    found = wanted.nonzero().view(-1)
    return (0, 1) if len(found) == 0 else (max(0, int(found[0]) - 1), min(len(wanted), int(found[-1]) + 2))


def _costs(descriptors: Sequence[Tensor], cameras: Cameras, inverses: Tensor, rays: Tensor, own: Tensor) -> Tensor:
    """(P, D) of pixels of the first view, with rays (P, 3) in its axes, on CUDA in working axes, and descriptors (P, 21)."""
    if len(cameras) == 1:
        return rays.new_zeros((len(rays), len(inverses)))
    if compiled.fits(rays, *descriptors):
        comparison = compiled.Comparison(own, rays, inverses, COLOUR_GAIN)
        for view in range(1, len(cameras)):
            comparison.add(descriptors[view], *_way(cameras, view), cameras.lens(view))
        return comparison.result(UNKNOWN)
    if dispatch.can_use_triton(cameras.intrinsics, *descriptors):
        from fieldfuse.backends.triton import matching

        return matching.costs(descriptors, cameras, inverses, rays, own, COLOUR_GAIN, UNKNOWN)
    parts = []
    for ray, mine in zip(rays.split(AT_ONCE), own.split(AT_ONCE), strict=True):
        found = [_warped(descriptors[view], cameras, view, ray, inverses) for view in range(1, len(cameras))]
        costs = torch.stack([difference(mine[None], shown) for shown, _ in found])
        parts.append(together(costs, torch.stack([seen for _, seen in found])).T)
    return torch.cat(parts) if parts else rays.new_zeros((0, len(inverses)))


def _volume(values: Tensor, shape: tuple[int, int]) -> Tensor:
    """(h · w, D) → (D, h, w)."""
    return values.reshape(*shape, -1).permute(2, 0, 1)


@torch.no_grad()
def to_probability(costs: CostVolume, depth: Tensor | None = None, correction: Tensor | None = None) -> DepthDistribution:
    """Where the surface is likely to be.

    Args:
        depth: (H, W) of the key view along z in working units, where a sensor measured it; 0 or not finite where it did not.
        said: (D, h, w) that makes planes likelier, in units of the cost (`cross_view_consistency.consistency`).
    """
    if costs.empty is None and depth is None and dispatch.can_use_triton(costs.cost):
        from fieldfuse.backends.triton import matching

        table = matching.decided(costs.cost, correction, SMALL, LARGE, TEMPERATURE, costs.step, PEAK)
        return DepthDistribution(costs.camera, table, costs.lowest, costs.step)
    likely = smoothed_softmax(costs.cost if correction is None else costs.cost - correction)
    if costs.empty is not None:
        likely = carved(likely, costs.empty)
    if depth is not None and dispatch.can_use_triton(likely, costs.inverses, depth):
        from fieldfuse.backends.triton.measured import measured as table_of

        asked = _asked(likely, depth, costs.spacing, costs.window)
        table = table_of(likely, costs.inverses, depth, *asked, costs.step, NOISE, TRUST, PEAK)
        return DepthDistribution(costs.camera, table, costs.lowest, costs.step)
    if depth is not None:
        likely = measured(likely, costs.inverses, depth, costs.spacing, costs.window)
    return DepthDistribution(costs.camera, _table(likely, costs.step), costs.lowest, costs.step)


def sweep_planes(
    descriptors: Sequence[Tensor],
    cameras: Cameras,
    near: float,
    far: float,
    depth: Tensor | None = None,
    empty: Empty | None = None,
) -> DepthDistribution:
    """`cost_volume` and `to_probability` for a key view alone."""
    return to_probability(cost_volume(descriptors, cameras, near, far, empty), depth)


def carved(likely: Tensor, empty: Tensor) -> Tensor:
    """What the pictures say of planes (D, h, w), farthest first, within silhouettes: no surface where it is `empty` (D, h, w).

    Of pixels whose likely planes are all empty any other one is as likely; along those that meet nothing it is free to the farthest.
    """
    if compiled.fits(likely):
        return compiled.carved(likely, empty, LOST)
    left = likely * ~empty
    total = left.sum(0)
    anywhere = (~empty).to(likely.dtype)
    left = torch.where(total > LOST, left / total.clamp_min(LOST), anywhere / anywhere.sum(0).clamp_min(1))
    free = torch.zeros_like(left)
    free[0] = 1
    return torch.where(empty.all(0), free, left)


def measured(
    likely: Tensor, inverses: Tensor, depth: Tensor, spacing: int = SPACING, window: tuple[float, float, float, float] = WHOLE
) -> Tensor:
    """What the pictures say, and where a sensor measured the depth, that.

    Args:
        likely: (D, h, w) likelihoods of the planes.
        inverses: (D,) of the planes, evenly spaced, ascending.
        depth: (H, W), 0 or not finite where nothing was measured; beyond the planes it counts as the last of them.
        spacing, window: of `CostVolume`; the depth is of the whole picture.

    Returns:
        (D, h', w') at all pixels of the compared pictures: a depth sensor tells edges better than patches do.
    """
    shape, spans = _asked(likely, depth, spacing, window)
    # Depth is picked and not averaged: between two surfaces there is nothing.
    rows, columns = (
        (first + (torch.arange(n, device=depth.device) + 0.5) * (length / n)).long()
        for n, (first, length) in zip(shape, spans, strict=True)
    )
    here = depth[rows[:, None], columns]
    known = torch.isfinite(here) & (here > 0)
    inverse = (1 / torch.where(known, here, torch.ones_like(here))).clamp(float(inverses[0]), float(inverses[-1]))
    width = (NOISE * inverse).clamp_min(0.7 * float(inverses[1] - inverses[0]))
    near = torch.softmax(-0.5 * ((inverses[:, None, None] - inverse) / width).square(), 0)
    told = F.interpolate(likely[None], shape, mode="bilinear", align_corners=False)[0]
    return torch.where(known, TRUST * near + (1 - TRUST) * told, told)


def _asked(
    likely: Tensor, depth: Tensor, spacing: int, window: tuple[float, float, float, float]
) -> tuple[list[int], list[tuple[float, float]]]:
    """Rows and columns of what `measured` gives, and where in the depth they begin and how many pixels of it they cover."""
    left, upper, right, lower = window
    spans = [(low * most, (high - low) * most) for low, high, most in ((upper, lower, depth.shape[0]), (left, right, depth.shape[1]))]
    return [max(1, min(spacing * side, round(length))) for side, (_, length) in zip(likely.shape[1:], spans, strict=True)], spans


def _table(likely: Tensor, step: float) -> Tensor:
    """(D, h, w) likelihoods, farthest first → what `DepthDistribution` keeps."""
    if compiled.fits(likely):
        return compiled.table(likely, step, PEAK)
    if dispatch.can_use_triton(likely):
        from fieldfuse.backends.triton import matching

        return matching.table(likely, step, PEAK)
    nearer = likely.flip(0).cumsum(0).flip(0) - 0.5 * likely  # the surface lies anywhere about its plane
    middle = 0.5 * (nearer[1:] + nearer[:-1]) * step
    integral = torch.cat([torch.zeros_like(nearer[:1]), middle.cumsum(0)])
    width = min(2 * PEAK + 1, len(likely))
    peaks = F.avg_pool1d(likely.permute(1, 2, 0).flatten(0, 1)[:, None], width, 1) * width
    sure = peaks.amax((1, 2)).view(1, *likely.shape[1:]).expand_as(likely)
    # A voxel's three numbers lie next to each other in memory.
    return torch.stack([part.permute(1, 2, 0) for part in (nearer, integral, sure)], -1).permute(3, 2, 0, 1)


def _bounded(near: float, far: float) -> tuple[float, float]:
    """A range of depths with both ends."""
    if not (near > 0 or math.isfinite(far)):
        raise ValueError("a sweep needs a nearest or a farthest depth")
    near, far = (near if near > 0 else far / RANGE), (far if math.isfinite(far) else RANGE * near)
    if not near < far:
        raise ValueError(f"a sweep from {near:g} to {far:g} looks at nothing; the nearest depth must lie before the farthest")
    return near, far


def _shape(descriptors: Tensor, spacing: int) -> tuple[int, int]:
    """Rows and columns of every `spacing`-th pixel."""
    height, width = descriptors.shape[1:]
    return max(1, height // spacing), max(1, width // spacing)


def _pixels(descriptors: Tensor, cameras: Cameras, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Rays (P, 3) of unit depth through a grid of pixels of the first view, in its axes, and their descriptors (P, 21)."""
    # Cells of equal size cover the picture, so that reading the table needs its borders alone.
    v = (torch.arange(shape[0], device=descriptors.device) + 0.5) / shape[0] * 2 - 1
    u = (torch.arange(shape[1], device=descriptors.device) + 0.5) / shape[1] * 2 - 1
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)  # (h, w, 2)
    own = F.grid_sample(descriptors[None], grid[None], padding_mode="border", align_corners=False)[0].flatten(1).T
    focal, middle = cameras.intrinsics[0, :2], cameras.intrinsics[0, 2:]
    flat = ((grid.view(-1, 2) + 1) / 2 * cameras.size[0] - middle) / focal
    return torch.cat([flat, torch.ones_like(flat[:, :1])], 1), own


def _way(cameras: Cameras, view: int) -> tuple[Tensor, Tensor]:
    """(3, 3) whose rows are the axes of the first camera in those of `view`, and (3,) where the first camera is there."""
    axes = cameras.world_from_camera[view, :3, :3]
    return cameras.world_from_camera[0, :3, :3].T @ axes, (cameras.positions[0] - cameras.positions[view]) @ axes


def _warped(descriptors: Tensor, cameras: Cameras, view: int, rays: Tensor, inverses: Tensor) -> tuple[Tensor, Tensor]:
    """(D, P, 21) what a view shows of each pixel of the first at each plane, and (D, P) bool whether it sees it."""
    turn, shift = _way(cameras, view)
    local = (rays @ turn)[None] + inverses[:, None, None] * shift  # of the point divided by its depth: no far plane is too far
    deep = local[..., 2] > 1e-4
    depth = torch.where(deep, local[..., 2], torch.ones_like(local[..., 2]))
    pixel = local[..., :2] / depth[..., None] * cameras.intrinsics[view, :2] + cameras.intrinsics[view, 2:]
    grid = pixel / cameras.size[view] * 2 - 1
    visible = deep & (grid.abs() <= 1).all(-1)
    found = F.grid_sample(descriptors[None], grid.clamp(-2, 2)[None], padding_mode="border", align_corners=False)[0]
    return found.permute(1, 2, 0), visible


def _planes(widths: Sequence[int], cameras: Cameras, near: float, far: float) -> int:
    """How many planes: pictures of the view that moves most (`movement`) move by `STEP` from one to the next."""
    return int(min(max(math.ceil(movement(widths, cameras, near, far) / STEP) + 1, PLANES[0]), PLANES[1]))
