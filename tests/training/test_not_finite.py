"""Steps whose loss or gradient is not finite: nothing moves, the fit says where and goes on with smaller steps, a few times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest
import torch

from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT
from fieldfuse.training import nonfinite_policy, torch_engine
from fieldfuse.training.engine import Engine, make_engine, warm_up
from fieldfuse.training.fit import Begin, _first, fit_field
from fieldfuse.training.losses import Rates
from fieldfuse.training.nonfinite_policy import NotFiniteError, require_finite
from fieldfuse.training.numba_engine import NumbaEngine
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.torch_engine import LazyAdam, TorchEngine
from fieldfuse.volume.host import TorchHost
from tests.training.test_fit import scene, sphere_views, ticking, wanted

RATES = Rates(0.3, 0.05, 3e-3, 0.01)
KINDS = [("torch", "deferred"), ("torch", "per_sample"), ("numba", "deferred"), ("numba", "per_sample")]
Spoil = Callable[[Any], None]


def engine_of(name: str, decoder: str, threads: int = 1) -> Engine:
    settings = wanted(f"engine={name}", f"decoder={decoder}", "field.resolution=32")
    torch.manual_seed(0)
    views = sphere_views()
    field, _ = _first(views, scene(), settings, torch.device("cpu"), TorchHost())
    if name == "numba" and threads > 1:
        return NumbaEngine(field, PixelPool(views), 0, threads)
    return make_engine(settings, field, PixelPool(views))


def everything(engine: Any) -> list[np.ndarray]:
    """All that a step moves: rows, weights, and both optimisers' state."""
    field = engine.sync()
    out = [field.density_rows, field.feature_rows, *field.decoder.state_dict().values()]
    if isinstance(engine, TorchEngine):
        out += [engine.density.state, engine.feature.state]
        out += [value for state in engine.decoder.state.values() for value in state.values()]
    else:
        out += [engine.rows.records, *engine.first, *engine.second]
    return [np.array(value.detach() if isinstance(value, torch.Tensor) else value) for value in out]


def spoiling(monkeypatch: pytest.MonkeyPatch, engine: str, value: float, when: Iterator[bool], what: str = "densities") -> None:
    """At the steps that `when` says, one gradient of a row, or of the decoder, is `value`."""
    if engine == "torch":
        plain = torch_engine.scatter

        def scatter(*given: Any) -> Any:
            rows, gradients = plain(*given)
            if next(when):
                gradients[0 if what == "densities" else 1].view(-1)[5] = value
            return rows, gradients

        monkeypatch.setattr(torch_engine, "scatter", scatter)
        return
    compiled = NumbaEngine._broken

    def broken(self: NumbaEngine, thread: int, error: float) -> str | None:
        if thread == self.threads - 1 and next(when):
            (self.rows.density[thread] if what == "densities" else self.rows.feature[thread, 0])[5] = value
        return compiled(self, thread, error)

    monkeypatch.setattr(NumbaEngine, "_broken", broken)


