"""A plane sweep along the pixels of a key view: where the surface is likely to be, read off at voxels (not in the paper).

A voxel is large against the step in depth that its views can tell apart, so that what they show at its corner alone says little about
surfaces between corners. The sweep compares at even steps of inverse depth of less than a pixel, and a voxel reads from it in closed form
how far in front of or behind the surface it lies on average, and how likely it is visible. The paper's networks have to find both in mean
and variance of features; these are known terms beside them, which the networks learn to correct.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.matching import COLOUR_GAIN, LARGE, SMALL, TEMPERATURE, UNKNOWN, difference, smoothed_softmax, together

SPACING = 2  # pixels of the compared images between those with a depth …
WITHIN = 1  # … and where silhouettes bound it: fine things then stand alone, and most pixels meet nothing
STEP = 0.75  # pixels that the view which moves most moves by from plane to plane
PLANES = (32, 192)  # fewest and most
SPOTS = np.array([[u, v, 1.0] for u in (0.1, 0.5, 0.9) for v in (0.1, 0.5, 0.9)], np.float32)  # of the first image, where it is measured
FRONT = 0.05  # of the unit of depth that a place has to lie before a view to count there
RANGE = 50.0  # farthest by nearest depth, where the caller does not bound them
PEAK = 2  # planes on either side of the likeliest one that count as the same depth
NOISE = 0.01  # of a depth that a sensor measured, as a part of it; at least as wide as planes lie apart
TRUST = 0.98  # in a measured depth, against what the images show
WHOLE = (0.0, 0.0, 1.0, 1.0)
PART = 256  # pixels at a time, whose places then stay in a processor's cache
AT_ONCE = 16384  # pixels whose descriptors are looked up at once as tensors: 0.3 GB a view
LOST = 1e-4  # likelihood that is left where a silhouette takes the rest, below which nothing is known of where the surface is inside

Empty = Callable[[Tensor], Tensor]  # (N, 3) points of the working frame → (N,) bool, for sure nothing there


@dataclass(frozen=True)
class SdfEstimate:
    """The surface about N voxels, as a sweep sees it."""

    # In [−1, 1]: expected distance from the voxel to the surface behind it in units of the truncation, cut at ±1 before the mean is taken;
    # positive in front of the surface.
    expected_sdf: Tensor
    visibility: Tensor  # in [0, 1]: likelihood that nothing more than a truncation in front of the voxel hides it
    confidence: Tensor  # in [0, 1]: how much of the pixel's likelihood lies about one depth

    @property
    def stacked(self) -> Tensor:
        """(N, 3) all three."""
        return torch.stack([self.expected_sdf, self.visibility, self.confidence], 1)

    def __getitem__(self, kept: Tensor) -> SdfEstimate:
        """The voxels at `kept`."""
        return SdfEstimate(self.expected_sdf[kept], self.visibility[kept], self.confidence[kept])


@dataclass(frozen=True)
class DepthDistribution:
    """The likelihood of surface along the pixels of one camera, over inverse depths `lowest`, `lowest` + `step`, …"""

    camera: Cameras
    table: Tensor  # (3, D, h, w), farthest first: likelihood that the surface is nearer, its integral over inverse depth, confidence
    lowest: float
    step: float

    def look(self, points: Tensor, truncation: Tensor) -> SdfEstimate:
        """Read at voxels (N, 3) of the working frame, with a truncation (N,) in working units each.

        Voxels outside the image read its border.
        """
        if kernels := dispatch.kernels("depth_reading", points, truncation, self.table):
            return SdfEstimate(*kernels.look(points, truncation, self.table, self.camera, self.lowest, self.step))
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
        place = (inverse - self.lowest) / self.step
        w = (place + 0.5) / self.table.shape[1] * 2 - 1
        grid = torch.cat([pixel, w[:, None]], 1)[None, None, None]
        found = F.grid_sample(self.table[None], grid, padding_mode="border", align_corners=False)[0, :, 0, 0]
        beyond = (-place).clamp_min(0) * self.step  # of the integral, where the likelihood to be hidden is one
        return torch.stack([found[0], found[1] - beyond, found[2]])


@dataclass(frozen=True)
class CostVolume:
    """How badly the images of a key view and its neighbours fit at planes."""

    camera: Cameras  # one, of the window alone
    rays: Tensor  # (h · w, 3) of the working frame, through pixels of the key view, of unit depth along its axis
    inverses: Tensor  # (D,) inverse depths of the planes, ascending: `lowest`, `lowest` + `step`, …
    lowest: float
    step: float
    cost: Tensor  # (D, h, w) in [0, 1]
    empty: Tensor | None = None  # (D, h, w) bool, for sure nothing there, by silhouettes; None without any
    window: tuple[float, float, float, float] = WHOLE  # left, upper, right and lower edge in the key view, 0 to 1; beyond it all is `empty`
    spacing: int = SPACING  # pixels of the compared images from one to the next here


@torch.no_grad()
def cost_volume(descriptors: Sequence[Tensor], cameras: Cameras, near: float, far: float, empty: Empty | None = None) -> CostVolume:
    """Compare the first view with all others at planes between `near` and `far` along its axis; the others may come in any order.

    Args:
        descriptors: K times (21, h, w) of `matching.patch_descriptors`; cameras: K.
        near, far: 0 and ∞ where unknown.
        empty: where there is for sure no surface, by silhouettes; pixels that meet nothing else are not compared.

    Raises:
        ValueError: neither is known, or the nearest does not lie before the farthest.
    """
    if not (near > 0 or math.isfinite(far)):
        raise ValueError("a sweep needs a nearest or a farthest depth")
    near, far = (near if near > 0 else far / RANGE), (far if math.isfinite(far) else RANGE * near)
    if not near < far:
        raise ValueError(f"a sweep from {near:g} to {far:g} looks at nothing; the nearest depth must lie before the farthest")
    with torch.autocast(cameras.intrinsics.device.type, enabled=False):  # planes lie less than a pixel apart
        return _cost_volume(descriptors, cameras, near, far, empty)


def _cost_volume(descriptors: Sequence[Tensor], cameras: Cameras, near: float, far: float, empty: Empty | None) -> CostVolume:
    moved = movement([view.shape[2] for view in descriptors], cameras.to("cpu"), near, far)
    count = int(min(max(math.ceil(moved / STEP) + 1, PLANES[0]), PLANES[1]))
    ladder = torch.linspace(1 / far, 1 / near, count)
    first, second = ladder.numpy()[:2]  # without a wait for the device
    lowest, step = float(first), float(second - first)
    spacing = SPACING if empty is None else WITHIN
    shape = max(1, descriptors[0].shape[1] // spacing), max(1, descriptors[0].shape[2] // spacing)
    if dispatch.can_use_triton(cameras.intrinsics, *descriptors):
        from fieldfuse.backends.triton import plane_sweep

        rays, own, inverses = plane_sweep.pixels(descriptors[0], cameras, shape, count, 1 / far, 1 / near)
    else:
        inverses = ladder.to(cameras.intrinsics.device, non_blocking=True)
        rays, own = _pixels(descriptors[0], cameras, shape)
    if empty is None:
        return CostVolume(cameras[0], rays, inverses, lowest, step, _volume(_costs(descriptors, cameras, inverses, rays, own), shape))
    depths, origin = (1 / inverses)[:, None], cameras.positions[0]
    few = PART if dispatch.is_cpu(rays.device) else AT_ONCE
    nothing = torch.cat([empty(torch.addcmul(origin, part[:, None], depths).view(-1, 3)) for part in rays.split(few)]).view(*shape, -1)
    camera, window, rows, columns = _cropped(cameras[0], ~nothing.all(2))
    nothing, rays, own = (values.view(*shape, -1)[rows, columns].reshape(-1, values.shape[-1]) for values in (nothing, rays, own))
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    some = (~nothing).any(1).nonzero().view(-1)
    cost = rays.new_full(nothing.shape, UNKNOWN).index_copy(0, some, _costs(descriptors, cameras, inverses, rays[some], own[some]))
    return CostVolume(camera, rays, inverses, lowest, step, _volume(cost, shape), _volume(nothing, shape), window, spacing)


def movement(widths: Sequence[int], cameras: Cameras, near: float, far: float) -> float:
    """Pixels by which what lies along rays of the first view moves from `near` to `far` in the view where it moves most.

    Each view's is the median of nine rays, of those whose ends both lie in front of it; 0 where none does.

    Args:
        widths: K, of the images that are compared.
        cameras: K, on the CPU.
    """
    lenses, sizes, poses = (values.numpy() for values in (cameras.intrinsics, cameras.size, cameras.world_from_camera))
    rays = SPOTS.copy()
    rays[:, :2] = (SPOTS[:, :2] * sizes[0] - lenses[0, 2:]) / lenses[0, :2]
    axes = poses[1:, :3, :3]
    turned = rays @ (poses[0, :3, :3].T @ axes)  # (K − 1, 9, 3)
    shift = (poses[0, :3, 3] - poses[1:, :3, 3])[:, None] @ axes
    ends = np.stack([turned + shift / np.float32(depth) for depth in (near, far)])
    front = (ends[..., 2] > FRONT).all(0)
    places = ends[..., :2] / np.where(front, ends[..., 2], np.float32(1))[..., None] * lenses[1:, None, :2]
    moved = np.sort(np.where(front, np.sqrt(np.square(places[0] - places[1]).sum(-1)), np.inf), 1).tolist()
    found = zip(moved, front.sum(1).tolist(), widths[1:], sizes[1:, 0].tolist(), strict=True)
    return max((row[(count - 1) // 2] * width / size for row, count, width, size in found if count), default=0.0)


def _pixels(descriptors: Tensor, cameras: Cameras, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Rays (P, 3) of unit depth through a grid of pixels of the first view, in working axes, and their descriptors (P, 21)."""
    # Cells of equal size cover the image, so that reading the table needs its borders alone.
    v = (torch.arange(shape[0], device=descriptors.device) + 0.5) / shape[0] * 2 - 1
    u = (torch.arange(shape[1], device=descriptors.device) + 0.5) / shape[1] * 2 - 1
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)  # (h, w, 2)
    own = F.grid_sample(descriptors[None], grid[None], padding_mode="border", align_corners=False)[0].flatten(1).T
    focal, middle = cameras.intrinsics[0, :2], cameras.intrinsics[0, 2:]
    flat = ((grid.view(-1, 2) + 1) / 2 * cameras.size[0] - middle) / focal
    return F.pad(flat, (0, 1), value=1.0) @ cameras.world_from_camera[0, :3, :3].T, own


