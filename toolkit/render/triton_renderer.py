"""A field on CUDA as its kernels read it, and renders of it."""

from __future__ import annotations

import torch
import torch.nn.functional as F
import triton

from fieldfuse.backends.triton.march import DX, LAYERS, MEDIAN, OPACITY, RAYS, SHOWN, SUMS, composite, walk
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.encoding import DIRECTION, spherical_harmonics
from fieldfuse.render.field import Field
from fieldfuse.render.march import BRICK
from fieldfuse.render.rays import RayValues

Tensor = torch.Tensor
FARTHEST = 24  # bricks that are skipped at once, at most
CHUNK = 65536  # rays of a render at a time …
SLOTS = 192  # … and samples of each that can show: the weights of so many exceed the threshold in thin fog alone, whose rest hardly shows
THRESHOLD = 1e-3  # of weights that show in renders, as in `rays.render_rays`


class Tables:
    """What `backends.triton.march.walk` reads of a field. The tensors stay where they are when voxels are pruned (`renew`)."""

    def __init__(self, field: Field) -> None:
        space, topology = field.space, field.topology
        self.table, self.lookup = topology.table.view(-1), topology.lookup_rows.reshape(-1)
        self.occupied, self.skip = field.occupied.to(torch.uint8), bricks_to_skip(field.grid.bricks)
        self.shell, self.fine = space.shell > 0, field.fine
        (tx, ty, tz), (sx, sy, sz) = topology.table_origin, topology.table_size
        voxel = field.grid.voxel
        self.scalars = (
            *(*space.centre, space.half, space.extent, float(space.shell), *space.box, field.near, voxel * BRICK, voxel),
            *(field.grid.bricks.shape[0], field.resolution - 1e-3, tx, ty, tz, sx, sy, sz),
        )

    def renew(self, field: Field) -> None:
        """The same lattice after pruning."""
        self.occupied.copy_(field.occupied)
        self.skip.copy_(bricks_to_skip(field.grid.bricks))


def bricks_to_skip(bricks: Tensor) -> Tensor:
    """(B, B, B) bool → (B³,) uint8 distance to the nearest true cell, along the axis in which it is farthest; `FARTHEST` and more are
    `FARTHEST`."""
    near, away = bricks[None, None].float(), torch.zeros_like(bricks, dtype=torch.uint8)
    for _ in range(FARTHEST):
        away += (near[0, 0] == 0).to(torch.uint8)
        near = F.max_pool3d(near, 3, 1, 1)
    return away.view(-1)


def launch_walk(
    field: Field, tables: Tables, buffers: tuple[Tensor, ...], marks: tuple[Tensor, Tensor], count: int, threshold: float, slots: int
) -> None:
    """Walk along the first `count` rays of `buffers` (rays, cells, notes, counts, sums). With marks (`seen`, `visits`) of no voxel it is a
    render's walk, else a training step's."""
    train = len(marks[0]) > 0
    walk[(triton.cdiv(count, RAYS),)](
        *buffers,
        *marks,
        *(tables.skip, tables.table, tables.occupied, tables.lookup, field.density_rows, count, buffers[0].shape[1]),
        *tables.scalars,
        threshold,
        FINE=tables.fine,
        HAS_SHELL=tables.shell,
        TRAIN=train,
        SLOTS=slots,
        B=RAYS,
        num_warps=1,
    )


def launch_composite(field: Field, tables: Tables, buffers: tuple[Tensor, ...], inputs: Tensor, count: int, slots: int) -> None:
    """Mean features of the first `count` rays into the first columns of `inputs` (N, C + 16)."""
    rays, cells, notes, counts, sums = buffers
    channels = field.feature_rows.shape[1]
    composite[(triton.cdiv(count, RAYS),)](
        *(cells, notes, counts, sums, field.feature_rows, tables.lookup, inputs, count, rays.shape[1], inputs.shape[1]),
        C=channels,
        P=triton.next_power_of_2(channels),
        SLOTS=slots,
        B=RAYS,
        num_warps=1,
    )


def buffers_for(count: int, notes: int, slots: int, device: torch.device) -> tuple[Tensor, ...]:
    """Rays (LAYERS, N), cells (slots, N) int32, notes (notes, slots, N), counts (N,) int32 and sums (SUMS, N) of so many rays."""
    return (
        torch.zeros(LAYERS, count, device=device),
        torch.empty(slots, count, dtype=torch.int32, device=device),
        torch.empty(notes, slots, count, device=device),
        torch.empty(count, dtype=torch.int32, device=device),
        torch.zeros(SUMS, count, device=device),
    )


class TritonRenderer:
    """Colours, distances and opacities of a field whose rays are decoded once. Values stay on the field's device."""

    def __init__(self, field: Field, chunk: int = CHUNK, tables: Tables | None = None) -> None:
        assert isinstance(field.decoder, Deferred)
        self.field, self.device, self.tables = field, field.device, tables or Tables(field)
        self.buffers = buffers_for(chunk, SHOWN, SLOTS, self.device)
        self.inputs = torch.zeros(chunk, field.feature_rows.shape[1] + DIRECTION, device=self.device)
        self.marks = (torch.zeros(0, device=self.device), torch.zeros(0, device=self.device))

    @torch.no_grad()
    def __call__(self, origins: Tensor, directions: Tensor) -> RayValues:
        """(B, 3) origins and unit directions, working frame, on any device."""
        parts = [
            self._part(o.to(self.device), d.to(self.device))
            for o, d in zip(origins.split(len(self.inputs)), directions.split(len(self.inputs)), strict=True)
        ]
        return RayValues(*(torch.cat([getattr(part, name) for part in parts]) for name in ("colour", "distance", "opacity")))

    def _part(self, origins: Tensor, directions: Tensor) -> RayValues:
        field, count, rays = self.field, len(origins), self.buffers[0]
        rays[:DX, :count], rays[DX : DX + 3, :count] = origins.T, directions.T
        channels = field.feature_rows.shape[1]
        launch_walk(field, self.tables, self.buffers, self.marks, count, THRESHOLD, SLOTS)
        launch_composite(field, self.tables, self.buffers, self.inputs, count, SLOTS)
        inputs = self.inputs[:count]
        inputs[:, channels:] = spherical_harmonics(directions)
        sums = self.buffers[4]
        opacity = sums[OPACITY, :count]
        assert isinstance(field.decoder, Deferred)
        own = torch.sigmoid(field.decoder.net(inputs) + inputs[:, :3])
        colour = (own * opacity[:, None] + (1 - opacity)[:, None] * field.background).clamp_(0, 1)
        return RayValues(colour, sums[MEDIAN, :count].clone(), opacity.clone())
