"""Colours of a field whose shape is known, looked up again in the images: one back-projection of what its own images lack.

A voxel of a fused volume has the mean of what key frames showed at its corner. Corners lie up to a voxel before or behind the surface,
where images from different sides show different things of it, so the mean is blurred by more than the voxel. Once the shape is there,
every pixel's light is known to come from the samples of its ray, each by its weight; hidden ones get nothing of it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, Protocol

import cv2
import numpy as np
import torch

from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.camera import Intrinsics, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.composite import SOLID, STOP, THRESHOLD, ray_sum
from fieldfuse.render.field import Field
from fieldfuse.render.rays import render_with_gradients
from fieldfuse.threads import share
from fieldfuse.volume.lookup import corners, scatter

Tensor = torch.Tensor
COLOURS = 3  # the first features are logits of the colour
CHUNK = 2048  # rays at a time, in torch: what they meet then stays in the processor's cache …
AT_ONCE = 16384  # … and on a device of its own, where it takes hundreds of launches whatever their number: 0.2 GB
PER_VOXEL = 1.2  # rays along a voxel's side: 1.7 give 0.1 dB more for twice the time
MOST_RAYS = 2_000_000  # images are skipped evenly until there are no more …
MOST_WITHIN = 4_000_000  # … with alpha of those that show something: every side of an object is seen by few of them
STEEPEST = 0.05  # least slope of colour over logit that is divided by
MOST = 2.0  # logits that a ray may ask for
VALID = 0.99
BESIDE = 4  # pixels beside what an image shows within which its background's colour counts, about three voxels


class Recoloured(NamedTuple):
    """A field with other colours, and what the rays met on the way.

    Attributes:
        field: shares everything but its features with the one that was given.
        seen: (M · 512,) largest weight T·α with which a ray saw each voxel; 1 for the strongest of a ray that ends somewhere.
    """

    field: Field
    seen: Tensor


class _Engine(Protocol):
    """Adds up what rays ask for."""

    def add(self, origins: Tensor, directions: Tensor, colours: Tensor) -> None:
        """(B, 3) each, on the CPU."""
        ...

    def sums(self) -> tuple[Tensor, Tensor]:
        """(M · 512 + 1, 4) Σ a (c − ĉ) / ĉ' and Σ a, and `seen`."""
        ...


@torch.no_grad()
def recoloured(
    field: Field,
    views: Views,
    depth: float,
    progress: Progress = SILENT,
    engine: str = "auto",
    relaxation: float = 1.0,
    in_place: bool = False,
) -> Recoloured:
    """A field like `field` whose colours were looked up again.

    For every corner n, over the rays r of the images, with a_rn the part of the ray's light that comes from it by the field's densities:

        logit_n ← logit_n + ω Σ_r a_rn (c_r − ĉ_r) / ĉ'_r / Σ_r a_rn

    c_r is what the image shows, ĉ_r what the field shows there, ĉ'_r = ĉ (1 − ĉ) the slope of a colour over its logit. So what images
    agree on is right after one pass, and corners that no ray reaches keep every bit. Densities and decoder stay as they are.

    Args:
        views: held-out ones are not looked at, nor masked pixels. Images with alpha ask for their background's colour where they are
            see-through, up to `BESIDE` pixels from what they show: what bulges over a silhouette shows best what is behind it.
        depth: at which a voxel's size in pixels decides how densely rays are taken, working units.
        engine: auto | numba | torch. The compiled one runs on the CPU, with the deferred decoder alone.
        relaxation: ω. With 1 every corner moves by the mean of its rays' corrections, which is too little where neighbours move the
            other way. Below 2, passes one after the other do not diverge where the way from logits to colours is straight (as in SIRT).
        in_place: the colours of `field` itself change, once all rays were rendered: no second copy of its features is made.

    Raises:
        Interrupted: the user asked to stop; then nothing has changed.
    """
    compiled = field.device.type == "cpu" and isinstance(field.decoder, Deferred) and engine != "torch"
    worker: _Engine = _Compiled(field) if compiled else _Torch(field)
    train = [int(index) for index in np.flatnonzero(~np.asarray(views.test))]
    cameras = [_smaller(views.intrinsics[index], PER_VOXEL * depth / field.voxel_size) for index in train]
    wanted = sum(_shown(views, index, camera) for index, camera in zip(train, cameras, strict=True))
    every = max(1, math.ceil(wanted / (MOST_WITHIN if any(alpha is not None for alpha in views.alpha) else MOST_RAYS)))
    chosen = list(zip(train, cameras, strict=True))[::every]
    for count, (index, camera) in enumerate(chosen):
        progress.update(count, len(chosen), "colours")
        progress.check()
        worker.add(*_pixels(views, index, camera))
    sums, seen = worker.sums()
    features = field.feature_rows if in_place else field.feature_rows.clone()
    sums[:, :COLOURS] *= relaxation / sums[:, COLOURS:].clamp_min(THRESHOLD)
    features[:-1, :COLOURS] += sums[:-1, :COLOURS]
    return Recoloured(replace(field, feature_rows=features), seen)


