"""NeRFusion's networks as one module with functional methods, in the order of the paper.

    views  = model.encode(images, cameras)                          # once a picture
    local  = model.local_volume(views[:K], cameras[:K], lattice)    # a key frame and its neighbours
    state  = model.fuse(state, local)                               # H' from H; start with `model.start(lattice)`
    values = model.head(state)                                      # rows of a radiance field; also of a local volume
    model.decoder                                                   # R, shared by local and global volumes

No method changes anything: gradients flow through all of them, and a state is an ordinary value. `fieldfuse.render.fused.make_field` turns
a volume into a field that can be rendered, with or without gradients; `fieldfuse.nerfusion.fusion` runs the loop over key frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fieldfuse.backends import dispatch
from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.nerfusion.aggregate import CUES, FLAGS, aggregate, agreement, direction_spread, evidence
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.compiled import fits
from fieldfuse.nerfusion.cull import all_blocks, block_balls, visible_blocks
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.nerfusion.direction import DirectionCode
from fieldfuse.nerfusion.encoder import DEEPEST, STRIDE, ImageEncoder, Sampled, padded
from fieldfuse.nerfusion.extras.matching import SIDE, describe
from fieldfuse.nerfusion.extras.plane_sweep import Empty, Sighted, Sweep, sweep
from fieldfuse.nerfusion.gru import FusionGRU, RunningMean, mean_gate
from fieldfuse.nerfusion.head import FieldHead
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, empty_volume, rows_of
from fieldfuse.nerfusion.pyramid import Pyramid, levelled, middles, sizes_of
from fieldfuse.nerfusion.recorded import Recorded
from fieldfuse.nerfusion.refine import least_thickness, surface_cells, with_blocks
from fieldfuse.nerfusion.unproject import COLOURED, EncodedView, look_up, project
from fieldfuse.nerfusion.volume_net import INSIDE, LocalReconstruction, colour_latent, inside_latent
from fieldfuse.volume.topology import VOXELS, Topology

CHUNK = 2**15  # voxels at a time: what the views show of them is many times larger than what is kept
AT_ONCE = 2**19  # where there is memory for that: 0.4 kB a voxel and view
COLOURS = 3
COLOUR_GAIN = 4.0  # pictures' RGB as numbers of about unit deviation
RECORDED = 2**23  # numbers in pictures up to which encoding them is recorded on CUDA: recordings keep the memory that they need
LEVELS = 3  # of the feature maps
COLOUR_LEVELS = 5
SIGHTED = 3  # numbers that the plane sweep says of a voxel
TRUNCATION = 2.0  # voxels about the surface within which distances are told apart
HIDDEN = 0.02  # voxels that are open with less likelihood are not known
BLIND = 0.1  # weight of a local volume where no depth stands out
FREE = 0.9  # signed distances beyond which a voxel is free space for sure


@dataclass(frozen=True)
class ModelConfig:
    """Sizes and switches of the networks. The defaults are what the shipped weights were trained with."""

    encoder: str = "small"  # small | lite0 (can start from ImageNet)
    image_channels: int = 64  # of the encoder's map
    sampled: int = 16  # of them kept where voxels look
    direction: int = 16  # of the direction code; 0: off (ablation)
    hidden: int = 16  # of J between its first and last layer
    channels: int = 16  # of local and global volumes
    gru_hidden: int = 8
    features: int = 16  # of the radiance field
    head_hidden: int = 32
    decoder: str = "deferred"  # deferred | per_sample (the paper's)
    decoder_hidden: int = 32
    variance: bool = True  # False: mean only (ablation)
    fusion: str = "gru"  # gru | mean (ablation)


class NerfusionModel(nn.Module):
    """Encoder, direction code, local reconstruction, fusion, head and decoder."""

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or ModelConfig()
        self.encoder = ImageEncoder(config.image_channels, config.encoder)
        self.sample = Sampled(config.image_channels, self.encoder.widths[0], config.sampled)
        self.direction = DirectionCode(config.direction) if config.direction else None
        inputs = 3 * (config.sampled + config.direction + 2 * COLOURS) + FLAGS + CUES + SIGHTED
        self.local = LocalReconstruction(inputs, config.hidden, config.channels)
        self.fusion: FusionGRU | RunningMean = FusionGRU(config.channels, config.gru_hidden) if config.fusion == "gru" else RunningMean()
        self.to_field = FieldHead(config.channels, config.head_hidden, config.features)
        self.decoder = make_decoder(config.decoder, config.features, config.decoder_hidden)
        self._recorded = Recorded()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def encode(self, images: Tensor, cameras: Cameras, side: int | None = SIDE) -> list[EncodedView]:
        """Everything that voxels look up in pictures.

        A viewing direction is the same for a pixel and for every voxel behind it, so G is evaluated for the cells of the maps and not
        for each voxel and view.

        Args:
            images: (V, 3, H, W) RGB in [0, 1], undistorted; of one size.
            cameras: V cameras for exactly these pictures.
            side: pixels of the long side at which they are compared; None: they are not (their sweep is made elsewhere).
        """
        given = images, cameras.intrinsics, cameras.size, cameras.world_from_camera
        if self._repeats(images):
            features, colours, described = self._recorded(partial(self._shown, side=side), (side, self._state()), *given)
        else:
            features, colours, described = self._shown(*given, side=side)
        height, width = (length + -length % DEEPEST for length in images.shape[2:])
        sizes, fine = sizes_of(height // STRIDE, width // STRIDE, LEVELS), sizes_of(height, width, COLOUR_LEVELS)
        return [
            EncodedView(Pyramid(feature, sizes, STRIDE), Pyramid(colour, fine, 1), of)
            for feature, colour, of in zip(features, colours, described, strict=True)
        ]

    def _shown(self, images: Tensor, intrinsics: Tensor, size: Tensor, poses: Tensor, side: int | None) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of `encode`'s pyramids (V, R, C) and (V, R', 3), and what pictures are compared by (V, …)."""
        cameras = Cameras(intrinsics, size, poses)
        maps = self.sample(*self.encoder.maps(images)).float()  # variances are looked for in them
        whole = padded((images - 0.5) * COLOUR_GAIN)
        described = images.new_zeros((len(images), 0, 0, 0)) if side is None else describe(images, side)
        features, colours = levelled(maps, LEVELS), levelled(whole, COLOUR_LEVELS)
        if self.direction is not None:
            pixels = middles(sizes_of(maps.shape[2], maps.shape[3], LEVELS), STRIDE, features.device, features.dtype)
            codes = self.direction(torch.stack([cameras.directions(index, pixels) for index in range(len(images))]))
            features = torch.cat([features, codes.to(features.dtype)], 2)
        return features.contiguous(), colours.contiguous(), described

    def _repeats(self, images: Tensor) -> bool:
        """Whether encoding such pictures is worth recording: hundreds of launches, of which the processor makes one that way."""
        free = not torch.is_grad_enabled() and not torch.is_autocast_enabled(images.device.type)
        return free and images.is_cuda and images.numel() <= RECORDED

    def _state(self) -> tuple[int, ...]:
        """Where parameters of encoding lie, which recordings read there; all are moved together."""
        return tuple(next(part.parameters()).data_ptr() for part in (self.encoder, self.sample, self.direction) if part is not None)

    def sweep(
        self,
        views: Sequence[EncodedView],
        cameras: Cameras,
        near: float,
        far: float,
        depth: Tensor | None = None,
        empty: Empty | None = None,
    ) -> Sweep:
        """Where along the pixels of the key frame (first) the surface is likely to be, its measured `depth` (H, W) and what is known to be
        `empty` included; asked once for all lattices. Not differentiable."""
        return sweep([view.described for view in views], cameras, near, far, depth, empty)

    def local_volume(
        self,
        views: Sequence[EncodedView],
        cameras: Cameras,
        lattice: Lattice,
        topology: Topology | None = None,
        wanted: Tensor | None = None,
        near: float = 0.0,
        far: float = math.inf,
        swept: Sweep | None = None,
    ) -> LocalVolume:
        """The local volume of a key frame and its neighbours (section 3.1). Any number of views ≥ 1, the neighbours in any order.

        Args:
            views, cameras: K of each.
            topology: blocks to work on; None: every block that a view can see.
            wanted: (M · 512,) bool, corners of these blocks to work on; None: all.
            near, far: depths along z within which views are asked, working units.
            swept: `sweep` of these views; None: made here.

        Returns:
            a volume of those of the blocks in which the key frame sees a corner.
        """
        if topology is None:
            keys = all_blocks(lattice, cameras.intrinsics.device)
            keys = keys[visible_blocks(*block_balls(lattice, keys), cameras[0], near, far)]
            topology = Topology(keys, bounds=lattice.bounds(keys.device))
        if swept is None:
            bounded = near > 0 or math.isfinite(far)
            swept = self.sweep(views, cameras, *((near, far) if bounded else _depths(lattice, topology, cameras)))
        if self._on_device(views, swept):
            from fieldfuse.networks.gpu.local import local_volume

            numbers = TRUNCATION, HIDDEN, BLIND, COLOUR_GAIN, COLOURED, FREE
            sizes = self.config.sampled, self.config.variance, self.config.channels
            return local_volume(self.local, views, cameras, lattice, topology, wanted, near, far, swept, numbers, sizes)
        where, projected, starts, counts, weights = self._seen(views, cameras, lattice, topology, wanted, near, far, swept)
        topology, where = _without_empty_blocks(topology, where)
        config, size = self.config, topology.zero_row
        count = torch.zeros(size, device=topology.device).index_copy(0, where, counts)
        weight = torch.zeros(size, device=topology.device).index_copy(0, where, weights)
        start = starts.new_zeros((size + 1, config.channels)).index_copy(0, where, F.pad(starts, (0, config.channels - starts.shape[1])))
        # Convolutions cost most, and free space needs none.
        active = torch.zeros(topology.blocks + 1, dtype=torch.bool, device=topology.device)
        slots = where.div(VOXELS, rounding_mode="floor")
        busy_rows = starts[:, INSIDE] > _latent_of(FREE)
        # One more block takes those that are free: to choose the others would be to wait for the device.
        active = active.index_fill(0, torch.where(busy_rows, slots, topology.blocks), True)[:-1]
        latent = projected.new_zeros((size + 1, config.hidden)).index_copy(0, where, projected)
        busy, among, place = _blocks(topology, active)
        raw = start.index_copy(0, place, self.local(latent[place], start[place], busy, count[place[:-1]] > 0))
        return LocalVolume(lattice, topology, torch.tanh(raw), count, raw, weight, busy, among)

    def _on_device(self, views: Sequence[EncodedView], swept: Sweep) -> bool:
        """Whether kernels on CUDA make local volumes."""
        wide = self.config.hidden in (16, 32) and self.config.channels > INSIDE
        return not torch.is_grad_enabled() and wide and dispatch.can_use_triton(swept.table, *(view.features.rows for view in views))

    def _seen(
        self,
        views: Sequence[EncodedView],
        cameras: Cameras,
        lattice: Lattice,
        topology: Topology,
        wanted: Tensor | None,
        near: float,
        far: float,
        swept: Sweep,
    ) -> tuple[Tensor, ...]:
        """`_observe` of all corners that are `wanted`, None: of all."""
        rows = torch.arange(topology.zero_row, device=topology.device) if wanted is None else wanted.nonzero().view(-1)
        few = CHUNK if is_cpu(rows.device) else AT_ONCE
        parts = [self._observe(views, cameras, lattice, topology, part, near, far, swept) for part in rows.split(few)]
        return tuple(torch.cat(values) for values in zip(*parts, strict=True))

    def _observe(
        self,
        views: Sequence[EncodedView],
        cameras: Cameras,
        lattice: Lattice,
        topology: Topology,
        rows: Tensor,
        near: float,
        far: float,
        swept: Sweep,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Of the corners `rows`: those that the key frame sees, their evidence projected to few channels, what latents start from (mean
        colour, distance behind the surface), view count and weight."""
        contracted = lattice.contracted(topology.keys, rows)
        points, size = lattice.working(contracted)
        projection = project(points, size, cameras, near, far)
        seen = projection.visible[0]
        if lattice.space.shell == 0:
            x, y, z = contracted.abs().unbind(1)
            across, along, up = (side + 1.01 * lattice.voxel for side in lattice.space.box)
            seen = seen & (x <= across) & (y <= along) & (z <= up)
        sighted = swept.look(points, TRUNCATION * size)
        kept = (seen & (sighted.open > HIDDEN)).nonzero().view(-1)
        rows, points, projection, sighted = rows[kept], points[kept], projection[kept], sighted[kept]
        visible = projection.visible
        footprint = torch.exp((torch.log(projection.footprint) * visible).sum(0) / visible.sum(0).clamp_min(1))
        step = footprint * direction_spread(points, cameras.positions, visible)
        mean, variance, count = aggregate(look_up(views, projection, step), visible, self.config.variance)
        cues = agreement(variance, count, (slice(self.config.sampled), slice(-2 * COLOURS, -COLOURS)))
        swept_cues = torch.stack([sighted.signed, sighted.open, sighted.sure], 1)
        projected = torch.relu(self.local.project(torch.cat([evidence(mean, variance, count, footprint, step), cues, swept_cues], 1)))
        colour = colour_latent((mean[:, -COLOURS:] / COLOUR_GAIN + 0.5).clamp(0, 1))
        start = torch.cat([colour, inside_latent(sighted.signed)[:, None]], 1)
        return rows, projected, start, count.to(torch.float32), _weight(sighted)

    def start(self, lattice: Lattice) -> LatentVolume:
        """The global volume before the first key frame."""
        return empty_volume(lattice, self.config.channels, self.device)

    def fuse(self, state: LatentVolume, local: LocalVolume) -> LatentVolume:
        """The global volume after one more key frame (section 3.2). Only voxels of the local volume change, all others keep every bit.

        Blocks keep their slots; new ones come after them.
        """
        state, slots = with_blocks(state, local.topology.keys)
        place = (slots[:, None] * VOXELS + torch.arange(VOXELS, device=slots.device)).view(-1)
        zero = state.rows.new_zeros((1, state.rows.shape[1]))
        part = replace(state, topology=local.topology, rows=torch.cat([state.rows[place], zero]), count=state.count[place])
        after = self.fuse_part(part, local)
        changed = local.known.nonzero().view(-1)
        rows = state.rows.index_copy(0, place[changed], after.rows[changed].to(state.rows.dtype))
        return replace(state, rows=rows, count=state.count.index_copy(0, place[changed], after.count[changed]))

    def fuse_part(self, part: LatentVolume, local: LocalVolume) -> LatentVolume:
        """One step of the recurrence on the blocks of a local volume alone: `part` is the global volume there."""
        known = part.rows, part.count, local.rows, local.raw
        if isinstance(self.fusion, FusionGRU) and not torch.is_grad_enabled() and (fits(*known) or dispatch.can_use_triton(*known)):
            rows, count = self.fusion.compiled(part, local)
            return replace(part, rows=rows, count=count)
        inside = local.known
        count = part.count * inside
        mask = torch.cat([count > 0, inside.new_zeros(1)])[:, None]
        before = part.rows * mask
        z = mean_gate(count, local.weight)
        rows = torch.lerp(before, local.rows, z)
        busy, place, inner = local.busy, local.place, local.place[:-1]
        after = self.fusion(before[place], count[inner], local.rows[place], local.raw[place], local.weight[inner], busy, inside[inner])
        return replace(part, rows=rows.index_copy(0, place, after), count=count + local.weight)

    def surface_cells(self, volume: LatentVolume, seen: Tensor, gamma: float) -> Tensor:
        """`refine.surface_cells` of what the head says."""
        if not torch.is_grad_enabled() and self.config.channels > INSIDE and dispatch.can_use_triton(volume.rows):
            from fieldfuse.networks.gpu import volumes

            return volumes.surface_cells(volume.topology, volume.rows, volume.count, seen, self.to_field, least_thickness(gamma))
        return surface_cells(volume, seen, self.thickness(volume), gamma)

    def thickness(self, volume: LatentVolume) -> Tensor:
        """(M · 512 + 1,) the first of what `head` gives, alone."""
        if not is_cpu(volume.rows.device):
            mask = torch.cat([volume.known, volume.known.new_zeros(1)])
            return torch.where(mask, self.to_field.thickness(volume.rows).float(), 0.0)
        known = volume.known.nonzero().view(-1)
        values = self.to_field.thickness(volume.rows[known]).float()
        return torch.zeros(len(volume.rows), device=known.device).index_copy(0, known, values)

    def head(self, volume: LatentVolume) -> tuple[Tensor, Tensor]:
        """What the radiance field stores.

        Returns:
            (M · 512 + 1,) logarithm of the optical thickness of a voxel, and (M · 512 + 1, features); zero at corners that are not known.
        """
        known = volume.known.nonzero().view(-1)
        thickness, features = self.to_field(volume.rows[known])
        size = len(volume.rows)
        return (
            torch.zeros(size, device=known.device).index_copy(0, known, thickness.float()),
            torch.zeros((size, features.shape[1]), device=known.device).index_copy(0, known, features.float()),
        )


@lru_cache(maxsize=4)
def _latent_of(signed: float) -> float:
    """`inside_latent` of one number."""
    return float(inside_latent(torch.tensor([signed])))


def _weight(sighted: Sighted) -> Tensor:
    """How much a key frame can say of voxels: little of what is hidden, and where the pictures fit at no depth better than at others."""
    return sighted.open.clamp_min(HIDDEN) * (BLIND + (1 - BLIND) * sighted.sure)


def _depths(lattice: Lattice, topology: Topology, cameras: Cameras) -> tuple[float, float]:
    """Where the blocks begin (0: at the camera) and end along the key frame's axis."""
    if topology.blocks == 0:
        return 1.0, 2.0
    centres, radii = block_balls(lattice, topology.keys)
    depth = cameras[0].local(centres)[0, :, 2]
    return max(float((depth - radii).amin()), 0.0), max(float((depth + radii).amax()), 1e-6)


def _blocks(topology: Topology, kept: Tensor) -> tuple[Topology, Tensor, Tensor]:
    """The blocks of the mask (M,) alone, their slots, and their rows, the zero row last (the same way back)."""
    blocks = kept.nonzero().view(-1)
    return topology.alike(topology.keys[blocks]), blocks, rows_of(blocks, topology.zero_row)


def _without_empty_blocks(topology: Topology, rows: Tensor) -> tuple[Topology, Tensor]:
    """The blocks that own at least one of the rows, in their order, and the same rows in them."""
    slot = rows.div(VOXELS, rounding_mode="floor")
    filled = torch.zeros(topology.blocks, dtype=torch.bool, device=rows.device).index_fill(0, slot, True)
    kept = filled.nonzero().view(-1)
    if len(kept) == topology.blocks:
        return topology, rows
    return topology.alike(topology.keys[kept]), rows + ((torch.cumsum(filled, 0) - 1)[slot] - slot) * VOXELS
