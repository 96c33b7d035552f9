"""The compiled engine for the paper's decoder against the torch reference: colours, gradients, steps, threads, and the encoding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.backends.numba import decode_per_sample as kernels_net
from fieldfuse.backends.numba.matrix import add_outer, product
from fieldfuse.nerfusion.decoder import PerSample
from fieldfuse.nerfusion.encoding import positional
from fieldfuse.render.field import Field
from fieldfuse.render.numba_per_sample import PerSampleRenderer, net_arrays, write_back
from fieldfuse.render.rays import render_rays
from fieldfuse.training.depth import ROUGH
from fieldfuse.training.numba_per_sample import NumbaPerSampleOptimiser
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Optimiser, Rates
from tests.render.made import random_field, random_rays
from tests.training.gradients import clear_of_zero, exact_gradients, some_weights, torch_gradients, weighed
from tests.training.test_fused import made_views

RATES = Rates(0.0, 0.0, 0.0, 0.01, 0.03, depth=0.05)
SLOW = replace(RATES, slow_within=3.0, depth_noise=ROUGH.noise)  # the made views look from 3 away: half of what they see moves slowly


@pytest.fixture
def every_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiled engine looks at samples behind spent light too, as the reference does."""
    monkeypatch.setattr("fieldfuse.training.numba_engine.STOP", 0.0)
    monkeypatch.setattr("fieldfuse.training.numba_per_sample.NEGLIGIBLE", -1.0)


def made_field(shell: float, keep: float, raw: float) -> Field:
    return random_field(shell, 32, "per_sample", keep=keep, raw=raw)


@pytest.mark.parametrize(("inner", "columns"), [(16, 16), (48, 32), (176, 64)])
def test_products_of_tiles(inner: int, columns: int) -> None:
    generator = np.random.default_rng(inner)
    left, right, out = (generator.normal(size=shape).astype(np.float32) for shape in ((24, inner), (inner, columns), (24, columns + 16)))
    before = out.copy()
    product(left, 3, 10, right, out)
    np.testing.assert_allclose(out[3:15, :columns], left[3:15] @ right, atol=1e-4)
    for untouched in (np.s_[:3], np.s_[15:], np.s_[:, columns:]):
        np.testing.assert_array_equal(out[untouched], before[untouched])
    total = generator.normal(size=(inner, columns)).astype(np.float32)
    wanted = total + left[:19].T @ out[:19, :columns]
    add_outer(left, out, 19, total)
    np.testing.assert_allclose(total, wanted, atol=2e-3)


@pytest.mark.parametrize("spread", [0.1, 1.0, 30.0])
def test_the_encoding_is_as_exact_as_the_reference(spread: float) -> None:
    """Against float64; the reference rounds the angle itself to float32."""
    values = (torch.randn(200, 16, generator=torch.Generator().manual_seed(1)) * spread).float()
    wanted = positional(values.double(), 5).numpy()
    given = np.zeros((200, 176), np.float32)
    given[:, :16] = values.numpy()
    for row in given:
        kernels_net.encode((0,) * 16, row)
    error = np.abs(given - wanted).max()
    assert error < 4e-6 and error < 2 * np.abs(positional(values, 5).numpy() - wanted).max() + 2e-6


@pytest.mark.parametrize(("channels", "hidden"), [(8, 16), (16, 32), (5, 20)])
def test_weights_survive_the_way_there_and_back(channels: int, hidden: int) -> None:
    """Widths that are padded too."""
    decoder, other = PerSample(channels, hidden), PerSample(channels, hidden)
    write_back(net_arrays(decoder), other)
    for name, value in decoder.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


@pytest.mark.parametrize("shell", [0.0, 1.0])
@pytest.mark.parametrize("keep", [1.0, 0.3, 0.02])
def test_pictures_agree(shell: float, keep: float) -> None:
    field = made_field(shell, keep, -2.0)
    # Now and then a ray ends a sample earlier in one of the two, within rounding of STOP: none of these.
    origins, directions = random_rays(500, 1)
    if shell:
        origins = origins * torch.linspace(0.02, 3, 500)[:, None]
    expected = render_rays(field, origins, directions)
    got = PerSampleRenderer(field, 1).render(origins, directions)
    assert float(expected.colour.std()) > 0.05
    torch.testing.assert_close(got[:, :3], expected.colour, atol=1e-4, rtol=0)
    # A ray ends where less than STOP of its light is left, which the reference looks at too: 1e-4, and rounding.
    torch.testing.assert_close(got[:, 4], expected.opacity, atol=2e-4, rtol=0)
    # The distance jumps where the light left passes one half within rounding of a sample's border.
    close = (got[:, 3] - expected.distance).abs() < 1e-3 * (1 + expected.distance)
    assert float(close.float().mean()) > 0.99
    assert torch.equal(got, PerSampleRenderer(field, 2).render(origins, directions))