class _Torch:
    """The reference, on any device and with any decoder."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.total = torch.zeros(len(field.density_rows), COLOURS + 1, device=field.device)
        self.seen = torch.zeros(len(field.occupied), device=field.device)

    def add(self, origins: Tensor, directions: Tensor, colours: Tensor) -> None:
        few = CHUNK if is_cpu(self.field.device) else AT_ONCE
        given = (values.to(self.field.device).split(few) for values in (origins, directions, colours))
        for o, d, c in zip(*given, strict=True):
            project_back(self.field, o, d, c, self.total, self.seen)

    def sums(self) -> tuple[Tensor, Tensor]:
        return self.total, self.seen


def project_back(field: Field, origins: Tensor, directions: Tensor, colours: Tensor, sums: Tensor, seen: Tensor) -> None:
    """Add what these rays (B, 3) ask for to `sums` (M · 512 + 1, 4), and raise `seen` (M · 512,)."""
    # Rays that are not stopped (SOLID) say more of what is behind the field, and weak samples (THRESHOLD) show nothing.
    shown = render_with_gradients(field, origins, directions, threshold=THRESHOLD)
    opacity = shown.opacity[:, None]
    own = ((shown.colour - (1 - opacity) * field.background) / opacity.clamp_min(SOLID)).clamp(0, 1)
    asked = ((colours - own) / (own * (1 - own)).clamp_min(STEEPEST)).clamp(-MOST, MOST)
    samples = shown.samples
    seen.scatter_reduce_(0, samples.cell, shown.weight, "amax")
    solid = ray_sum(shown.weight, samples.ray, len(origins)) > 1 - SOLID
    peak = torch.zeros(len(origins), device=field.device).scatter_reduce_(0, samples.ray, shown.weight, "amax")
    seen[samples.cell[(shown.weight == peak[samples.ray]) & solid[samples.ray]]] = 1.0
    kept = ((shown.weight > THRESHOLD) & (shown.opacity >= SOLID)[samples.ray]).nonzero().view(-1)
    if len(kept) == 0:
        return
    light, ray = shown.weight[kept, None], samples.ray[kept]
    rows, corner_weights = corners(field.topology, samples.cell[kept], samples.inside[kept])
    touched, (more,) = scatter(rows, corner_weights, (torch.cat([light * asked[ray], light], 1),))
    sums[touched] += more


class _Compiled:
    """The same by the CPU's kernels; each thread has sums of its own, so that they do not depend on who comes first."""

    def __init__(self, field: Field) -> None:
        from fieldfuse.backends.numba.decode import layers_of
        from fieldfuse.render.numba_renderer import decoder_arrays, make_space, make_volume

        assert isinstance(field.decoder, Deferred)
        self.threads = torch.get_num_threads()
        self.space, self.volume, self.layers = make_space(field), make_volume(field), layers_of(decoder_arrays(field.decoder))
        self.total = np.zeros((self.threads, len(field.density_rows), COLOURS + 1), np.float32)
        self.marks = np.zeros((self.threads, len(field.occupied)), np.uint16)

    def add(self, origins: Tensor, directions: Tensor, colours: Tensor) -> None:
        from fieldfuse.backends.numba.decode import rays_of
        from fieldfuse.backends.numba.render import project_back_pass

        given = [values.float().contiguous().numpy() for values in (origins, directions, colours)]
        limits = tuple(np.float32(value) for value in (STOP, THRESHOLD, STEEPEST, MOST))
        edges = np.linspace(0, len(origins), self.threads + 1).astype(int)

        def part(thread: int) -> None:
            own = [values[edges[thread] : edges[thread + 1]] for values in given]
            field = (self.space, self.volume, self.layers, rays_of(self.layers))
            project_back_pass(*field, *own, limits, self.marks[thread], self.total[thread])

        share(part, range(self.threads), self.threads)

    def sums(self) -> tuple[Tensor, Tensor]:
        seen = (self.marks.max(0) >> 4).astype(np.float32) / 4095
        return torch.from_numpy(self.total.sum(0) if self.threads > 1 else self.total[0]), torch.from_numpy(seen)


def _smaller(full: Intrinsics, focal: float) -> Intrinsics:
    """The same camera with images of about this focal length in pixels, or its own if that is less."""
    shrink = min(1.0, focal / full.fx)
    return full.scaled(max(1, round(shrink * full.width)), max(1, round(shrink * full.height)))


def _shown(views: Views, index: int, camera: Intrinsics) -> float:
    """Pixels of an image made as small as `camera` that are not see-through."""
    alpha = views.alpha[index] if views.alpha else None
    return camera.width * camera.height * (1.0 if alpha is None else float(np.count_nonzero(alpha)) / alpha.size)


def _pixels(views: Views, index: int, camera: Intrinsics) -> tuple[Tensor, Tensor, Tensor]:
    """Origins, directions and colours (B, 3) of an image made as small as `camera`, without what is masked, or see-through and more than
    `BESIDE` pixels from what is not."""
    shape = (camera.width, camera.height)
    image = cv2.resize(views.images[index], shape, interpolation=cv2.INTER_AREA).reshape(-1, COLOURS)
    kept = np.ones(len(image), bool)
    mask = views.valid[index] if views.valid else None
    if mask is not None:
        kept &= cv2.resize(np.asarray(mask, np.float32), shape, interpolation=cv2.INTER_AREA).ravel() > VALID
    alpha = views.alpha[index] if views.alpha else None
    if alpha is not None:
        near = cv2.dilate(cv2.resize(alpha, shape, interpolation=cv2.INTER_AREA), np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), np.uint8))
        kept &= near.ravel() > 0
    origins, directions, _ = rays(camera, views.world_from_camera[index], pixel_grid(*shape)[kept])
    return origins, directions, torch.from_numpy(image[kept].astype(np.float32) / 255)
