"""The compiled engine's gradients, written by hand, against autograd in float64: lookup, compositing, decoder and the losses of a step."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.numba.decode import Layers
from fieldfuse.backends.numba.train_decoder import write_layers
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.selftest.case import Measure, by_size, case, not_finite
from fieldfuse.evaluation.selftest.edit import small_field
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.render.differentiable import render_with_gradients
from fieldfuse.render.field import Field
from fieldfuse.render.march import BRICK
from fieldfuse.render.numba_per_sample import write_back
from fieldfuse.render.paths import look_at
from fieldfuse.training.numba_engine import BETAS, NumbaOptimiser
from fieldfuse.training.numba_per_sample import NumbaPerSampleOptimiser
from fieldfuse.training.rays import Batch, PixelPool
from fieldfuse.training.step import Rates

GROUP = "engines"
SIDE, FOCAL = 20, 22.0
NAMES = ("w1", "b1", "w2", "b2", "density", "density_bias", "w3", "b3", "w4", "b4")  # as `NumbaPerSampleOptimiser` moves them
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
    kind = NumbaPerSampleOptimiser if isinstance(field.decoder, PerSample) else NumbaOptimiser
    engine = kind(field, pool, threads=1)
    engine.step_on(picks.numpy(), np.zeros(len(picks), np.float32), RATES)
    rows = torch.from_numpy(engine.touched[0, : engine.used[0]].astype(np.int64))
    density, features = torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)
    density[rows] = torch.from_numpy(engine.density_sums[0, : len(rows)])
    features[rows] = torch.from_numpy(engine.feature_sums[0, : len(rows)])
    moments = [np.ascontiguousarray(first / (1 - BETAS[0])) for first, _ in engine.moments]
    net = deepcopy(field.decoder)
    if isinstance(engine, NumbaPerSampleOptimiser):
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


@case(GROUP, "gradients of a compiled step against autograd in float64")
def gradients(folder: Path) -> list[Measure]:
    out = []
    for name, exact, found in both_gradients("deferred", 4, 1):
        out += [Measure(f"{name}: gradient of {key}, by the largest", by_size(found[key], exact[key]), 1e-4) for key in exact]
        out.append(Measure(f"{name}: gradients that are not finite", not_finite(*found.values()), 0.0))
    return out


@case(GROUP, "gradients of a compiled step with a decoder at every sample, against autograd in float64", slow=True)
def gradients_per_sample(folder: Path) -> list[Measure]:
    """Its sines are up to 16π times as steep as what is looked up, and rounding puts some hidden units on the other side of their ReLU:
    the whole of a gradient is held to float64, not its every entry."""
    out = []
    for name, exact, found in both_gradients("per_sample", 5, 2):
        for key, wanted in exact.items():
            error = float((found[key].double() - wanted).norm() / wanted.norm())
            out.append(Measure(f"{name}: gradient of {key}, by its norm", error, 5e-3))
        out.append(Measure(f"{name}: gradients that are not finite", not_finite(*found.values()), 0.0))
    return out
