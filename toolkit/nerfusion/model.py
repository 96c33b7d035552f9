"""NeRFusion's networks in the paper's order (Zhang et al., CVPR 2022, section 3), in plain torch.

    views  = model.encode(images, cameras)                         # F_i = CNN(I_i) and G(d): once an image
    frame  = KeyFrame(views[:K], cameras[:K])                      # a key frame and its neighbours
    local  = model.local_volume(frame, lattice)                    # V = J([mean U_i, var U_i]), U_i = [F_i(u_i), G(d_i)]: eq. 1 and 2
    state  = model.fuse(state, local)                              # H' = GRU(H, V): eq. 3; before the first, `model.start(lattice)`
    values = model.head(state)                                     # R, eq. 5: density and features, of a global or a local volume …
    model.decoder                                                  # … and colour from them

No method changes anything: gradients flow through all of them, and a state is an ordinary value. `render/fused.py` turns a volume into a
field that can be rendered, `fusion.py` is the loop over key frames. What is not in the paper says so, and lies in `extras/`. Where nothing
is learned kernels do the same steps faster: in `local_volume`, `fuse_part`, `surface_cells` and what these call.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fieldfuse.backends import dispatch
from fieldfuse.backends.constants import INSIDE
from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.nerfusion.aggregate import CUES, FLAGS, aggregate, agreement, evidence
from fieldfuse.nerfusion.cameras import Cameras, depth_range, frustum
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.nerfusion.encoder import DEEPEST, STRIDE, DirectionCode, ImageEncoder, Sampled, padded
from fieldfuse.nerfusion.extras import known_terms
from fieldfuse.nerfusion.extras.matching import SIDE, patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import sweep_planes
from fieldfuse.nerfusion.extras.two_lattices import least_thickness, surface_cells
from fieldfuse.nerfusion.gru import FusionGRU, RunningMean, mean_gate
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, empty_volume, some_blocks, without_empty_blocks
from fieldfuse.nerfusion.recorded import Recorded, addresses, worth_recording
from fieldfuse.nerfusion.store import ValueStore
from fieldfuse.nerfusion.unproject import (
    COLOURED,
    EncodedView,
    KeyFrame,
    Pyramid,
    look_up,
    project,
    pyramid_pixels,
    pyramid_rows,
    pyramid_sizes,
    scales,
)
from fieldfuse.nerfusion.volume_net import FieldHead, LocalReconstruction
from fieldfuse.volume.topology import Topology

CHUNK = 2**15  # voxels at a time: what the views show of them is many times larger than what is cached
AT_ONCE = 2**19  # where there is memory for that: 0.4 kB a voxel and view
COLOURS = 3
COLOUR_GAIN = 4.0  # images' RGB as numbers of about unit deviation
LEVELS = 3  # of the feature maps
COLOUR_LEVELS = 5
ESTIMATES = 3  # numbers that the plane sweep gives a voxel


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
    """CNN, G, J, GRU and R. Shapes: V images; K views of a key frame; N voxels; M blocks of 512 voxels; C channels."""

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or ModelConfig()
        self.encoder = ImageEncoder(config.image_channels, config.encoder)
        self.sample = Sampled(config.image_channels, self.encoder.widths[0], config.sampled)
        self.direction = DirectionCode(config.direction) if config.direction else None
        inputs = 3 * (config.sampled + config.direction + 2 * COLOURS) + FLAGS + CUES + ESTIMATES
        self.local = LocalReconstruction(inputs, config.hidden, config.channels)
        self.fusion: FusionGRU | RunningMean = FusionGRU(config.channels, config.gru_hidden) if config.fusion == "gru" else RunningMean()
        self.to_field = FieldHead(config.channels, config.head_hidden, config.features)
        self.decoder = make_decoder(config.decoder, config.features, config.decoder_hidden)
        self._recorded = Recorded()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    # Encode -----------------------------------------------------------------------------------------------------------------------

    def encode(self, images: Tensor, cameras: Cameras, side: int | None = SIDE) -> list[EncodedView]:
        """F_i = CNN(I_i) and G(d), as pyramids that voxels look up.

        A viewing direction is the same for a pixel and for every voxel behind it, so G is evaluated for the cells of the maps and not
        for each voxel and view.

        Args:
            images: (V, 3, H, W) RGB in [0, 1], undistorted; of one size.
            cameras: V cameras for exactly these images.
            side: pixels of the long side at which the plane sweep compares them; None: it does not.
        """
        given, work = (images, cameras.intrinsics, cameras.size, cameras.world_from_camera), partial(self._maps, side=side)
        parts = (self.encoder, self.sample, self.direction)
        maps = self._recorded(work, (side, addresses(parts)), *given) if worth_recording(images) else work(*given)
        height, width = (length + -length % DEEPEST for length in images.shape[2:])
        sizes, fine = pyramid_sizes(height // STRIDE, width // STRIDE, LEVELS), pyramid_sizes(height, width, COLOUR_LEVELS)
        return [
            EncodedView(Pyramid(feature, sizes, STRIDE), Pyramid(colour, fine, 1), descriptors)
            for feature, colour, descriptors in zip(*maps, strict=True)
        ]

    def _maps(self, images: Tensor, intrinsics: Tensor, size: Tensor, poses: Tensor, side: int | None) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of `encode`'s pyramids, (V, R, C) features and codes and (V, R', 3) colours, and (V, 21, h, w) for the plane sweep."""
        cameras = Cameras(intrinsics, size, poses)
        maps = self.sample(*self.encoder.maps(images)).float()  # variances are computed of them
        features, colours = pyramid_rows(maps, LEVELS), pyramid_rows(padded((images - 0.5) * COLOUR_GAIN), COLOUR_LEVELS)
        if self.direction is not None:
            pixels = pyramid_pixels(pyramid_sizes(maps.shape[2], maps.shape[3], LEVELS), STRIDE, features.device, features.dtype)
            codes = self.direction(torch.stack([cameras.directions(index, pixels) for index in range(len(images))]))
            features = torch.cat([features, codes.to(features.dtype)], 2)
        descriptors = images.new_zeros((len(images), 0, 0, 0)) if side is None else patch_descriptors(images, side)
        return features.contiguous(), colours.contiguous(), descriptors

    # Unproject, mean and variance, J ----------------------------------------------------------------------------------------------

    def local_volume(
        self, frame: KeyFrame, lattice: Lattice, topology: Topology | None = None, wanted: Tensor | None = None
    ) -> LocalVolume:
        """V = J([mean U_i, var U_i]) of a key frame and its neighbours (section 3.1). Any number of views ≥ 1, the neighbours in any order.

        Args:
            topology: blocks to work on; None: every block in the key frame's frustum.
            wanted: (M · 512,) bool, corners of these blocks to work on; None: all.

        Returns:
            a volume of those of the blocks in which the key frame sees a corner.
        """
        if topology is None:
            topology = frustum(lattice, frame.cameras, frame.near, frame.far, self.device)
        if frame.distribution is None:
            bounded = frame.near > 0 or math.isfinite(frame.far)
            limits = (frame.near, frame.far) if bounded else depth_range(lattice, topology, frame.cameras)
            frame = replace(frame, distribution=sweep_planes([view.descriptors for view in frame.views], frame.cameras, *limits))
        assert frame.distribution is not None
        wide = self.config.hidden in (16, 32) and self.config.channels > INSIDE
        tables = [frame.distribution.table, *(view.features.rows for view in frame.views)]
        if not torch.is_grad_enabled() and wide and dispatch.can_use_triton(*tables):
            from fieldfuse.backends.triton import local_volume as kernels

            terms = known_terms.TRUNCATION, known_terms.HIDDEN, known_terms.BLIND, known_terms.FREE
            numbers = kernels.Numbers(*terms, COLOUR_GAIN, COLOURED, self.config.sampled, self.config.variance, self.config.channels)
            return LocalVolume(lattice, *kernels.local_volume(self.local, frame, lattice, topology, wanted, numbers))
        rows = torch.arange(topology.zero_row, device=topology.device) if wanted is None else wanted.nonzero().view(-1)
        chunks = rows.split(CHUNK if is_cpu(rows.device) else AT_ONCE)
        parts = [self._unproject(frame, lattice, topology, chunk) for chunk in chunks]
        indices, projected, starts, counts, weights = (torch.cat(values) for values in zip(*parts, strict=True))
        topology, indices = without_empty_blocks(topology, indices)
        size, channels = topology.zero_row, self.config.channels
        count = torch.zeros(size, device=topology.device).index_copy(0, indices, counts)
        weight = torch.zeros(size, device=topology.device).index_copy(0, indices, weights)
        start = starts.new_zeros((size + 1, channels)).index_copy(0, indices, F.pad(starts, (0, channels - starts.shape[1])))
        latent = projected.new_zeros((size + 1, self.config.hidden)).index_copy(0, indices, projected)
        near_surface, slots, place = some_blocks(topology, known_terms.blocks_near_surface(topology, indices, starts))
        raw = start.index_copy(0, place, self.local(latent[place], start[place], near_surface, count[place[:-1]] > 0))
        return LocalVolume(lattice, topology, torch.tanh(raw), count, raw, weight, near_surface, slots)

    def _unproject(self, frame: KeyFrame, lattice: Lattice, topology: Topology, rows: Tensor) -> tuple[Tensor, ...]:
        """Eq. 1 and the input of J in eq. 2, at the corners `rows` (N,) of the blocks.

        Returns:
            of the N' corners that the key frame sees: rows (N',), J's first layer (N', hidden), known terms (N', 4), number of views (N',)
            and weight (N',).
        """
        contracted = lattice.contracted(topology.keys, rows)
        points, size = lattice.working(contracted)  # v
        projection = project(points, size, frame.cameras, frame.near, frame.far)  # u_i
        assert frame.distribution is not None
        estimate = frame.distribution.look(points, known_terms.TRUNCATION * size)  # of the plane sweep (not in the paper)
        seen = projection.visible[0] & lattice.inside(contracted) & (estimate.visibility > known_terms.HIDDEN)
        kept = seen.nonzero().view(-1)
        rows, points, projection, estimate = rows[kept], points[kept], projection[kept], estimate[kept]
        footprint, step = scales(points, projection, frame.cameras)
        values = look_up(frame.views, projection, step)  # U_i(v) = [F_i(u_i), G(d_i)], and colours: (K, N', C)
        mean, variance, count = aggregate(values, projection.visible, self.config.variance)  # over the views i
        disagreement = agreement(variance, count, (slice(self.config.sampled), slice(-2 * COLOURS, -COLOURS)))
        inputs = [evidence(mean, variance, count, footprint, step), disagreement, estimate.stacked]
        projected = torch.relu(self.local.project(torch.cat(inputs, 1)))
        colour = (mean[:, -COLOURS:] / COLOUR_GAIN + 0.5).clamp(0, 1)
        start = known_terms.start(colour, estimate.expected_sdf)
        return rows, projected, start, count.to(torch.float32), known_terms.weight(estimate)

    # Fuse -------------------------------------------------------------------------------------------------------------------------

    def start(self, lattice: Lattice) -> LatentVolume:
        """The global volume before the first key frame."""
        return empty_volume(lattice, self.config.channels, self.device)

    def fuse(self, state: LatentVolume, local: LocalVolume) -> LatentVolume:
        """The global volume after one more key frame (section 3.2). Only voxels of the local volume change, all others keep every bit.

        Blocks keep their slots; new ones come after them.
        """
        store = ValueStore(state)
        store.write(self.fuse_part(store.part(local.topology), local), local.known)
        return store.volume()

    def fuse_part(self, part: LatentVolume, local: LocalVolume) -> LatentVolume:
        """One step of the recurrence on the blocks of a local volume alone: `part` is the global volume there."""
        if isinstance(self.fusion, FusionGRU) and not torch.is_grad_enabled():
            known = part.rows, part.count, local.rows, local.raw
            if dispatch.can_use_numba(*known) or dispatch.can_use_triton(*known):
                rows, count = self.fusion.compiled(part, local)
                return replace(part, rows=rows, count=count)
        count = part.count * local.known
        before = part.rows * F.pad(count > 0, (0, 1))[:, None]
        rows = torch.lerp(before, local.rows, mean_gate(count, local.weight))
        place, inner = local.place, local.place[:-1]
        near = local.near_surface, local.rows[place], local.count[inner], local.raw[place], local.weight[inner], local.near_surface
        state = LatentVolume(local.lattice, local.near_surface, before[place], count[inner])
        after = self.fusion(state, LocalVolume(local.lattice, *near, local.slots))
        return replace(part, rows=rows.index_copy(0, place, after), count=count + local.weight)

    # R ----------------------------------------------------------------------------------------------------------------------------

    def surface_cells(self, volume: LatentVolume, seen: Tensor, gamma: float) -> Tensor:
        """`two_lattices.surface_cells` of the head's thickness."""
        if not torch.is_grad_enabled() and self.config.channels > INSIDE and dispatch.can_use_triton(volume.rows):
            from fieldfuse.backends.triton import volumes

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
