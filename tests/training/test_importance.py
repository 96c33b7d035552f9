"""Pixels drawn by the errors of their tiles: evenly once each counts what it is weighed, alike in torch and compiled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.backends.numba import train_batch
from fieldfuse.backends.numba.train_batch import Tiles
from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.training.engine import make_engine
from fieldfuse.training.fit import fit_field
from fieldfuse.training.numba_engine import NumbaEngine
from fieldfuse.training.pixels import SHARE, TOP, PixelPool, TileErrors, densities, tile_grid
from fieldfuse.training.torch_engine import TorchEngine
from tests.render.made import random_field
from tests.training.gradients import made_views
from tests.training.test_fit import scene, wanted
from tests.training.test_numba import RATES

ROUNDS = 150


def masked_pool() -> PixelPool:
    """Pixels of five pictures, a third of them masked away, the last picture kept aside."""
    views = made_views(5, 24)
    valid = [np.random.default_rng(index).random((24, 24)) < 0.67 for index in range(5)]
    pool = PixelPool(replace(views, valid=valid))
    pool.limit = int(pool.starts[4])
    return pool


def with_errors(errors: TileErrors) -> None:
    """TileErrors over four decades, and some tiles that no ray came to."""
    generator = torch.Generator().manual_seed(2)
    errors.error = 10 ** (-4 * torch.rand(len(errors.error), generator=generator))
    errors.error[::7] = 0


def drawn(kind: str, pool: PixelPool, errors: TileErrors) -> tuple[np.ndarray, np.ndarray]:
    """Many pixels and what they count, by either engine's draw."""
    if kind == "torch":
        generator = torch.Generator().manual_seed(0)
        parts = [errors.draw(1000, generator) for _ in range(ROUNDS)]
        return np.concatenate([p.numpy() for p, _ in parts]), np.concatenate([w.numpy() for _, w in parts])
    tiles, pixels = Tiles(len(pool.pose), tile_grid(pool)), NumbaEngine(random_field(0.0, 16, keep=0.1), pool, threads=1).pixels
    tiles.error[:] = errors.error.numpy()
    tiles.renew()
    picks, weights = np.empty((ROUNDS, 1000), np.int64), np.empty((ROUNDS, 1000), np.float32)
    for round_ in range(ROUNDS):
        tiles.draw(pixels, pool.limit, round_, picks[round_], weights[round_])
    return picks.reshape(-1), weights.reshape(-1)


@pytest.mark.parametrize("kind", ["torch", "compiled"])
def test_weighed_draws_are_even(kind: str) -> None:
    """Counted by their weights all pixels come equally often; plainly, those of bad tiles more often, in the promised ratio."""
    pool = masked_pool()
    errors = TileErrors(pool)
    with_errors(errors)
    picks, weights = drawn(kind, pool, errors)
    assert picks.min() >= 0 and picks.max() < pool.limit
    everyone = torch.arange(pool.limit)
    q = densities(errors.error)[errors.tiles(everyone)].numpy()
    np.testing.assert_allclose(weights, 1 / q[picks], rtol=1e-5)
    # A pixel's weighed count is n q / Σq · 1 / q in the mean, with the variance of a Poisson count over q².
    expected = len(picks) / q.sum()
    counted = np.bincount(picks, weights, minlength=pool.limit)
    score = (counted - expected) / np.sqrt(expected / q)
    assert abs(float(score.mean())) < 5 / np.sqrt(len(score)) and 0.85 < float(score.std()) < 1.15
    assert q.max() / q.min() > 5


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 4, width=32), min_size=1, max_size=60))
def test_densities_agree_and_are_bounded(error: list[float]) -> None:
    given_errors = np.array(error, np.float32)
    out = np.empty_like(given_errors)
    train_batch.densities(given_errors, out)
    np.testing.assert_allclose(out, densities(torch.from_numpy(given_errors)).numpy(), rtol=1e-4)
    assert out.min() >= 1 - SHARE - 1e-6 and out.max() <= TOP + 1e-5 and np.all(out[given_errors == 0] == 1)


@pytest.mark.parametrize("engine", ["torch", "numba"])
def test_pictures_that_are_masked_away_are_refused(engine: str) -> None:
    """By one sentence from a fit, and before compiled code looks at pixels that are not there."""
    views = replace(made_views(5, 24), valid=[np.zeros((24, 24), bool)] * 5)
    with pytest.raises(InputError, match="every pixel of the training images is masked"):
        fit_field(views, scene(), wanted("budget=1", f"engine={engine}"))
    pool = masked_pool()
    pool.limit = 0
    fit = make_engine(wanted(f"engine={engine}"), random_field(0.0, 16, keep=0.1), pool)
    with pytest.raises((ValueError, RuntimeError)):
        fit.step(10, RATES)


@pytest.mark.parametrize("engine", ["torch", "numba"])
@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_steps_remember_errors(engine: str, decoder: str) -> None:
    """What a step leaves at its tiles are squared errors of its rays; tiles of pictures kept aside stay unknown."""
    pool = masked_pool()
    field = random_field(1.0, 32, decoder, keep=0.5, raw=-2.5)
    fit = make_engine(Settings(engine=engine, device="cpu", threads=1), field, pool)
    for _ in range(12):
        mean, _ = fit.step(400, RATES)  # whose rates are zero: the field stays as it is
    error = fit.tile_errors.error.numpy() if isinstance(fit, TorchEngine) else fit.met.error  # type: ignore[attr-defined]
    per_view = error.reshape(5, -1)
    assert (per_view[:4] > 0).mean() > 0.5 and not per_view[4].any()
    everyone = torch.arange(pool.limit)
    batch = pool.take(everyone)
    exact = (fit.colours(batch.origins, batch.directions) - batch.colour).square().mean(1)
    tiles = TileErrors(pool).tiles(everyone)
    sums = torch.zeros(len(error)).index_add_(0, tiles, exact)
    counts = torch.zeros(len(error)).index_add_(0, tiles, torch.ones_like(exact))
    whole = counts >= 30
    truth = (sums / counts.clamp_min(1)).numpy()[whole.numpy()]
    got = error[whole.numpy()]
    assert float(got.mean()) == pytest.approx(float(truth.mean()), rel=0.1)
    assert mean == pytest.approx(float(exact.mean()), rel=0.25)
