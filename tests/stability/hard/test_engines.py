"""Two engines, one field: torch and the compiled one against sums written out and each other, and their gradients against float64."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.render.compiled import CompiledRenderer
from fieldfuse.render.compiled_per_sample import write_back
from fieldfuse.render.differentiable import render_with_gradients
from fieldfuse.render.field import Field, density
from fieldfuse.render.kernels_decode import Layers
from fieldfuse.render.march import BRICK
from fieldfuse.render.paths import look_at
from fieldfuse.render.rays import render_rays
from fieldfuse.training.fused import BETAS, FusedOptimiser
from fieldfuse.training.fused_decoder import write_layers
from fieldfuse.training.fused_per_sample import FusedPerSampleOptimiser
from fieldfuse.training.rays import Batch, PixelPool
from fieldfuse.training.step import Rates
from tests.stability.hard import reference
from tests.stability.hard.errors import by_size, not_finite
from tests.stability.hard.fields import aimed_rays, small_field
from tests.stability.hard.within import Within

GROUP = "engines"
OPACITY = 1e-6


def both(field: Field, origins: Tensor, directions: Tensor, threshold: float) -> dict[str, Tensor]:
    """(B, 5) colour, distance and opacity by each engine."""
    slow = render_rays(field, origins, directions, threshold)
    fast = CompiledRenderer(field, 1).render(origins, directions, threshold)
    return {"torch": torch.cat([slow.colour, slow.distance[:, None], slow.opacity[:, None]], 1), "compiled": fast}


def even(thickness: float, resolution: int = 128) -> tuple[Field, Tensor, Tensor]:
    """A full lattice in which each sample of a ray along x has this optical thickness, and such a ray."""
    field = small_field(0, 1.0, resolution)
    unit = float(density(torch.zeros(1)).double())
    raw = math.log(thickness / (unit * 2 / resolution))
    origin = torch.tensor([[-3.0, -0.15, 0.33]])
    return replace(field, density_rows=torch.full_like(field.density_rows, raw)), origin, torch.tensor([[1.0, 0.0, 0.0]])


def test_haze_to_solid(within: Within) -> None:
    """Haze to solid: opacity of a ray through 128 even samples."""
    for thickness in (1e-9, 1e-6, 1e-4, 1e-2, 1.0, 30.0):
        field, origin, direction = even(thickness)
        exact = 1 - reference.composite([thickness] * 128)[2]
        for name, values in both(field, origin, direction, 0.0).items():
            # The compiled engine ends a ray where a ten-thousandth of the light is left.
            bound = OPACITY if exact < 0.999 else 2e-4
            within(f"{name}, τ = {thickness:g} a sample", abs(float(values[0, 4]) - exact), bound)


def test_clamped(within: Within) -> None:
    """Densities at and beyond the clamp, empty and solid side by side."""
    field = small_field(7, 0.5)
    raw = torch.where(torch.rand(len(field.density_rows)) < 0.5, 1e30, -1e30)
    raw[-1] = 0
    origins, directions = aimed_rays(400, 2)
    values = both(replace(field, density_rows=raw), origins, directions, 1e-3)
    colour = (values["torch"][:, :3] - values["compiled"][:, :3]).abs().amax(1)
    opacity = (values["torch"][:, 4] - values["compiled"][:, 4]).abs()
    within("values that are not finite", not_finite(*values.values()), 0.0)
    within("colours outside [0, 1]", float(sum(((v[:, :3] < 0) | (v[:, :3] > 1)).sum() for v in values.values())), 0.0)
    # A sample that float32 puts on the other side of a voxel's border changes its ray, and only it.
    within("colours of the two engines apart, 95% of rays", float(colour.quantile(0.95)), 1e-3)
    within("opacities of the two engines apart, 95% of rays", float(opacity.quantile(0.95)), 1e-3)


def test_agree(within: Within) -> None:
    """Random fields, bounded and with a background: the two agree."""
    for name, shell, share in (("bounded", 0.0, 0.4), ("with a background", 1.0, 0.4), ("almost empty", 0.0, 0.01)):
        field = small_field(3, share, 64, shell)
        origins, directions = aimed_rays(300, 4, 2.0)
        values = both(field, origins, directions, 1e-3)
        apart = (values["torch"][:, [0, 1, 2, 4]] - values["compiled"][:, [0, 1, 2, 4]]).abs().amax(1)
        within(f"{name}: apart, 95% of rays", float(apart.quantile(0.95)), 1e-3)
        within(f"{name}: apart, mean", float(apart.mean()), 2e-3)
        within(f"{name}: not finite", not_finite(*values.values()), 0.0)


def test_nothing(within: Within) -> None:
    """Nothing to see: no rays, rays that miss, a field without voxels."""
    field = small_field(1)
    origins, directions = aimed_rays(20, 5)
    empty = replace(field, occupied=torch.zeros_like(field.occupied)).settled()
    for what, seen, ways in (("missing", field, -directions), ("no voxels", empty, directions)):
        for name, values in both(seen, origins, ways, 1e-3).items():
            apart = float((values[:, :3] - field.background).abs().max())
            within(f"{name}, {what}: not the background", apart + float(values[:, 3:].abs().max()), 1e-6)
    none = both(field, origins[:0], directions[:0], 1e-3)
    within("pictures of no rays", float(sum(len(values) for values in none.values())), 0.0)


SIDE, FOCAL = 20, 22.0
NAMES = ("w1", "b1", "w2", "b2", "density", "density_bias", "w3", "b3", "w4", "b4")  # as `FusedPerSampleOptimiser` moves them
RATES = Rates(0.0, 0.0, 0.0, distortion=0.02, opacity=0.03, colour_threshold=0.0)


def pixels() -> PixelPool:
    """Five pictures of noise round the origin."""
    generator = np.random.default_rng(3)
    eyes = generator.normal(size=(5, 3))
    eyes = 3 * eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    images = [generator.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8) for _ in eyes]
    lens = Intrinsics(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2)
    return PixelPool(
        Views([str(i) for i in range(5)], images, [lens] * 5, look_at(eyes, np.zeros(3), np.array([0.0, 0.0, 1.0])), np.zeros(5, bool))
    )


def translucent(seed: int, shell: float, decoder: str) -> Field:
    """A random field through which some light always comes, so that no ray ends early."""
    field = small_field(seed, 0.5, 32, shell, decoder)
    return replace(field, density_rows=field.density_rows - 2)


def compiled_gradients(field: Field, pool: PixelPool, picks: Tensor) -> dict[str, Tensor]:
    """What a step of the compiled engine gathers, its step sizes zero; the decoder's from Adam's first moments."""
    kind = FusedPerSampleOptimiser if isinstance(field.decoder, PerSample) else FusedOptimiser
    engine = kind(field, pool, threads=1)
    engine.step_on(picks.numpy(), np.zeros(len(picks), np.float32), RATES)
    rows = torch.from_numpy(engine.touched[0, : engine.used[0]].astype(np.int64))
    density, features = torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)
    density[rows] = torch.from_numpy(engine.density_sums[0, : len(rows)])
    features[rows] = torch.from_numpy(engine.feature_sums[0, : len(rows)])
    moments = [np.ascontiguousarray(first / (1 - BETAS[0])) for first, _ in engine.moments]
    net = deepcopy(field.decoder)
    if isinstance(engine, FusedPerSampleOptimiser):
        assert isinstance(net, PerSample)
        write_back(engine.net._replace(**dict(zip(NAMES, moments, strict=True))), net)
    else:
        assert isinstance(net, Deferred)
        write_layers(Layers(*moments), net)
    return {"densities": density, "features": features, **{name: value.detach() for name, value in net.named_parameters()}}


def exact_gradients(field: Field, batch: Batch) -> dict[str, Tensor]:
    """Of the same losses, each written out, through `render_with_gradients` in float64."""
    wide = replace(
        field,
        density_rows=field.density_rows.double().requires_grad_(True),
        feature_rows=field.feature_rows.double().requires_grad_(True),
        decoder=deepcopy(field.decoder).double(),
        background=field.background.double(),
    )
    count = len(batch.origins)
    seen = render_with_gradients(wide, batch.origins, batch.directions, torch.zeros(count))
    loss = (seen.colour - batch.colour.double()).square().mean() + RATES.opacity * (1 - seen.opacity).square().mean()
    length = BRICK / (field.fine * field.resolution)
    for ray in range(count):
        weight, place = seen.weight[seen.samples.ray == ray], seen.samples.place[seen.samples.ray == ray].double()
        apart = (place[:, None] - place[None]).abs()
        pairs = (weight[:, None] * weight[None] * apart).sum() + (weight.square() * length).sum() / 3
        loss = loss + pairs * (RATES.distortion / count)
    names, weights = zip(*wide.decoder.named_parameters(), strict=True)
    found = torch.autograd.grad(loss, [wide.density_rows, wide.feature_rows, *weights])
    rows = torch.arange(len(field.density_rows)) < field.topology.zero_row  # the zero row stays zero
    return {"densities": found[0] * rows, "features": found[1] * rows[:, None], **dict(zip(names, found[2:], strict=True))}


def both_gradients(decoder: str, seed: int, pick_seed: int) -> Iterator[tuple[str, dict[str, Tensor], dict[str, Tensor]]]:
    """What kind of field it is, its gradients in float64 and those of the compiled step, on 300 pixels each."""
    pool = pixels()
    for shell in (0.0, 1.0):
        field = translucent(seed, shell, decoder)
        picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(pick_seed))[:300]
        yield "with a background" if shell else "bounded", exact_gradients(field, pool.take(picks)), compiled_gradients(field, pool, picks)


def test_gradients(within: Within) -> None:
    """Gradients of a compiled step against autograd in float64."""
    for name, exact, found in both_gradients("deferred", 4, 1):
        for key in exact:
            within(f"{name}: gradient of {key}, by the largest", by_size(found[key], exact[key]), 1e-4)
        within(f"{name}: gradients that are not finite", not_finite(*found.values()), 0.0)


@pytest.mark.long
def test_gradients_per_sample(within: Within) -> None:
    """Gradients of a compiled step with a decoder at every sample, against autograd in float64.

    Its sines are up to 16π times as steep as what is looked up, and rounding puts some hidden units on the other side of their ReLU:
    the whole of a gradient is held to float64, not its every entry.
    """
    for name, exact, found in both_gradients("per_sample", 5, 2):
        for key, wanted in exact.items():
            error = float((found[key].double() - wanted).norm() / wanted.norm())
            within(f"{name}: gradient of {key}, by its norm", error, 5e-3)
        within(f"{name}: gradients that are not finite", not_finite(*found.values()), 0.0)