def _cropped(camera: Cameras, wanted: Tensor) -> tuple[Cameras, tuple[float, float, float, float], slice, slice]:
    """The part of the image about the `wanted` (h, w) cells with one more on each side, which shows that there is nothing beyond: its
    camera, its window, and its rows and columns of cells; never nothing."""
    spans = []
    for line in (wanted.any(1), wanted.any(0)):
        found = line.nonzero().view(-1)
        spans.append((0, 1) if len(found) == 0 else (max(0, int(found[0]) - 1), min(len(line), int(found[-1]) + 2)))
    (upper, lower), (left, right) = spans
    height, width = wanted.shape
    cell = camera.size[0] / camera.size.new_tensor([width, height])
    first, count = (camera.size.new_tensor(pair) for pair in ([left, upper], [right - left, lower - upper]))
    intrinsics = torch.cat([camera.intrinsics[:, :2], camera.intrinsics[:, 2:] - first * cell], 1)
    window = (left / width, upper / height, right / width, lower / height)
    return Cameras(intrinsics, (count * cell)[None], camera.world_from_camera), window, slice(upper, lower), slice(left, right)


def _costs(descriptors: Sequence[Tensor], cameras: Cameras, inverses: Tensor, rays: Tensor, own: Tensor) -> Tensor:
    """(P, D) of pixels of the first view, with rays (P, 3) in working axes and descriptors (P, 21)."""
    if len(cameras) == 1:
        return rays.new_zeros((len(rays), len(inverses)))
    if kernels := dispatch.kernels("plane_sweep", rays, cameras.intrinsics, *descriptors):
        return kernels.costs(descriptors, cameras, inverses, rays, own, COLOUR_GAIN, UNKNOWN)
    parts = [rays.new_zeros((0, len(inverses)))]
    for ray, mine in zip(rays.split(AT_ONCE), own.split(AT_ONCE), strict=True):
        found = [_warped(descriptors[view], cameras, view, ray, inverses) for view in range(1, len(cameras))]
        costs = torch.stack([difference(mine[None], shown) for shown, _ in found])
        parts.append(together(costs, torch.stack([seen for _, seen in found])).T)
    return torch.cat(parts)


