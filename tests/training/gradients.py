"""Made views, and gradients of one step of either engine: in float64 those of the torch engine are what both are held against."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.backends.numba import decode, per_sample
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import PerSample
from fieldfuse.render.field import Field
from fieldfuse.render.march import march
from fieldfuse.training import torch_engine
from fieldfuse.training.losses import Rates
from fieldfuse.training.numba_engine import NumbaEngine
from fieldfuse.training.pixels import Batch, PixelPool
from fieldfuse.volume.lookup import corners, gather
from tests.render.test_differentiable import double


def looking(eye: np.ndarray) -> np.ndarray:
    """(4, 4) camera at `eye` that looks at the origin."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], 1)
    return pose


def made_views(count: int = 5, side: int = 24) -> Views:
    generator = np.random.default_rng(3)
    eyes = generator.normal(size=(count, 3))
    eyes = 3 * eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    poses = np.stack([looking(eye) for eye in eyes])
    images = [generator.integers(0, 256, (side, side, 3), dtype=np.uint8) for _ in range(count)]
    lens = [Intrinsics(side, side, 30, 31, 11.5, 12.5)] * count
    depths = [(generator.uniform(2, 4, (side, side)) * (generator.random((side, side)) < 0.7)).astype(np.float32) for _ in range(count)]
    depths[-1] = None  # one image whose depth is unknown
    return Views([f"{i}" for i in range(count)], images, lens, poses, np.zeros(count, bool), depths=depths)


def some_weights(count: int) -> torch.Tensor:
    """(count,) what rays count, some of them twice as much as others."""
    return 0.7 + 0.7 * torch.rand(count, generator=torch.Generator().manual_seed(5))


def weighed(pool: PixelPool, picks: torch.Tensor) -> Batch:
    """The rays of `picks` with `some_weights`."""
    return replace(pool.take(picks), weight=some_weights(len(picks)))


def torch_gradients(field: Field, batch: Batch, rates: Rates) -> tuple[torch.Tensor, ...]:
    """Dense gradients for densities, features, and the decoder's weights in their order; the field stays as it is."""
    field = replace(field, decoder=copy.deepcopy(field.decoder))
    kind = field.density_rows.dtype
    density, feature = torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)
    found: list[torch.Tensor] = []
    engine = torch_engine.TorchEngine(field, PixelPool(made_views()))
    with pytest.MonkeyPatch.context() as patch:
        into = lambda _, rows, g, rate: (density if g.ndim == 1 else feature).index_add_(0, rows, g)  # noqa: E731
        patch.setattr(torch_engine.LazyAdam, "step", into)
        patch.setattr(engine, "_mark", lambda *_: None)
        patch.setattr(engine.decoder, "step", lambda: found.extend(p.grad.clone() for p in field.decoder.parameters()))  # type: ignore[misc]
        engine.step_on(batch, rates, torch.zeros(len(batch.origins), dtype=kind))
    return density, feature, *found


def exact_gradients(field: Field, batch: Batch, rates: Rates) -> tuple[torch.Tensor, ...]:
    """The same with rays, places, field and decoder in float64."""
    return torch_gradients(doubled(field), doubled_rays(batch), rates)


def numba_gradients(engine: NumbaEngine, picks: torch.Tensor, rates: Rates) -> list[torch.Tensor]:
    """The same of the compiled engine, on `picks` with `some_weights`."""
    field, counts = engine.field, {}

    def count(_width: object, _volume: object, _rows: object, thread: int, used: int, *_: object) -> None:
        counts[thread] = used

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fieldfuse.training.numba_engine.adam.adam_pass", count)
        engine.step_on(picks.numpy(), np.zeros(len(picks), np.float32), rates, some_weights(len(picks)).numpy())
    assert len(counts) == engine.threads
    dense = [torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)]
    for thread, used in counts.items():
        rows = torch.from_numpy(engine.rows.touched[thread, :used].astype(np.int64))
        dense[0].index_add_(0, rows, torch.from_numpy(engine.rows.density[thread, :used]))
        dense[1].index_add_(0, rows, torch.from_numpy(engine.rows.feature[thread, :used]))
    decoder = copy.deepcopy(field.decoder)
    if isinstance(decoder, PerSample):
        totals = [scratch.total for scratch in engine.decoder.scratch]
        per_sample.write_net(per_sample.Net(*(sum(parts) for parts in zip(*totals, strict=True))), decoder)
    else:
        totals = [block.tape.total for block in engine.decoder.blocks]
        decode.write_layers(decode.Layers(*(sum(parts) for parts in zip(*totals, strict=True))), decoder)
    return [*dense, *(parameter.detach() for parameter in decoder.parameters())]


def doubled(field: Field) -> Field:
    return double(replace(field, decoder=copy.deepcopy(field.decoder)))


def doubled_rays(batch: Batch) -> Batch:
    distance = None if batch.distance is None else batch.distance.double()
    weight = None if batch.weight is None else batch.weight.double()
    return Batch(batch.origins.double(), batch.directions.double(), batch.colour.double(), batch.view, distance, weight)


def clear_of_zero(field: Field, batch: Batch, margin: float) -> torch.Tensor:
    """(B,) bool, which rays have no sample with a hidden unit whose input lies within `margin` of zero, in float64."""
    field, batch = doubled(field), doubled_rays(batch)
    decoder = field.decoder
    assert isinstance(decoder, PerSample)
    samples = march(field.grid, batch.origins, batch.directions, field.near, field.fine)
    least = torch.full((len(samples),), torch.inf, dtype=torch.float64)

    def look(_layer: object, _given: object, out: torch.Tensor) -> None:
        torch.minimum(least, out.abs().amin(1), out=least)

    hooks = [layer.register_forward_hook(look) for layer in (decoder.body[0], decoder.body[2], decoder.colour[0])]
    with torch.no_grad():
        decoder(gather(field.feature_rows, *corners(field.topology, samples.cell, samples.inside)), batch.directions[samples.ray])
    for hook in hooks:
        hook.remove()
    nearest = torch.full((len(batch.origins),), torch.inf, dtype=torch.float64)
    return nearest.scatter_reduce_(0, samples.ray, least, "amin") > margin