def gradients(
    engine: NumbaPerSampleOptimiser, picks: torch.Tensor, monkeypatch: pytest.MonkeyPatch, rates: Rates = RATES
) -> list[torch.Tensor]:
    """Dense gradients of densities and features, and the decoder's in the order of its parameters."""
    field, counts = engine.field, {}

    def keep_sums(width: object, volume: object, index: np.ndarray, *rest: object) -> None:
        thread, used = rest[5:7]
        counts[thread] = used

    with monkeypatch.context() as patch:
        patch.setattr("fieldfuse.training.numba_engine.moves.adam_pass", keep_sums)
        engine.step_on(picks.numpy(), np.zeros(len(picks), np.float32), rates, some_weights(len(picks)).numpy())
    assert len(counts) == engine.threads
    dense = [torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)]
    for thread, used in counts.items():
        rows = torch.from_numpy(engine.touched[thread, :used].astype(np.int64))
        dense[0].index_add_(0, rows, torch.from_numpy(engine.density_sums[thread, :used]))
        dense[1].index_add_(0, rows, torch.from_numpy(engine.feature_sums[thread, :used]))
    names = ("w1", "b1", "w2", "b2", "density", "density_bias", "w3", "b3", "w4", "b4")
    totals = {name: sum(getattr(scratch.total, name) for scratch in engine.scratch) for name in names}
    assert isinstance(field.decoder, PerSample)
    decoder = PerSample(field.decoder.channels, field.decoder.hidden)
    write_back(engine.scratch[0].total._replace(**totals), decoder)
    return [*dense, *(parameter.detach() for parameter in decoder.parameters())]


# Largest error of the largest gradient, and share of the values that rays touch within 1e-4 of it; worst of twelve random fields with and
# without a shell: densities 7e-4 and 0.9995, features 1e-3 and 0.9994, first layer 2e-4 and 0.991, all others 9e-5 and 1. A place within a
# voxel is worth few digits in float32, and features and the weights behind them are found at sines of it, up to 16π times as steep: the
# torch engine is as far from float64 as that too (features 5e-4, 0.9995).
BOUNDS = {"density_rows": (1e-3, 0.999), "feature_rows": (1.5e-3, 0.999), "body.0.weight": (5e-4, 0.99)}
CLEAR = 2e-3  # the same steepness puts a hidden unit whose input is nearer to zero on the other side of its ReLU