def _warped(descriptors: Tensor, cameras: Cameras, view: int, rays: Tensor, inverses: Tensor) -> tuple[Tensor, Tensor]:
    """(D, P, 21) what a view shows of each pixel of the first at each plane, and (D, P) bool whether it sees it."""
    axes = cameras.world_from_camera[view, :3, :3]
    shift = (cameras.positions[0] - cameras.positions[view]) @ axes
    local = (rays @ axes)[None] + inverses[:, None, None] * shift  # of the point divided by its depth: no far plane is too far
    deep = local[..., 2] > 1e-4
    depth = torch.where(deep, local[..., 2], torch.ones_like(local[..., 2]))
    pixel = local[..., :2] / depth[..., None] * cameras.intrinsics[view, :2] + cameras.intrinsics[view, 2:]
    grid = pixel / cameras.size[view] * 2 - 1
    visible = deep & (grid.abs() <= 1).all(-1)
    found = F.grid_sample(descriptors[None], grid.clamp(-2, 2)[None], padding_mode="border", align_corners=False)[0]
    return found.permute(1, 2, 0), visible


def _volume(values: Tensor, shape: tuple[int, int]) -> Tensor:
    """(h · w, D) → (D, h, w)."""
    return values.reshape(*shape, -1).permute(2, 0, 1)


