"""One training step: stage 1 learns local volumes alone; stage 2 fuses key frames and learns from local and global volumes at every one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.nerfusion.extras.matching import SIDE
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume
from fieldfuse.nerfusion.losses import Traced, annealed, rendering_loss
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.health import feature_deviation, rendering_health
from fieldfuse.nerfusion.training.rays import TargetRays, in_sight, random_rays
from fieldfuse.nerfusion.training.recurrence import Recurrence
from fieldfuse.nerfusion.training.samples import Pictures, Sample, cameras_of, keyframe_distributions
from fieldfuse.nerfusion.training.settings import TrainSettings
from fieldfuse.nerfusion.training.tracing import trace
from fieldfuse.render.fused import GAMMA, make_field

Tensor = torch.Tensor
LOCAL, FUSED = "local", "fused"


@dataclass
class Outcome:
    """What a step measured; gradients are in the parameters."""

    loss: float = 0.0
    numbers: dict[str, list[Tensor]] = field(default_factory=dict)

    def note(self, values: Mapping[str, Tensor]) -> None:
        for name, value in values.items():
            self.numbers.setdefault(name, []).append(value)

    def means(self) -> dict[str, float]:
        """Each number's mean over where it is one, asked of the device all at once."""
        noted = [value.detach().double() for values in self.numbers.values() for value in values]
        if not noted:
            return {}
        answers = iter(torch.stack(noted).tolist())
        out = {}
        for name, values in self.numbers.items():
            known = [answer for answer in (next(answers) for _ in values) if not math.isnan(answer)]
            if known:
                out[name] = sum(known) / len(known)
        return out


def background_of(pictures: Pictures, count: int, generator: torch.Generator | None) -> Tensor:
    """(3,) or (count, 3) colour behind everything.

    Where every ray meets something it is random for each ray, so that nothing cannot stand in for a surface; grey without a generator.
    """
    device = pictures.images.device
    if pictures.background is not None:
        return torch.tensor(pictures.background, device=device)
    if generator is None:
        return torch.full((3,), 0.5, device=device)
    return to_device_async(torch.rand(count, 3, generator=generator).numpy(), device)


def local_of(model: NerfusionModel, sample: Sample, frame: int, log: Outcome | None = None) -> LocalVolume:
    """The local volume of key frame `frame` of a sample."""
    indices = sample.references[frame]
    cameras = cameras_of(sample.pictures, indices)
    views = model.encode(sample.pictures.images[indices], cameras)
    if log is not None:
        log.note({"feature_deviation": encoder_deviation(model, sample.pictures.images[indices[:1]])})
    return model.local_volume(views, cameras, Lattice(sample.space, sample.resolution), near=sample.near, far=sample.far)


@torch.no_grad()
def encoder_deviation(model: NerfusionModel, images: Tensor) -> Tensor:
    """Spatial deviation of the encoder's features on these pictures."""
    return feature_deviation(model.encoder(images))


def render_volume(
    model: NerfusionModel,
    volume: LatentVolume,
    rays: TargetRays,
    behind: Tensor,
    near: float,
    generator: torch.Generator | None,
    prune: bool,
    allowed: Tensor | None = None,
) -> Traced:
    """Render a local or global volume along rays, with gradients where they are enabled."""
    made = make_field(model, volume, behind if behind.ndim == 1 else behind[0], gamma=GAMMA if prune else None, near=near, allowed=allowed)
    return trace(made, rays, behind, generator)


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

    def _loss(
        self,
        volume: LatentVolume,
        sample: Sample,
        targets: Tensor,
        references: Tensor,
        count: int,
        which: str,
        step: int,
        generator: torch.Generator,
        log: Outcome,
        allowed: Tensor | None = None,
    ) -> Tensor:
        rays = random_rays(sample.pictures, targets, count, generator)
        kept = in_sight(rays, sample.pictures, references).nonzero().view(-1)
        if len(kept):
            rays = rays[kept]
        behind = background_of(sample.pictures, len(rays), generator)
        prune = which != LOCAL and self.prunes(step)
        traced = render_volume(self.model, volume, rays, behind, 0.5 * sample.near, generator, prune, allowed)
        parts = rendering_loss(traced, rays, self.settings.loss.opacity, self.depth_weight(step), volume.lattice.voxel_size)
        health = rendering_health(traced, rays)
        log.note({f"psnr_{which}": health.pop("psnr")})
        log.note(health | {"loss_depth": parts.depth.detach()})
        return parts.total

    def stage_one(self, sample: Sample, step: int, generator: torch.Generator) -> Outcome:
        """Local loss of one key frame. Leaves gradients in the parameters."""
        log = Outcome()
        volume = local_of(self.model, sample, 0, log if self.watched else None)
        loss = self._loss(volume, sample, sample.targets[0], sample.references[0], self.settings.loss.rays, LOCAL, step, generator, log)
        loss.backward()
        log.loss = float(loss.detach())
        return log

    def stage_two(self, sample: Sample, step: int, generator: torch.Generator) -> Outcome:
        """Local and global loss at every key frame; the gradient through the state is cut every `stage.truncate` key frames."""
        log, settings, model = Outcome(), self.settings, self.model
        stage, weights, frames = settings.stage, settings.loss, len(sample.references)
        rays = max(1, weights.rays // ((1 + stage.levels) * frames))
        state = begin(model, sample, stage.levels, stage.gamma, stage.most_split)
        sweeps = keyframe_distributions(sample) if stage.witnesses else None
        targets = sample.targets.cpu()  # where pixels are drawn
        pending: list[Tensor] = []
        for frame in range(frames):
            indices = sample.references[frame]
            cameras = cameras_of(sample.pictures, indices)
            views = model.encode(sample.pictures.images[indices], cameras, SIDE if sweeps is None else None)
            if self.watched and frame == 0:
                log.note({"feature_deviation": encoder_deviation(model, sample.pictures.images[indices[:1]])})
            state, local = state.add(model, views, cameras, None if sweeps is None else sweeps[frame])
            pending.append(weights.local / frames * self._loss(local, sample, targets[frame], indices, rays, LOCAL, step, generator, log))
            # The global volumes answer for every place they have seen, not only for the newest.
            seen = targets[: frame + 1]
            for level, volume in enumerate(state.volumes):
                name = FUSED if level == 0 else f"{FUSED}_{level}"
                allowed = state.allowed(model, level)
                loss = self._loss(volume, sample, seen, sample.references[: frame + 1], rays, name, step, generator, log, allowed)
                pending.append(weights.fused / frames * loss)
            if (frame + 1) % stage.truncate == 0 or frame + 1 == frames:
                total = torch.stack(pending).sum()
                total.backward()
                log.loss += float(total.detach())
                pending, state = [], state.detached()
        return log


def begin(model: NerfusionModel, sample: Sample, levels: int, gamma: float = 0.95, most: int = 6000) -> Recurrence:
    """The recurrence before a sample's first key frame."""
    return Recurrence.start(model, Lattice(sample.space, sample.resolution), levels, sample.near, sample.far, gamma, most)


def seeded(seed: int, rank: int, step: int) -> torch.Generator:
    """The generator of one step's random pixels, the same whenever that step is taken."""
    # A mixture of the three that keeps neighbouring steps apart; 64 bits are what a generator takes.
    mixed = (seed * 0x9E3779B97F4A7C15 + rank * 0xC2B2AE3D27D4EB4F + step * 0x165667B19E3779F9) % 2**63
    return torch.Generator().manual_seed(mixed)
