"""What images are compared by, and semi-global matching: from costs of depths to a distribution over depths, pixel by pixel.

Two descriptors go together: colours tell where surfaces of one colour end but change with exposure; patches without their mean and contrast
do not. Nothing here is learned or differentiated.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.stereo.cost_volume import DOWN, STRAIGHT, UP, summed_paths
from fieldfuse.threads import share

SIDE = 256  # pixels of the long side at which images are compared (docs/measured/few_views.md) …
SIDE_WITHIN = 448  # … and where silhouettes leave a part of them
CONTRAST = 0.03  # of a patch, added to its own: what is flatter is noise
GREY = (0.3, 0.59, 0.11)
COLOUR_GAIN = 8.0  # a mean difference of 1/8 in colour counts as different
UNKNOWN = 0.6  # cost where no other view sees the place
SMALL, LARGE = 0.1, 0.8  # penalties for a step of one plane between neighbouring pixels, and for a larger one
TEMPERATURE = 0.05  # of the distribution; with the penalties the best of those tried on simulated scenes (docs/measured/few_views.md)


def patch_descriptors(images: Tensor, side: int = SIDE) -> Tensor:
    """(V, 3, H, W) RGB in [0, 1] → (V, 21, h, w), long side at most `side`: colour, and patches of 3×3 at two spacings."""
    images = images.detach().float()
    long = max(images.shape[-2:])
    if long > side:
        size = [max(1, round(length * side / long)) for length in images.shape[-2:]]
        images = F.interpolate(images, size, mode="bilinear", antialias=True)
    if dispatch.can_use_triton(images):
        from fieldfuse.backends.triton import plane_sweep

        return plane_sweep.patch_descriptors(images, GREY, CONTRAST)
    red, green, blue = images.split(1, 1)
    grey = GREY[0] * red + GREY[1] * green + GREY[2] * blue
    return torch.cat([images, _patches(grey, 1), _patches(grey, 2)], 1)


def _patches(grey: Tensor, spacing: int) -> Tensor:
    """(V, 1, H, W) → (V, 9, H, W): the 3×3 neighbours at this spacing, without their mean, divided by their contrast."""
    height, width = grey.shape[-2:]
    wide = F.pad(grey, (spacing,) * 4, mode="replicate")
    steps = (0, spacing, 2 * spacing)
    parts = torch.cat([wide[:, :, y : y + height, x : x + width] for y in steps for x in steps], 1)
    parts = parts - parts.mean(1, keepdim=True)
    return parts / (parts.square().mean(1, keepdim=True).sqrt() + CONTRAST)


def difference(one: Tensor, other: Tensor) -> Tensor:
    """(…, 21) descriptors → (…) cost in [0, 1]."""
    apart = other - one
    colour = (apart[..., :3].abs().mean(-1) * COLOUR_GAIN).clamp_max(1)
    patch = (apart[..., 3:].square().mean(-1) * 0.5).clamp_max(1)
    return 0.5 * (colour + patch)


def together(costs: Tensor, visible: Tensor) -> Tensor:
    """Costs (K − 1, …) against each other view → one cost, in any order of the views.

    Half their mean, half the smallest: what is hidden in one view may be seen in another.
    """
    count = visible.sum(0)
    mean = (costs * visible).sum(0) / count.clamp_min(1)
    least = torch.where(visible, costs, torch.ones_like(costs)).amin(0)
    return torch.where(count > 0, 0.5 * (mean + least), torch.full_like(mean, UNKNOWN))


def semi_global(cost: Tensor) -> Tensor:
    """(D, h, w) costs → the same smoothed along four directions, each the cheapest path up to the pixel (semi-global matching)."""
    volume = cost.permute(1, 2, 0)  # (h, w, D)
    if dispatch.can_use_numba(cost) and len(cost) > 2:
        whole = volume.contiguous().numpy()
        even = np.zeros(whole.shape[:2], np.float32)  # depth may step anywhere
        one, other = share(lambda way: summed_paths(whole, even, SMALL, LARGE, STRAIGHT, (way,)), (DOWN, UP), torch.get_num_threads())
        return torch.from_numpy((one + other) / np.float32(4)).permute(2, 0, 1)
    down, right = volume, volume.transpose(0, 1)
    total = _paths(down) + _paths(down.flip(0)).flip(0)
    total = total + (_paths(right) + _paths(right.flip(0)).flip(0)).transpose(0, 1)
    return (total / 4).permute(2, 0, 1)


def _paths(volume: Tensor) -> Tensor:
    """(n, m, D) → cheapest paths along the first axis, less what the cheapest plane before had cost."""
    paths = [volume[0]]
    for line in volume[1:]:
        before = paths[-1]
        best = before.amin(1, keepdim=True)
        beside = F.pad(before, (1, 1), value=torch.inf)
        near = torch.minimum(beside[:, 2:], beside[:, :-2]) + SMALL
        paths.append(line + torch.minimum(torch.minimum(before, near), best + LARGE) - best)
    return torch.stack(paths)


def smoothed_softmax(cost: Tensor) -> Tensor:
    """(D, h, w) costs → how likely the surface lies at each plane; sums to one over D."""
    if dispatch.can_use_triton(cost):
        from fieldfuse.backends.triton import plane_sweep

        return plane_sweep.smoothed_softmax(cost, SMALL, LARGE, TEMPERATURE)
    along = semi_global(cost).permute(1, 2, 0)  # (h, w, D), where the planes of a pixel lie next to each other in memory on the CPU
    return torch.softmax(along.div_(-TEMPERATURE), 2).permute(2, 0, 1)