@torch.no_grad()
def to_probability(costs: CostVolume, depth: Tensor | None = None, correction: Tensor | None = None) -> DepthDistribution:
    """Where the surface is likely to be.

    Args:
        depth: (H, W) of the key view along z in working units, where a sensor measured it; 0 or not finite where it did not.
        correction: (D, h, w) that makes planes likelier, in units of the cost (`cross_view_consistency.consistency`).
    """
    if costs.empty is None and depth is None and dispatch.can_use_triton(costs.cost):
        from fieldfuse.backends.triton import plane_sweep

        table = plane_sweep.table_of_costs(costs.cost, correction, (SMALL, LARGE, TEMPERATURE), costs.step, PEAK)
        return DepthDistribution(costs.camera, table, costs.lowest, costs.step)
    likely = smoothed_softmax(costs.cost if correction is None else costs.cost - correction)
    if costs.empty is not None:
        likely = carved(likely, costs.empty)
    if depth is None:
        return DepthDistribution(costs.camera, _table(likely, costs.step), costs.lowest, costs.step)
    # Rows and columns with a depth, and where in the sensor's image they begin and how many pixels of it they cover.
    left, upper, right, lower = costs.window
    spans = [(low * most, (high - low) * most) for low, high, most in ((upper, lower, depth.shape[0]), (left, right, depth.shape[1]))]
    shape = [max(1, min(costs.spacing * side, round(length))) for side, (_, length) in zip(likely.shape[1:], spans, strict=True)]
    if dispatch.can_use_triton(likely, costs.inverses, depth):
        from fieldfuse.backends.triton import depth_reading

        table = depth_reading.table_with_depth(likely, costs.inverses, depth, (shape, spans), (costs.step, NOISE, TRUST), PEAK)
    else:
        table = _table(measured(likely, costs.inverses, depth, shape, spans), costs.step)
    return DepthDistribution(costs.camera, table, costs.lowest, costs.step)


def sweep_planes(
    descriptors: Sequence[Tensor], cameras: Cameras, near: float, far: float, depth: Tensor | None = None, empty: Empty | None = None
) -> DepthDistribution:
    """`cost_volume` and `to_probability` for a key view alone."""
    return to_probability(cost_volume(descriptors, cameras, near, far, empty), depth)


def carved(likely: Tensor, empty: Tensor) -> Tensor:
    """Likelihoods of planes (D, h, w), farthest first, within silhouettes: no surface where it is `empty` (D, h, w).

    Of pixels whose likely planes are all empty any other one is as likely; along those that meet nothing it is free to the farthest.
    """
    if dispatch.can_use_numba(likely):
        from fieldfuse.backends.numba import plane_sweep

        return plane_sweep.carved(likely, empty, LOST)
    left = likely * ~empty
    total = left.sum(0)
    anywhere = (~empty).to(likely.dtype)
    left = torch.where(total > LOST, left / total.clamp_min(LOST), anywhere / anywhere.sum(0).clamp_min(1))
    free = torch.zeros_like(left)
    free[0] = 1
    return torch.where(empty.all(0), free, left)


def measured(likely: Tensor, inverses: Tensor, depth: Tensor, shape: Sequence[int], spans: Sequence[tuple[float, float]]) -> Tensor:
    """Likelihoods by the images and, where a sensor measured the depth, by that.

    Args:
        likely: (D, h, w) of planes at `inverses` (D,), evenly spaced, ascending.
        depth: (H, W), 0 or not finite where nothing was measured; beyond the planes it counts as the last of them.
        shape: h' and w'.
        spans: from which row of the depth on, and how many of them, are read; and the same of columns.

    Returns:
        (D, h', w'), which are all pixels of the compared images: a depth sensor tells edges better than patches do.
    """
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
    shown = F.interpolate(likely[None], list(shape), mode="bilinear", align_corners=False)[0]
    return torch.where(known, TRUST * near + (1 - TRUST) * shown, shown)


def _table(likely: Tensor, step: float) -> Tensor:
    """(D, h, w) likelihoods, farthest first → the table of a `DepthDistribution`."""
    if kernels := dispatch.kernels("plane_sweep", likely):
        return kernels.table(likely, step, PEAK)
    nearer = likely.flip(0).cumsum(0).flip(0) - 0.5 * likely  # the surface lies anywhere about its plane
    middle = 0.5 * (nearer[1:] + nearer[:-1]) * step
    integral = torch.cat([torch.zeros_like(nearer[:1]), middle.cumsum(0)])
    width = min(2 * PEAK + 1, len(likely))
    peaks = F.avg_pool1d(likely.permute(1, 2, 0).flatten(0, 1)[:, None], width, 1) * width
    sure = peaks.amax((1, 2)).view(1, *likely.shape[1:]).expand_as(likely)
    # A voxel's three numbers lie next to each other in memory.
    return torch.stack([part.permute(1, 2, 0) for part in (nearer, integral, sure)], -1).permute(3, 2, 0, 1)
