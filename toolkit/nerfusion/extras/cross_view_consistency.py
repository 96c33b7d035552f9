"""Key frames as each other's witnesses: where one says that there is surface, those beside it must not see through (not in the paper).

A sweep of three views is led astray where they show no texture or repeat, but not all key frames are in the same way. A point along a pixel
of one key frame is seen by another one as surface, as free space in front of it, or not at all since something hides it, each with a
likelihood that the other's sweep tells. Surface there speaks for the plane, free space against it, and what is hidden for neither. What the
witnesses say on average goes into the cost before it is smoothed, so that it spreads over a surface as what the pictures say does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion import compiled, compiled_witness
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.matching import LARGE, SMALL, TEMPERATURE
from fieldfuse.nerfusion.extras.plane_sweep import PEAK, Compared, Sweep, decide

FOR = 4.0  # times as likely as where it is hidden, where the witness is sure of surface
AGAINST = 0.1  # times as likely where it is sure of free space: it may err
SHARE = 0.3  # of the mean logarithm that is taken from the cost
ABOUT = 2  # planes on either side within which surface counts, the last of them by half
SURE = 0.7  # of the likelihood within some planes about one depth
BELIEVED = 1.0  # mean logarithm from which on a witness is believed in full; its most is 1.4
SPACING = 2  # of the pixels that ask


@dataclass(frozen=True)
class Witness:
    """What a sweep says for and against surface.

    Attributes:
        camera: one.
        says: (D, h, w) over inverse depths, farthest first: logarithm of how much likelier surface is than without this witness.
        lowest, step: inverse depth of the first entry, and between entries.
    """

    camera: Cameras
    says: Tensor
    lowest: float
    step: float
    _numbers: list[Tensor] = field(default_factory=list, init=False, compare=False, repr=False)

    def numbers(self) -> Tensor:
        """(23,) that kernels for CUDA ask it by (`gpu/reading.py`), put together once."""
        if not self._numbers:
            from fieldfuse.networks.gpu import reading

            self._numbers.append(reading.numbers(self.camera, self.says, self.lowest, self.step))
        return self._numbers[0]

    def ask(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) points of the working frame → (N,) what is said, 0 where the witness does not look, and (N,) bool where it does."""
        if compiled.fits(points, self.says):
            pose, lens = self.camera.world_from_camera[0], self.camera.lens(0)
            return compiled_witness.ask(points, self.says, pose, lens, self.lowest, self.step)
        local = self.camera.local(points)[0]
        seen = local[:, 2] > 1e-4
        inverse = 1 / torch.where(seen, local[:, 2], torch.ones_like(local[:, 2]))
        focal, middle = self.camera.intrinsics[0, :2], self.camera.intrinsics[0, 2:]
        pixel = (local[:, :2] * inverse[:, None] * focal + middle) / self.camera.size[0] * 2 - 1
        seen &= (pixel.abs() <= 1).all(1)
        plane = ((inverse - self.lowest) / self.step + 0.5) / len(self.says) * 2 - 1
        grid = torch.cat([pixel, plane[:, None]], 1).clamp(-2, 2)[None, None, None]
        found = F.grid_sample(self.says[None, None], grid, padding_mode="border", align_corners=False)[0, 0, 0, 0]
        return torch.where(seen, found, torch.zeros_like(found)), seen


def witness(swept: Sweep) -> Witness:
    """What others may ask a key frame, from its sweep."""
    if dispatch.can_use_triton(swept.table):
        from fieldfuse.networks.gpu import reading

        return Witness(swept.camera, reading.says(swept.table, FOR, AGAINST, ABOUT), swept.lowest, swept.step)
    nearer = swept.table[0].permute(1, 2, 0).contiguous()  # (h, w, D): planes of a pixel next to each other in memory
    hidden = F.pad(nearer[..., ABOUT:], (0, ABOUT))
    not_free = F.pad(nearer[..., :-ABOUT], (ABOUT, 0), value=1.0)
    says = torch.log(FOR * (not_free - hidden).clamp_min(0) + hidden + AGAINST)
    return Witness(swept.camera, says.permute(2, 0, 1), swept.lowest, swept.step)


@torch.no_grad()
def certain(compared: Compared, swept: Sweep) -> Tensor:
    """(N, 3) of the working frame: the likeliest places of pixels along which `swept`, made of `compared`, is sure of one depth.

    On CUDA all pixels, with places that are not numbers, which no witness sees, for those that are not: how many there are is not asked.
    """
    if dispatch.can_use_triton(swept.table):
        from fieldfuse.networks.gpu import reading

        return reading.surest(swept.table, compared.rays, compared.inverses, compared.camera.positions[0], SURE)
    likely = torch.diff(swept.table[0], dim=0).neg().flatten(1)  # between planes
    best = likely.argmax(0)
    middle = 0.5 * (compared.inverses[best] + compared.inverses[best + 1])
    places = compared.rays / middle[:, None] + compared.camera.positions[0]
    return places[swept.table[2, 0].flatten() > SURE]


