"""One training step: stage 1 learns local volumes alone; stage 2 fuses key frames and learns from local and global volumes at every one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.matching import SIDE
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, sweep_planes
from fieldfuse.nerfusion.extras.two_lattices import allowed_cells, surface_cells
from fieldfuse.nerfusion.fusion import fuse_key_frame
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume, cells
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.store import ValueStore
from fieldfuse.nerfusion.training.rendering import (
    annealed,
    background_of,
    feature_deviation,
    in_sight,
    random_rays,
    rendering_health,
    rendering_loss,
    trace,
)
from fieldfuse.nerfusion.training.samples import Sample, keyframe_distributions
from fieldfuse.nerfusion.training.settings import TrainSettings
from fieldfuse.nerfusion.unproject import EncodedView, KeyFrame
from fieldfuse.render.field import Field
from fieldfuse.render.fused import GAMMA, make_field

LOCAL, FUSED = "local", "fused"


@dataclass
class Outcome:
    """What a step measured; gradients are in the parameters."""

    loss: float = 0.0
    numbers: dict[str, list[Tensor]] = field(default_factory=dict)

    def note(self, values: Mapping[str, Tensor]) -> None:
        """Add one value of some numbers."""
        for name, value in values.items():
            self.numbers.setdefault(name, []).append(value.detach().double())

    def means(self) -> dict[str, float]:
        """Each number's mean over where it is one, read from the device all at once."""
        if not self.numbers:
            return {}
        means = torch.stack([torch.stack(values).nanmean() for values in self.numbers.values()]).tolist()
        return {name: mean for name, mean in zip(self.numbers, means, strict=True) if not math.isnan(mean)}