@pytest.mark.parametrize(("seed", "threads", "rates"), [(0, 1, RATES), (1, 3, RATES), (2, 1, SLOW)])
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_gradients_agree(shell: float, seed: int, threads: int, rates: Rates, every_sample: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled, torch, and torch in float64, on rays of which rounding cannot put a hidden unit on the other side of its ReLU."""
    field = random_field(shell, 32, "per_sample", keep=0.5, raw=-3.5, seed=seed)
    pool = PixelPool(made_views(), depth=True)
    picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(seed))[:600]
    picks = picks[clear_of_zero(field, pool.take(picks), CLEAR)]
    assert len(picks) > 60
    exact = exact_gradients(field, weighed(pool, picks), rates)
    with monkeypatch.context() as patch:
        # In float32 the reference's own angles are off by 1e-5.
        patch.setattr("fieldfuse.nerfusion.decoder.positional", lambda values, count: positional(values.double(), count).float())
        reference = torch_gradients(field, weighed(pool, picks), rates)
    compiled = gradients(NumbaPerSampleOptimiser(field, pool, threads=threads), picks, monkeypatch, rates)
    names = ["density_rows", "feature_rows", *(name for name, _ in field.decoder.named_parameters())]
    for name, wanted, of_torch, of_ours in zip(names, exact, reference, compiled, strict=True):
        scale = float(wanted.abs().max())
        assert scale > 0
        most, share = BOUNDS.get(name, (1e-4, 1.0))
        for one, other in ((of_ours, of_torch), (of_ours, wanted), (of_torch, wanted)):
            error = (one.double() - other.double()).abs() / scale
            touched = (one != 0) | (other != 0)
            assert float(error.max()) <= most, name
            assert float((error[touched] <= 1e-4).double().mean()) >= share, name
            # Of all values of the lattice, those that no ray touches included.
            assert wanted.numel() <= 10_000 or float((error <= 1e-4).double().mean()) >= 0.9995, name
            assert float((one.double() - other.double()).norm()) < 5e-4 * float(wanted.norm()), name


def test_what_is_left_out_has_no_weight(monkeypatch: pytest.MonkeyPatch, every_sample: None) -> None:
    """Rays end where their light is spent; gradients are the same within half a hundredth: those of the rows, and the decoder's as one, of
    which what gives density is a small part that nearly cancels."""
    field = made_field(1.0, 0.5, -2.5)
    pool = PixelPool(made_views(), depth=True)
    picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(2))[:200]
    whole = NumbaPerSampleOptimiser(field, pool, threads=1)
    wanted = gradients(whole, picks, monkeypatch)
    monkeypatch.undo()
    ended = NumbaPerSampleOptimiser(field, pool, threads=1)
    got = gradients(ended, picks, monkeypatch)
    assert int(ended.visits.sum()) < 0.8 * int(whole.visits.sum())
    for values, others in ((got[:1], wanted[:1]), (got[1:2], wanted[1:2]), (got[2:], wanted[2:])):
        value, other = (torch.cat([part.reshape(-1) for part in parts]) for parts in (values, others))
        assert float((value - other).norm()) < 5e-3 * float(other.norm())


@pytest.mark.usefixtures("every_sample")
def test_a_step_moves_rows_as_the_reference_does() -> None:
    """Three steps of both engines on the same pixels: the same field, within what a sign flip of a vanishing gradient may do."""
    pool = PixelPool(made_views(), depth=True)
    fields = [made_field(1.0, 0.5, -3.5) for _ in range(2)]
    rates = replace(RATES, density=0.1, feature=0.05, decoder=1e-3)
    reference, fused = Optimiser(fields[0]), NumbaPerSampleOptimiser(fields[1], pool, threads=2)
    before = fields[0].feature_rows.clone()
    for number in range(3):
        picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(number))[:400]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "rand", lambda *size, generator=None: torch.zeros(*size))
            a = reference.step(pool.take(picks), rates, torch.Generator())
        b = fused.step_on(picks.numpy(), np.zeros(400, np.float32), rates)
        assert b[0] == pytest.approx(a[0], rel=2e-4)
        if number == 0:  # no row has moved yet, so every voxel was seen alike
            seen = reference.seen > 0.01
            assert bool(seen.any())
            torch.testing.assert_close(fused.seen[seen], reference.seen[seen], atol=1e-2, rtol=0)
    moved = (fields[0].feature_rows - before).abs() > 1e-3
    assert float(moved.float().mean()) > 0.01
    for name in ("feature_rows", "density_rows"):
        difference = (getattr(fields[0], name) - getattr(fields[1], name)).abs().flatten()
        assert float((difference < 2e-3).float().mean()) > 0.99
    fused.sync()
    for a_weight, b_weight in zip(fields[0].decoder.parameters(), fields[1].decoder.parameters(), strict=True):
        torch.testing.assert_close(a_weight, b_weight, atol=5e-4, rtol=1e-3)
    seen = reference.seen > 0.01
    assert bool(seen.any())
    # Later steps look at rows of which, as above, a few went the other way; how many depends on the processor's rounding.
    assert float(((fused.seen - reference.seen)[seen].abs() < 1e-2).float().mean()) > 0.995


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_field(threads: int) -> None:
    """Bit for bit, for a fixed number of threads."""
    pool = PixelPool(made_views(), depth=True)
    results = []
    for _ in range(2):
        field = made_field(1.0, 0.5, -2.5)
        engine = NumbaPerSampleOptimiser(field, pool, seed=4, threads=threads)
        for _ in range(5):
            engine.step(256, replace(RATES, density=0.1, feature=0.05, decoder=1e-3))
        results.append(engine.sync())
    assert torch.equal(results[0].density_rows, results[1].density_rows)
    assert torch.equal(results[0].feature_rows, results[1].feature_rows)
    for a, b in zip(results[0].decoder.parameters(), results[1].decoder.parameters(), strict=True):
        assert torch.equal(a, b)


def test_colours_during_a_fit_are_those_of_the_field() -> None:
    """After steps and `sync`, torch sees the same pictures."""
    field = made_field(1.0, 0.5, -2.5)
    engine = NumbaPerSampleOptimiser(field, PixelPool(made_views(), depth=True), threads=1)
    for _ in range(3):
        engine.step(128, replace(RATES, density=0.1, feature=0.05, decoder=1e-2))
    origins, directions = random_rays(200)
    torch.testing.assert_close(
        engine.colours(origins, directions), render_rays(engine.sync(), origins, directions).colour, atol=2e-4, rtol=0
    )


def test_pruned_voxels_are_left_alone() -> None:
    """Rays through nothing are background, and move nothing."""
    field = made_field(1.0, 1.0, -2.5)
    engine = NumbaPerSampleOptimiser(field, PixelPool(made_views(), depth=True), seed=1, threads=1)
    engine.go_on_with(replace(field, occupied=torch.zeros_like(field.occupied)))
    before = field.density_rows.clone()
    error, looked = engine.step(256, replace(RATES, density=0.1, feature=0.05))
    assert looked == 0 and np.isfinite(error) and engine.next_record == 0
    assert torch.equal(before, field.density_rows)