@pytest.mark.parametrize("value", [math.nan, -math.inf])
@pytest.mark.parametrize("what", ["densities", "features"])
@pytest.mark.parametrize(("name", "decoder"), KINDS)
def test_a_bad_step_moves_nothing_and_the_next_one_is_good(
    name: str, decoder: str, what: str, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = engine_of(name, decoder)
    with monkeypatch.context() as patch:
        spoiling(patch, name, value, iter([False, False, True]), what)
        for _ in range(2):
            engine.step(64, RATES)
        before = everything(engine)
        with pytest.raises(NotFiniteError, match=rf"gradient of the {what} is not finite at 1 of [\d,]+ places"):
            engine.step(64, RATES)
    for old, new in zip(before, everything(engine), strict=True):
        np.testing.assert_array_equal(old, new)
    error, looked = engine.step(64, RATES)
    assert math.isfinite(error) and looked > 0
    assert any((old != new).any() for old, new in zip(before, everything(engine), strict=True))
    assert all(np.isfinite(values).all() for values in everything(engine))


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_one_bad_thread_of_two_stops_both(decoder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = engine_of("numba", decoder, threads=2)
    engine.step(64, RATES)
    before = everything(engine)
    with monkeypatch.context() as patch:
        spoiling(patch, "numba", math.nan, iter([True]))
        with pytest.raises(NotFiniteError, match="densities"):
            engine.step(64, RATES)
    for old, new in zip(before, everything(engine), strict=True):
        np.testing.assert_array_equal(old, new)
    engine.step(64, RATES)
    assert all(np.isfinite(values).all() for values in everything(engine))


@pytest.mark.parametrize(("name", "decoder"), KINDS)
def test_a_broken_weight_of_the_decoder_is_noticed(name: str, decoder: str) -> None:
    """What breaks outside a step is seen in the next one, before it spreads into rows."""
    engine = engine_of(name, decoder)
    engine.step(64, RATES)
    field = engine.sync()
    with torch.no_grad():
        next(field.decoder.parameters())[0, 0] = math.nan
    if name == "numba":
        engine = make_engine(wanted("engine=numba", f"decoder={decoder}"), field, PixelPool(sphere_views()))
    with pytest.raises(NotFiniteError, match=r"colour error|a weight of the decoder"):
        engine.step(64, RATES)
    assert bool(torch.isfinite(engine.field.density_rows).all() and torch.isfinite(engine.field.feature_rows).all())


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_a_fit_goes_on_from_the_last_good_step_with_smaller_ones(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.05)
    spoiling(monkeypatch, name, math.nan, (number in (10, 25) for number in count()))
    settings = wanted(f"engine={name}", "budget=3", "field.resolution=32")
    eased: list[float] = []
    policy = nonfinite_policy.NonfinitePolicy
    plain = policy.scaled_rates
    monkeypatch.setattr(policy, "scaled_rates", lambda self, rates: (eased.append(self.slower), plain(self, rates))[1])
    result = fit_field(sphere_views(), scene(), settings)
    assert sorted(set(eased), reverse=True) == [1, 0.5, 0.25]
    assert len(result.notes) == 2 and result.steps == len(eased) - 2
    assert "of the fit, at 32³" in result.notes[0] and "gradient of the densities" in result.notes[0]
    assert "0.25 of the step sizes" in result.notes[1]
    field = result.field
    assert all(bool(torch.isfinite(v).all()) for v in (field.density_rows, field.feature_rows, *field.decoder.parameters()))
    assert result.timeline[-1]["psnr"] > result.timeline[0]["psnr"]


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_a_fit_that_breaks_again_and_again_ends_with_what_it_has(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = wanted(f"engine={name}", "budget=3", "field.resolution=32")
    warm_up(chosen, SILENT)  # its steps are not counted
    ticking(monkeypatch, 0.05)
    spoiling(monkeypatch, name, math.inf, (number >= 30 for number in count()))
    result = fit_field(sphere_views(), scene(), chosen)
    assert result.steps == 30 and len(result.notes) == nonfinite_policy.MOST + 1
    assert "the fit ended with the field of the step before" in result.notes[-1]
    assert bool(torch.isfinite(result.field.density_rows).all())
    assert result.timeline and math.isfinite(result.timeline[-1]["psnr"])


def test_a_fit_without_one_good_step_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    spoiling(monkeypatch, "torch", math.nan, (True for _ in count()))
    with pytest.raises(InputError, match=r"before any good step; lower fit\.rate_density"):
        fit_field(sphere_views(), scene(), wanted("engine=torch", "budget=3", "field.resolution=32"))


def test_going_on_from_a_broken_field_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.2)
    settings = wanted("engine=torch", "budget=2", "field.resolution=32")
    field = fit_field(sphere_views(), scene(), settings).field
    again = fit_field(sphere_views(), scene(), settings, begin=Begin(start=field))
    assert not again.notes
    field.feature_rows[3, 2] = math.nan
    with pytest.raises(InputError, match="not finite; fit it anew"):
        fit_field(sphere_views(), scene(), settings, begin=Begin(start=field))


def test_going_on_from_a_field_of_no_voxel_is_refused() -> None:
    """As the networks leave it, where nothing could be recognised: no block, or blocks without a voxel."""
    views, settings = sphere_views(), wanted("engine=torch", "field.resolution=32")
    made, _ = _first(views, scene(), settings, torch.device("cpu"), TorchHost())
    for start in (empty := replace(made, occupied=torch.zeros_like(made.occupied)), empty.packed()()):
        with pytest.raises(InputError, match=r"holds no voxel, .* fit it anew with --init classical"):
            fit_field(views, scene(), settings, begin=Begin(start=start))


def test_large_finite_gradients_are_no_bad_step() -> None:
    huge = torch.full((10,), 3e38)
    require_finite([("huge", huge)])  # whose sum is infinite
    with pytest.raises(NotFiniteError, match="the second is not finite at 2 of 10 places"):
        require_finite([("the first", huge), ("the second", torch.where(torch.arange(10) < 2, math.inf, huge))])
    rows = LazyAdam(torch.zeros(10))
    rows.step(torch.arange(10), huge, 0.1)
    assert bool(torch.isfinite(rows.values).all())


@pytest.mark.parametrize("name", ["torch", "numba"])
def test_features_that_overflow_in_the_decoder_end_in_a_sentence_or_in_numbers(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing patched: activations that are not finite are seen in the colours, or cut off by the layers behind them."""
    ticking(monkeypatch, 0.2)
    settings = wanted(f"engine={name}", "budget=2", "field.resolution=32")
    field = fit_field(sphere_views(), scene(), settings).field
    field.feature_rows[:-1] = torch.where(torch.arange(field.feature_rows.shape[1]) % 2 == 0, 3e38, -3e38)
    try:
        after = fit_field(sphere_views(), scene(), settings, begin=Begin(start=field)).field
    except InputError as error:
        assert "is not finite" in str(error)
        return
    assert all(bool(torch.isfinite(v).all()) for v in (after.density_rows, after.feature_rows, *after.decoder.parameters()))