class Recurrence:
    """The loop over a sample's key frames, with global volumes as ordinary values through which gradients flow.

    What is taken over from a coarser level is not differentiated: each level has its own loss.

    Args:
        levels: lattices, each of half the voxel size of the one before; the sample's own first.
        gamma: coarse cells in which exp(−optical thickness) exceeds this are not looked at finer.
        most: coarse cells that are split a key frame at most; when more are solid, the thickest ones are.

    Attributes:
        volumes: the global volumes so far, coarsest first.
    """

    def __init__(self, model: NerfusionModel, sample: Sample, levels: int, gamma: float = 0.95, most: int = 6000) -> None:
        self.model, self.near, self.far, self.gamma, self.most = model, sample.near, sample.far, gamma, most
        lattice = Lattice(sample.space, sample.resolution)
        self.volumes: list[LatentVolume] = []
        for _ in range(levels):
            self.volumes.append(model.start(lattice))
            lattice = lattice.finer()

    def add(self, views: Sequence[EncodedView], cameras: Cameras, distribution: DepthDistribution | None = None) -> LocalVolume:
        """Fuse one more key frame; answers its local volume on the coarsest lattice. `distribution`: of its depth; None: made here."""
        if distribution is None:
            distribution = sweep_planes([view.descriptors for view in views], cameras, self.near, self.far)
        stores = [ValueStore(volume) for volume in self.volumes]
        local = fuse_key_frame(self.model, KeyFrame(views, cameras, self.near, self.far, distribution), stores, None, self._finer_cells)
        self.volumes = [store.volume() for store in stores]
        return local

    @torch.no_grad()
    def _finer_cells(self, part: LatentVolume, seen: Tensor) -> Tensor:
        """(M · 512,) bool, cells that are looked at finer."""
        thickness = self.model.thickness(part)
        kept = surface_cells(part, seen, thickness, self.gamma)
        if int(kept.sum()) > self.most:
            # A cell is as thick as its thickest corner; the threshold that leaves `most` of them is that quantile of its values.
            values = torch.where(part.known, thickness[:-1], torch.full_like(thickness[:-1], -torch.inf))
            level = torch.topk(values, min(self.most // 4, len(values))).values[-1]
            kept &= cells(part.topology, part.known & (values >= level), every=False)
        return kept

    @torch.no_grad()
    def allowed(self, level: int) -> Tensor | None:
        """(M · 512,) bool, cells of a level's volume whose coarser ones are not see-through; None: all (the coarsest level)."""
        if level == 0:
            return None
        coarse = self.volumes[level - 1]
        return allowed_cells(coarse, self.model.thickness(coarse), self.gamma, self.volumes[level].topology)

    def detach(self) -> None:
        """Cut the volumes off from the graph (truncated back-propagation)."""
        self.volumes = [volume.detached() for volume in self.volumes]


class Stepper:
    """Computes the gradients of steps."""

    def __init__(self, model: NerfusionModel, settings: TrainSettings) -> None:
        self.model, self.settings = model, settings
        self.watched = True  # whether what costs extra is measured in this step

    def depth_weight(self, step: int) -> float:
        """Weight of the auxiliary depth loss at a step."""
        return annealed(self.settings.loss.depth, step, self.settings.loss.depth_steps)

    def prunes(self, step: int) -> bool:
        """Whether the fused volume is pruned at a step: only in the later part of stage 2."""
        stage = self.settings.stage
        return step >= stage.steps + stage.prune_from * stage.fused_steps

    def stage_one(self, sample: Sample, step: int, generator: torch.Generator) -> Outcome:
        """Local loss of one key frame. Leaves gradients in the parameters."""
        loss = StepLoss(self, sample, step, generator)
        volume = local_of(self.model, sample, 0)
        if self.watched:
            loss.watch_encoder()
        total = loss(volume, sample.targets[0], sample.references[0], self.settings.loss.rays, LOCAL)
        total.backward()
        loss.outcome.loss = float(total.detach())
        return loss.outcome

    def stage_two(self, sample: Sample, step: int, generator: torch.Generator) -> Outcome:
        """Local and global loss at every key frame; the gradient through the state is cut every `stage.truncate` key frames."""
        model, stage, weights, frames = self.model, self.settings.stage, self.settings.loss, len(sample.references)
        loss, rays = StepLoss(self, sample, step, generator), max(1, weights.rays // ((1 + stage.levels) * frames))
        state = Recurrence(model, sample, stage.levels, stage.gamma, stage.most_split)
        distributions = keyframe_distributions(sample) if stage.witnesses else [None] * frames
        targets = sample.targets.cpu()  # where pixels are drawn
        pending: list[Tensor] = []
        if self.watched:
            loss.watch_encoder()
        for frame in range(frames):
            indices = sample.references[frame]
            cameras = sample.pictures.cameras(indices)
            views = model.encode(sample.pictures.images[indices], cameras, None if stage.witnesses else SIDE)
            local = state.add(views, cameras, distributions[frame])
            pending.append(weights.local / frames * loss(local, targets[frame], indices, rays, LOCAL))
            # The global volumes answer for every place they have seen, not only for the newest.
            seen, references = targets[: frame + 1], sample.references[: frame + 1]
            for level, volume in enumerate(state.volumes):
                name = FUSED if level == 0 else f"{FUSED}_{level}"
                pending.append(weights.fused / frames * loss(volume, seen, references, rays, name, state.allowed(level)))
            if (frame + 1) % stage.truncate == 0 or frame + 1 == frames:
                total = torch.stack(pending).sum()
                total.backward()
                loss.outcome.loss += float(total.detach())
                pending.clear()
                state.detach()
        return loss.outcome


class StepLoss:
    """Losses of the volumes of one step; what they are made of gathers in `outcome`."""

    def __init__(self, stepper: Stepper, sample: Sample, step: int, generator: torch.Generator) -> None:
        self.stepper, self.sample, self.step, self.generator, self.outcome = stepper, sample, step, generator, Outcome()

    def watch_encoder(self) -> None:
        """Note how much the encoder's features of the first key frame vary over the image: it costs one more pass."""
        with torch.no_grad():
            features = self.stepper.model.encoder(self.sample.pictures.images[self.sample.references[0, :1]])
        self.outcome.note({"feature_deviation": feature_deviation(features)})

    def __call__(
        self, volume: LatentVolume, targets: Tensor, references: Tensor, count: int, name: str, allowed: Tensor | None = None
    ) -> Tensor:
        """Loss of a volume on `count` random rays of the images at `targets`, as far as one of `references` shows their end."""
        stepper, pictures = self.stepper, self.sample.pictures
        rays = random_rays(pictures, targets, count, self.generator)
        kept = in_sight(rays, pictures, references).nonzero().view(-1)
        if len(kept):
            rays = rays[kept]
        background = background_of(pictures, len(rays), self.generator)
        prune = name != LOCAL and stepper.prunes(self.step)
        traced = trace(volume_field(stepper.model, volume, background, self.sample, prune, allowed), rays, background, self.generator)
        weights = stepper.settings.loss.opacity, stepper.depth_weight(self.step)
        parts = rendering_loss(traced, rays, *weights, volume.lattice.voxel_size)
        health = rendering_health(traced, rays)
        self.outcome.note({f"psnr_{name}": health.pop("psnr"), **health, "loss_depth": parts.depth})
        return parts.total


def volume_field(
    model: NerfusionModel, volume: LatentVolume, background: Tensor, sample: Sample, prune: bool, allowed: Tensor | None
) -> Field:
    """The field of a local or global volume, over `background` (3,) or (R, 3)."""
    one = background if background.ndim == 1 else background[0]
    return make_field(model, volume, one, gamma=GAMMA if prune else None, near=0.5 * sample.near, allowed=allowed)


def local_of(model: NerfusionModel, sample: Sample, frame: int) -> LocalVolume:
    """The local volume of key frame `frame` of a sample."""
    indices = sample.references[frame]
    cameras = sample.pictures.cameras(indices)
    views = model.encode(sample.pictures.images[indices], cameras)
    return model.local_volume(KeyFrame(views, cameras, sample.near, sample.far), Lattice(sample.space, sample.resolution))


def seeded(seed: int, rank: int, step: int) -> torch.Generator:
    """The generator of one step's random pixels, the same whenever that step is taken."""
    # A mixture of the three that keeps neighbouring steps apart; 64 bits are what a generator takes.
    mixed = (seed * 0x9E3779B97F4A7C15 + rank * 0xC2B2AE3D27D4EB4F + step * 0x165667B19E3779F9) % 2**63
    return torch.Generator().manual_seed(mixed)
