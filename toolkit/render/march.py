"""Ray marching: along bricks of half a block first, then over the occupied voxels inside the bricks that a ray crosses.

Both steps walk a lattice of distances that depends on the ray alone, never on what was found, so everything is a mask and a gather and
nothing waits for the slowest ray. Step lengths are measured in contracted space: one rule inside the region of interest and beyond it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F

from fieldfuse.backends import dispatch
from fieldfuse.backends.constants import BRICK as BRICK
from fieldfuse.backends.constants import MAX_STRETCH as MAX_STRETCH
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor


@dataclass(frozen=True)
class Samples:
    """Flattened samples, ray after ray, near to far. All (samples, …)."""

    ray: Tensor  # int64 index of the ray
    first: Tensor  # int64 index of the first sample of the same ray
    distance: Tensor  # float32 along the unit direction, working units
    span: Tensor  # float32 interval along the direction, working units
    length: Tensor  # float32 interval in normalised contracted units (the unit of 1/σ)
    place: Tensor  # float32 position along the ray's own lattice, about 0 … 1
    cell: Tensor  # int64 row of the voxel (lower corner) that holds the sample
    inside: Tensor  # (samples, 3) float32 position within that voxel, 0 … 1

    def __len__(self) -> int:
        return len(self.ray)

    def take(self, kept: Tensor) -> Samples:
        """The samples of the ascending indices `kept`, with `first` renewed."""
        ray = self.ray[kept]
        values = (self.distance, self.span, self.length, self.place, self.cell, self.inside)
        return Samples(ray, first_of_ray(ray), *(value[kept] for value in values))


def first_of_ray(ray: Tensor) -> Tensor:
    """(samples,) ascending ray indices → index of the first sample with the same ray."""
    if len(ray) == 0:
        return ray
    starts = torch.ones_like(ray, dtype=torch.bool)
    starts[1:] = ray[1:] != ray[:-1]
    return starts.nonzero().squeeze(1)[torch.cumsum(starts, 0) - 1]


class MarchGrid:
    """What a ray needs of a volume: its space, its lattice, which blocks and which voxels hold something.

    Args:
        space: region of interest and contraction.
        resolution: voxels along the side of the lattice's cube; voxel (0, 0, 0) starts at -extent.
        topology: blocks, keys counted from that corner.
        occupied: (M · 512,) bool.
    """

    def __init__(self, space: Space, resolution: int, topology: Topology, occupied: Tensor) -> None:
        self.space, self.resolution, self.topology, self.occupied = space, resolution, topology, occupied
        self.voxel = 2 * space.extent / resolution
        self._table = topology.table.reshape(-1)
        self._side = resolution // BRICK

    @cached_property
    def bricks(self) -> Tensor:
        """(B, B, B) bool z, y, x: bricks that hold an occupied voxel, with a margin of one that keeps border look-ups simple."""
        width = self._side + 2
        out = torch.zeros(width, width, width, dtype=torch.bool, device=self.occupied.device)
        per_block = self.occupied.view(-1, 2, BRICK, 2, BRICK, 2, BRICK).any(6).any(4).any(2)  # (M, 2, 2, 2) z, y, x
        filled = per_block.nonzero()
        place = self.topology.keys[filled[:, 0]].long().flip(1) * 2 + filled[:, 1:] + 1  # z, y, x
        place = place.clamp(0, self._side + 1)
        out[place[:, 0], place[:, 1], place[:, 2]] = True
        return out

    @cached_property
    def _near(self) -> Tensor:
        """A coarse step is as long as a brick, so what it crosses lies in its own brick or next to it."""
        return F.max_pool3d(self.bricks[None, None].float(), 3, 1, 1)[0, 0].bool()

    def near_bricks(self, contracted: Tensor) -> Tensor:
        """(..., 3) contracted points → (...) bool: something occupied lies within one brick."""
        index = ((contracted + self.space.extent) * (1 / (self.voxel * BRICK))).floor_().long().add_(1).clamp_(0, self._side + 1)
        width = self._side + 2
        return self._near.view(-1)[(index[..., 2] * width + index[..., 1]) * width + index[..., 0]]

    def voxels(self, contracted: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) contracted points → (N,) row of the voxel around each, −1 where nothing is occupied, and (N, 3) place within it."""
        lattice = ((contracted + self.space.extent) * (1 / self.voxel)).clamp_(0, self.resolution - 1e-3)
        whole = lattice.floor()
        cell = whole.long()
        block, local = cell >> 3, cell & 7
        (ox, oy, oz), (sx, sy, sz) = self.topology.table_origin, self.topology.table_size
        # The table's outermost layer is empty: far blocks are moved there.
        x = (block[:, 0] - ox).clamp_(0, sx - 1)
        y = (block[:, 1] - oy).clamp_(0, sy - 1)
        z = (block[:, 2] - oz).clamp_(0, sz - 1)
        slot = self._table[(z * sy + y) * sx + x].long()
        row = slot * VOXELS + ((local[:, 2] * BLOCK + local[:, 1]) * BLOCK + local[:, 0])
        row = torch.where(slot >= 0, row, -1)
        row = torch.where(self.occupied[row.clamp_min(0)], row, -1)
        return row, lattice - whole


