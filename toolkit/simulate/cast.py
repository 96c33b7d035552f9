"""First hits of rays on convex solids, exact, in torch on any device.

Rays come in an order in which neighbours in the list are neighbours in space (`tile_order` makes one for pictures). Each run of
`TILE` rays is bounded by a pyramid; only solids that reach into the pyramid are intersected with its rays. For pictures this
leaves a handful of the solids of a furnished room.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch

from fieldfuse.backends import dispatch
from fieldfuse.simulate.solids import BALL, BOX, CYLINDER, ROOM, Solids

Tensor = torch.Tensor
Vector = tuple[Tensor, Tensor, Tensor]  # x, y, z apart: elementwise work on planes is several times faster than on rows of three

FAR = 1e9
TILE = 256
SIDE = 16  # a tile of a picture is SIDE × SIDE pixels
RAYS_A_CHUNK = 1 << 17
TILES_AT_ONCE = 128  # enough that the work outweighs the calls, few enough that it stays in the processor's cache
NEAREST = 1e-5  # metres: nothing is hit closer than this
PARALLEL = 1e-8


@lru_cache(maxsize=16)
def tile_order(width: int, height: int) -> tuple[Tensor, Tensor]:
    """Orders of a picture's pixels: pixel numbers (row · width + column) tile by tile, and its inverse. Both (width · height,)."""
    rows, columns = np.divmod(np.arange(width * height), width)
    order = np.lexsort((columns, rows, columns // SIDE, rows // SIDE))
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return torch.from_numpy(order), torch.from_numpy(back)


def cast(solids: Solids, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """First hits of rays.

    Args:
        origins: (N, 3), or (1, 3) for rays from one place.
        directions: (N, 3) unit vectors.

    Returns:
        distance (N,), `FAR` where nothing is hit, and the number of the solid (N,) int64, −1 where nothing is hit. A solid that
        the ray starts in is not seen (rooms are seen from inside).
    """
    if dispatch.can_use_triton(origins, directions):
        from fieldfuse.simulate import cast_gpu

        return cast_gpu.cast(solids, origins, directions, FAR, NEAREST)
    parts = [
        _cast(solids, origins if len(origins) == 1 else origins[i : i + RAYS_A_CHUNK], directions[i : i + RAYS_A_CHUNK])
        for i in range(0, len(directions), RAYS_A_CHUNK)
    ]
    if not parts:
        return directions.new_empty(0), torch.empty(0, dtype=torch.int64, device=directions.device)
    return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])


def _cast(solids: Solids, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    count = len(directions)
    tiles = -(-count // TILE)
    if tiles * TILE > count:  # the last tile is filled with copies of the last ray
        directions = torch.cat([directions, directions[-1:].expand(tiles * TILE - count, 3)])
        if len(origins) > 1:
            origins = torch.cat([origins, origins[-1:].expand(tiles * TILE - count, 3)])
    rays = directions.T.reshape(3, tiles, TILE)
    starts = origins.T.reshape(3, 1, 1).expand(3, tiles, 1) if len(origins) == 1 else origins.T.reshape(3, tiles, TILE)
    reached = _reached(solids, starts, rays)  # (tiles, solids)
    best = torch.full((tiles, TILE), FAR, device=directions.device)
    which = torch.full((tiles, TILE), -1, dtype=torch.int64, device=directions.device)
    for kind, (first, last) in solids.ranges.items():
        if last > first:
            _nearest(solids, kind, first, reached[:, first:last], starts, rays, best, which)
    return best.reshape(-1)[:count], which.reshape(-1)[:count]


def _reached(solids: Solids, starts: Tensor, rays: Tensor) -> Tensor:
    """(tiles, solids) bool: false only where no ray of the tile can meet the solid.

    A tile's rays lie within a pyramid about their mean direction, widened by how far their origins are from the mean origin.
    A solid lies outside one of its five planes when the corner of its bounding box that is furthest in does.
    """
    middle = starts.mean(2)  # (3, tiles)
    spread = (starts - middle[:, :, None]).square().sum(0).amax(1).sqrt()  # (tiles,)
    axis = torch.nn.functional.normalize(rays.mean(2), dim=0)
    helper = torch.where(axis[2:].abs() < 0.9, axis.new_tensor([[0.0], [0.0], [1.0]]), axis.new_tensor([[1.0], [0.0], [0.0]]))
    right = torch.nn.functional.normalize(torch.linalg.cross(axis, helper, dim=0), dim=0)
    up = torch.linalg.cross(right, axis, dim=0)

    def along(vector: Tensor) -> Tensor:
        return rays[0] * vector[0, :, None] + rays[1] * vector[1, :, None] + rays[2] * vector[2, :, None]

    ahead = along(axis)
    wide = ahead.amin(1) < 0.2  # no pyramid holds such rays usefully: meet everything
    ahead = ahead.clamp(min=0.2)
    across, above = along(right) / ahead, along(up) / ahead
    planes = torch.stack(
        [
            right - (across.amin(1) - 1e-5) * axis,
            (across.amax(1) + 1e-5) * axis - right,
            up - (above.amin(1) - 1e-5) * axis,
            (above.amax(1) + 1e-5) * axis - up,
            axis,
        ]
    )  # (5, 3, tiles), pointing inwards
    planes = torch.nn.functional.normalize(planes, dim=1).permute(2, 0, 1)  # (tiles, 5, 3)
    offset = (planes * middle.T[:, None]).sum(2)  # (tiles, 5)
    boxes = solids.rotation * solids.half[:, None, :]  # (P, 3, 3), columns reach to the faces
    height = torch.einsum("tki,pi->tkp", planes, solids.centre) - offset[:, :, None]
    reach = torch.einsum("tki,pij->tkpj", planes, boxes).abs().sum(3)
    touched = (height + reach + spread[:, None, None] + 1e-4 >= 0).all(1)
    return touched | wide[:, None]


def _nearest(solids: Solids, kind: str, first: int, reached: Tensor, starts: Tensor, rays: Tensor, best: Tensor, which: Tensor) -> None:
    """Lower `best` and set `which` (both (tiles, TILE), in place) by the solids of one kind.

    Tiles are sorted by how many candidates they have; the first candidates of all tiles are met at once, then the second ones of
    those that have two, and so on. Where few tiles are left, several of their candidates are taken together.
    """
    counts = reached.sum(1)
    order = counts.argsort(descending=True, stable=True)
    most = int(counts.max())
    if most == 0:
        return
    table = reached.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[order, :most] + first  # (tiles, most)
    active = (counts[order][:, None] > torch.arange(most, device=counts.device)).sum(0).tolist()
    starts, rays = starts[:, order, None], rays[:, order, None]  # (3, tiles, 1, 1 or TILE)
    near, seen = best[order], which[order]
    meet = _MEET[kind]
    rank = 0
    while rank < most:
        tiles = active[rank]
        together = max(1, TILES_AT_ONCE // tiles)
        numbers = table[:tiles, rank : rank + together]  # (tiles, together); past a tile's own candidates come others: they do no harm
        rank += together
        turn, half, centre = solids.rotation[numbers], solids.half[numbers], solids.centre[numbers]
        gap = (starts[0, :tiles] - centre[..., :1], starts[1, :tiles] - centre[..., 1:2], starts[2, :tiles] - centre[..., 2:])
        ray = (rays[0, :tiles], rays[1, :tiles], rays[2, :tiles])
        t = meet(_into(turn, gap), _into(turn, ray), half)  # (tiles, together, TILE)
        if t.shape[1] == 1:
            t, number = t[:, 0], numbers
        else:
            t, nearest = t.min(1)
            number = numbers.gather(1, nearest)
        closer = t < near[:tiles]
        near[:tiles] = torch.where(closer, t, near[:tiles])
        seen[:tiles] = torch.where(closer, number, seen[:tiles])
    best[order], which[order] = near, seen


def _into(turn: Tensor, vector: Vector) -> Vector:
    """Vectors in solids' own axes: the columns of `turn` (tiles, together, 3, 3)."""
    x, y, z = vector
    own = [torch.addcmul(torch.addcmul(x * turn[..., 0, i, None], y, turn[..., 1, i, None]), z, turn[..., 2, i, None]) for i in range(3)]
    return own[0], own[1], own[2]


def _slab(start: Tensor, slope: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit of the space between −half and half along one axis."""
    inverse = slope.abs().clamp_(min=PARALLEL).reciprocal_()
    middle = -start * torch.copysign(inverse, slope)
    reach = inverse.mul_(half[..., None])
    return middle - reach, middle.add_(reach)


def _box_interval(start: Vector, ray: Vector, half: Tensor) -> tuple[Tensor, Tensor]:
    enter, leave = _slab(start[0], ray[0], half[..., 0])
    for i in (1, 2):
        near, far = _slab(start[i], ray[i], half[..., i])
        torch.maximum(enter, near, out=enter)
        torch.minimum(leave, far, out=leave)
    return enter, leave


def _meet_box(start: Vector, ray: Vector, half: Tensor) -> Tensor:
    enter, leave = _box_interval(start, ray, half)
    return torch.where((enter <= leave) & (enter > NEAREST), enter, FAR)


def _meet_room(start: Vector, ray: Vector, half: Tensor) -> Tensor:
    enter, leave = _box_interval(start, ray, half)
    return torch.where((enter <= leave) & (leave > NEAREST), leave, FAR)


def _round_interval(start: Vector, ray: Vector, half: Tensor, axes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Entry, exit and hit of the unit ball in the first `axes` coordinates scaled by `half`.

    By the distance of the centre from the ray, not by a difference of squares: that loses the digits of small, far balls.
    """
    o = [start[i] / half[..., i, None] for i in range(axes)]
    d = [ray[i] / half[..., i, None] for i in range(axes)]
    length = sum((a * a for a in d[1:]), d[0] * d[0]).clamp_(min=1e-12)
    closest = -sum((a * b for a, b in zip(o[1:], d[1:], strict=True)), o[0] * d[0]) / length
    miss = sum(((a + closest * b).square() for a, b in zip(o[1:], d[1:], strict=True)), (o[0] + closest * d[0]).square())
    reach = ((1 - miss).clamp_(min=0) / length).sqrt_()
    return closest - reach, closest + reach, miss < 1


def _meet_ball(start: Vector, ray: Vector, half: Tensor) -> Tensor:
    enter, _, hit = _round_interval(start, ray, half, 3)
    return torch.where(hit & (enter > NEAREST), enter, FAR)


def _meet_cylinder(start: Vector, ray: Vector, half: Tensor) -> Tensor:
    enter, leave, hit = _round_interval(start, ray, half, 2)
    near, far = _slab(start[2], ray[2], half[..., 2])
    enter, leave = torch.maximum(enter, near), torch.minimum(leave, far)
    return torch.where(hit & (enter <= leave) & (enter > NEAREST), enter, FAR)


_MEET: dict[str, Callable[[Vector, Vector, Tensor], Tensor]] = {
    BOX: _meet_box,
    ROOM: _meet_room,
    BALL: _meet_ball,
    CYLINDER: _meet_cylinder,
}
