"""Cross-view consistency of key frames' depth: where one has surface, others must not see through (not in the paper; `network.agreement`).

Three views are led astray where they show no texture or repeat, but not all key frames are in the same way. For another key frame a point
along a pixel is surface, free space, or hidden behind something, each with a likelihood from its own depth distribution. Surface speaks for
the plane, free space against it, hidden for neither. The mean log odds of the other key frames go into the cost volume before it is
smoothed, so that they spread over a surface as the images' costs do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.matching import LARGE, SMALL, TEMPERATURE
from fieldfuse.nerfusion.extras.plane_sweep import PEAK, CostVolume, DepthDistribution, to_probability

FOR = 4.0  # odds of surface where another key frame is sure of surface, against 1 where the point is hidden from it
AGAINST = 0.1  # odds where it is sure of free space: it may err
SHARE = 0.3  # of the mean log odds that is subtracted from the cost
ABOUT = 2  # planes on either side within which surface counts, the last of them by half
SURE = 0.7  # of the likelihood within some planes about one depth
BELIEVED = 1.0  # mean log odds from which on another key frame counts in full; they are 1.4 at most
SPACING = 2  # of the pixels that are checked


@dataclass(frozen=True)
class CrossView:
    """Evidence of one key frame for and against surface, over inverse depths `lowest`, `lowest` + `step`, …"""

    camera: Cameras  # one
    log_odds: Tensor  # (D, h, w), farthest first: logarithm of how much likelier surface is than without this key frame
    lowest: float
    step: float
    _numbers: list[Tensor] = field(default_factory=list, init=False, compare=False, repr=False)

    def numbers(self) -> Tensor:
        """(23,) that kernels for CUDA read it by (`backends/triton/depth_reading.py`), put together once."""
        if not self._numbers:
            from fieldfuse.backends.triton import depth_reading

            self._numbers.append(depth_reading.numbers(self.camera, self.log_odds, self.lowest, self.step))
        return self._numbers[0]

    def log_odds_at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) points of the working frame → (N,) log odds, 0 outside of the image, and (N,) bool, inside of it."""
        if dispatch.can_use_numba(points, self.log_odds):
            from fieldfuse.backends.numba import depth_reading

            return depth_reading.log_odds_at(points, self)
        local = self.camera.local(points)[0]
        seen = local[:, 2] > 1e-4
        inverse = 1 / torch.where(seen, local[:, 2], torch.ones_like(local[:, 2]))
        focal, middle = self.camera.intrinsics[0, :2], self.camera.intrinsics[0, 2:]
        pixel = (local[:, :2] * inverse[:, None] * focal + middle) / self.camera.size[0] * 2 - 1
        seen &= (pixel.abs() <= 1).all(1)
        plane = ((inverse - self.lowest) / self.step + 0.5) / len(self.log_odds) * 2 - 1
        grid = torch.cat([pixel, plane[:, None]], 1).clamp(-2, 2)[None, None, None]
        found = F.grid_sample(self.log_odds[None, None], grid, padding_mode="border", align_corners=False)[0, 0, 0, 0]
        return torch.where(seen, found, torch.zeros_like(found)), seen


def cross_view(distribution: DepthDistribution) -> CrossView:
    """A key frame's evidence for others, from its depth distribution."""
    if dispatch.can_use_triton(distribution.table):
        from fieldfuse.backends.triton import depth_reading

        log_odds = depth_reading.log_odds(distribution.table, FOR, AGAINST, ABOUT)
        return CrossView(distribution.camera, log_odds, distribution.lowest, distribution.step)
    nearer = distribution.table[0].permute(1, 2, 0).contiguous()  # (h, w, D): planes of a pixel next to each other in memory
    hidden = F.pad(nearer[..., ABOUT:], (0, ABOUT))
    not_free = F.pad(nearer[..., :-ABOUT], (ABOUT, 0), value=1.0)
    log_odds = torch.log(FOR * (not_free - hidden).clamp_min(0) + hidden + AGAINST)
    return CrossView(distribution.camera, log_odds.permute(2, 0, 1), distribution.lowest, distribution.step)