def _coarse_distances(grid: MarchGrid, origins: Tensor, directions: Tensor, near: float, step: float, jitter: Tensor) -> Tensor:
    """(B, K + 1) distances whose neighbours are about `step` apart in contracted space. `origins`, `directions`: normalised."""
    space = grid.space
    speed = directions.norm(dim=1)  # normalised units per working unit
    if space.shell == 0:
        box = origins.new_tensor(space.box)
        safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
        low, high = (-box - origins) / safe, (box - origins) / safe
        enter = torch.minimum(low, high).amax(1).clamp_min(near)
        leave = torch.maximum(low, high).amin(1)
        count = math.ceil(float(((leave - enter) * speed).clamp_min(0).max()) / step) + 1 if len(origins) else 1
        lattice = torch.arange(count + 1, device=origins.device) - jitter[:, None]
        distance = enter[:, None] + lattice * (step / speed)[:, None]
        return torch.where((leave > enter)[:, None], distance, torch.full_like(distance, -1.0)).clamp_max(leave.clamp_min(-1.0)[:, None])
    far = space.shell / grid.voxel  # |y| in the outermost voxel: the last step starts before it
    limit = int(2 * math.sqrt(3) * 2 * space.extent / step) + 8
    if dispatch.can_use_triton(origins, directions, jitter):
        from fieldfuse.backends.triton import coarse_steps as march_gpu

        return march_gpu.walk(origins, directions, jitter, 2 * limit, near, step, far, space.shell, space.extent, MAX_STRETCH)
    # Beyond the region a place moves in contracted space by at most c / n² of its way, c² = b² + (extent · closest approach)².
    closest = origins - directions * ((origins * directions).sum(1) / speed**2)[:, None]
    rise = 1 / (space.shell**2 + space.extent**2 * closest.square().sum(1)).sqrt()
    distance = near - jitter * step / speed
    out = [distance]
    for _ in range(2 * limit):
        norm = torch.addcmul(origins, directions, distance[:, None]).abs_().amax(1).clamp_min_(1.0)
        if bool((norm > far).all()):
            break
        stretch = (norm * norm * rise).clamp_(1.0, MAX_STRETCH)
        distance = torch.where(norm > far, distance, distance + stretch * (step / speed))
        out.append(distance)
    return torch.stack(out, 1)


def march(grid: MarchGrid, origins: Tensor, directions: Tensor, near: float = 0.0, fine: int = 4, jitter: Tensor | None = None) -> Samples:
    """Samples in the occupied voxels along rays.

    Args:
        origins: (B, 3) working frame; directions: (B, 3) unit vectors.
        near: distance before which nothing is sampled, working units.
        fine: samples per brick (4 voxels): 4 is one a voxel.
        jitter: (B,) in [0, 1), moves a ray's lattice by that part of a fine step; None: none.

    Not differentiable with respect to rays; what is looked up at the samples is.
    """
    space = grid.space
    step = grid.voxel * BRICK
    origin, direction = space.normalise(origins), directions / space.half
    shift = (jitter if jitter is not None else torch.zeros(len(origins), device=origins.device)) / fine
    distance = _coarse_distances(grid, origin, direction, near, step, shift)
    place = space.contract(torch.addcmul(origin[:, None], direction[:, None], distance[..., None]))  # (B, K + 1, 3)
    chord = place[:, 1:] - place[:, :-1]
    length = chord.norm(dim=2)  # (B, K)
    middle = place[:, :-1] + 0.5 * chord
    crossed = (grid.near_bricks(middle) & (length > 0) & (distance[:, 1:] > near)).view(-1).nonzero().squeeze(1)
    steps = distance.shape[1] - 1
    ray = crossed.div(steps, rounding_mode="floor")
    start = crossed + ray  # index into (B, K + 1)
    part = (torch.arange(fine, device=origins.device) + 0.5) / fine
    flat = place.reshape(-1, 3)
    points = torch.addcmul(flat[start][:, None], chord.reshape(-1, 3)[crossed][:, None], part[None, :, None]).reshape(-1, 3)
    row, inside = grid.voxels(points)
    held = (row >= 0).nonzero().squeeze(1)
    which = held.div(fine, rounding_mode="floor")
    along = part[held - which * fine]
    begin = distance.reshape(-1)[start]
    span = distance.reshape(-1)[start + 1] - begin
    t = begin[which] + span[which] * along
    samples_ray = ray[which]
    return Samples(
        ray=samples_ray,
        first=first_of_ray(samples_ray),
        distance=t,
        span=span[which] / fine,
        length=length.view(-1)[crossed][which] / fine,
        place=((crossed - ray * steps)[which] + along) * (step / (2 * space.extent)),
        cell=row[held],
        inside=inside[held],
    )