def alone(compared: Compared) -> tuple[Witness, Tensor]:
    """The `witness` that a key frame's pictures alone make it, and the places that they are `certain` of."""
    if compared.empty is None and dispatch.can_use_triton(compared.cost):
        return _alone_on_device(compared)
    swept = decide(compared)
    return witness(swept), certain(compared, swept)


@torch.no_grad()
def _alone_on_device(compared: Compared) -> tuple[Witness, Tensor]:
    from fieldfuse.networks.gpu import matching

    weights = (SMALL, LARGE, TEMPERATURE), PEAK, (FOR, AGAINST, ABOUT), SURE
    given = compared.cost, compared.rays, compared.inverses, compared.camera, compared.lowest, compared.step
    says, surface, numbers = matching.alone(*given, *weights)
    one = Witness(compared.camera, says, compared.lowest, compared.step)
    one._numbers.append(numbers)
    return one, surface


def credit(one: Witness, surface: Tensor) -> float:
    """In [0, 1]: how far a witness is to be believed, by what it says of places that another one is sure of; 1 if it sees none of them."""
    said, seen = one.ask(surface)
    count = int(seen.sum())
    return 1.0 if count == 0 else min(1.0, max(0.0, float(said.sum()) / count / BELIEVED))


@torch.no_grad()
def evidence(compared: Compared, witnesses: Sequence[Witness], surface: Tensor | None = None) -> Tensor | None:
    """(D, h, w) that `decide` takes from the cost, in any order of the witnesses; None without any.

    Args:
        surface: (N, 3) points that `compared` alone is sure of (`certain`). A witness is believed as far as it confirms them on average:
            where poses are off, key frames look through each other's surfaces. None: every witness is believed.

    Witnesses are asked at every `SPACING`-th pixel either way; between planes nothing can be left out, surfaces are thinner.
    """
    if not witnesses:
        return None
    planes, height, width = compared.cost.shape
    coarse = [-(-side // SPACING) for side in (height, width)]
    if dispatch.can_use_triton(compared.rays, *[one.says for one in witnesses]):
        mean = _mean_on_device(compared, (height, width), (coarse[0], coarse[1]), witnesses, surface)
        return F.interpolate(mean[None].permute(0, 3, 1, 2), (height, width), mode="bilinear")[0]
    rays = F.interpolate(compared.rays.T.view(1, 3, height, width), coarse, mode="bilinear").view(3, -1).T.contiguous()
    mean = SHARE * _mean(rays, compared.inverses, compared.camera.positions[0], witnesses, surface)
    return F.interpolate(mean.view(1, *coarse, planes).permute(0, 3, 1, 2), (height, width), mode="bilinear")[0]


def _mean(rays: Tensor, inverses: Tensor, origin: Tensor, witnesses: Sequence[Witness], surface: Tensor | None) -> Tensor:
    """(P, D) what witnesses that look there say in the mean, each by how far it is believed (`credit`), along rays (P, 3) at (D,)."""
    volumes = [one.says for one in witnesses]
    beliefs = [1.0 if surface is None else credit(one, surface) for one in witnesses]
    if compiled.fits(rays, inverses, *volumes):
        asked = compiled_witness.Question(rays, inverses, origin)
        for one, belief in zip(witnesses, beliefs, strict=True):
            asked.put(one.says, one.camera.world_from_camera[0], one.camera.lens(0), one.lowest, one.step, belief)
        return asked.mean()
    points = (rays[:, None] / inverses[:, None] + origin).reshape(-1, 3)
    total, count = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    for one, belief in zip(witnesses, beliefs, strict=True):
        said, seen = one.ask(points)
        total, count = total + belief * said, count + seen
    return (total / count.clamp_min(1)).view(len(rays), -1)


def _mean_on_device(
    compared: Compared, grid: tuple[int, int], coarse: tuple[int, int], witnesses: Sequence[Witness], surface: Tensor | None
) -> Tensor:
    """(h', w', D): a share of the mean, without waiting for CUDA: how far witnesses are believed stays there."""
    from fieldfuse.networks.gpu import reading

    asked = reading.Asked(witnesses)
    sums = None if surface is None else asked.confirmed(surface)
    return asked.mean(compared.rays, compared.inverses, compared.camera, grid, coarse, sums, BELIEVED, SHARE)