@torch.no_grad()
def confident_points(costs: CostVolume, distribution: DepthDistribution) -> Tensor:
    """(N, 3) of the working frame: the likeliest points of pixels along which `distribution`, made of `costs`, is sure of one depth.

    On CUDA all pixels, with points that are not numbers, which no key frame sees, for the others: their number is not read back.
    """
    if dispatch.can_use_triton(distribution.table):
        from fieldfuse.backends.triton import depth_reading

        return depth_reading.confident_points(distribution.table, costs.rays, costs.inverses, costs.camera.positions[0], SURE)
    likely = torch.diff(distribution.table[0], dim=0).neg().flatten(1)  # between planes
    best = likely.argmax(0)
    middle = 0.5 * (costs.inverses[best] + costs.inverses[best + 1])
    places = costs.rays / middle[:, None] + costs.camera.positions[0]
    return places[distribution.table[2, 0].flatten() > SURE]


@torch.no_grad()
def own_estimate(costs: CostVolume) -> tuple[CrossView, Tensor]:
    """A key frame's `cross_view` by its own images alone, and its `confident_points`."""
    if costs.empty is None and dispatch.can_use_triton(costs.cost):
        from fieldfuse.backends.triton import plane_sweep

        weights = (SMALL, LARGE, TEMPERATURE), PEAK, (FOR, AGAINST, ABOUT), SURE
        log_odds, surface, numbers = plane_sweep.own_estimate(costs, *weights)
        one = CrossView(costs.camera, log_odds, costs.lowest, costs.step)
        one._numbers.append(numbers)
        return one, surface
    distribution = to_probability(costs)
    return cross_view(distribution), confident_points(costs, distribution)


def reliability(one: CrossView, surface: Tensor) -> float:
    """In [0, 1]: how much a key frame counts, by its log odds at another one's `confident_points` (N, 3); 1 if it sees none of them."""
    odds, seen = one.log_odds_at(surface)
    count = int(seen.sum())
    return 1.0 if count == 0 else min(1.0, max(0.0, float(odds.sum()) / count / BELIEVED))


@torch.no_grad()
def consistency(costs: CostVolume, others: Sequence[CrossView], surface: Tensor | None = None) -> Tensor | None:
    """(D, h, w) that `to_probability` subtracts from the cost, in any order of the other key frames; None without any.

    They are read at every `SPACING`-th pixel; between planes nothing can be skipped, surfaces are thinner.

    Args:
        surface: (N, 3) `confident_points` of `costs` alone. Another key frame counts as far as it confirms them on average: where poses
            are off, key frames look through each other's surfaces. None: all count in full.
    """
    if not others:
        return None
    _, height, width = costs.cost.shape
    coarse = -(-height // SPACING), -(-width // SPACING)
    if dispatch.can_use_triton(costs.rays, *[one.log_odds for one in others]):
        from fieldfuse.backends.triton import depth_reading

        # Reliabilities stay on the device, which nobody waits for.
        together = depth_reading.Together(others)
        sums = None if surface is None else together.confirmed(surface)
        mean = together.mean(costs, coarse, sums, BELIEVED, SHARE)
    else:
        rays = F.interpolate(costs.rays.T.view(1, 3, height, width), coarse, mode="bilinear").view(3, -1).T.contiguous()
        mean = SHARE * _mean(rays, costs.inverses, costs.camera.positions[0], others, surface).view(*coarse, -1)
    return F.interpolate(mean[None].permute(0, 3, 1, 2), (height, width), mode="bilinear")[0]


def all_consistent(volumes: Sequence[CostVolume]) -> list[DepthDistribution]:
    """The depth distribution of each of some key frames, checked against all others."""
    own = [own_estimate(costs) for costs in volumes]
    made = []
    for number, (costs, (_, surface)) in enumerate(zip(volumes, own, strict=True)):
        others = [view for k, (view, _) in enumerate(own) if k != number]
        made.append(to_probability(costs, correction=consistency(costs, others, surface)))
    return made


def _mean(rays: Tensor, inverses: Tensor, origin: Tensor, others: Sequence[CrossView], surface: Tensor | None) -> Tensor:
    """(P, D) mean log odds of those that see there, each by its `reliability`, along rays (P, 3) at inverse depths (D,)."""
    reliabilities = [1.0 if surface is None else reliability(one, surface) for one in others]
    if dispatch.can_use_numba(rays, inverses, *[one.log_odds for one in others]):
        from fieldfuse.backends.numba import depth_reading

        return depth_reading.mean_log_odds(rays, inverses, origin, others, reliabilities)
    points = (rays[:, None] / inverses[:, None] + origin).reshape(-1, 3)
    total, count = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    for one, share in zip(others, reliabilities, strict=True):
        odds, seen = one.log_odds_at(points)
        total, count = total + share * odds, count + seen
    return (total / count.clamp_min(1)).view(len(rays), -1)
