"""The compiled engine against the torch reference, for both decoders: colours, gradients, the optimiser's step, and threads."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.backends.numba import decode, per_sample, train_batch
from fieldfuse.backends.numba.matrix import add_outer, product
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.nerfusion.encoding import positional, spherical_harmonics
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import NumbaRenderer, decoder_arrays
from fieldfuse.render.rays import render_rays
from fieldfuse.training.losses import ROUGH, Rates
from fieldfuse.training.numba_engine import NumbaEngine, PerSampleDecoder
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.torch_engine import TorchEngine
from tests.render.made import random_field, random_rays
from tests.training.gradients import clear_of_zero, exact_gradients, made_views, numba_gradients, torch_gradients, weighed

DECODERS = ["deferred", "per_sample"]
RATES = Rates(0.0, 0.0, 0.0, 0.01, 0.03, depth=0.05)
SLOW = replace(RATES, slow_within=3.0, depth_noise=ROUGH.noise)  # the made views look from 3 away: half of what they see moves slowly
MOVING = replace(RATES, density=0.1, feature=0.05, decoder=1e-3)


@pytest.fixture(scope="module")
def pool() -> PixelPool:
    return PixelPool(made_views(), depth=True)


@pytest.fixture
def every_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiled engine looks at samples behind spent light too, as the reference does with the paper's decoder."""
    monkeypatch.setattr("fieldfuse.training.numba_engine.STOP", 0.0)
    monkeypatch.setattr(PerSampleDecoder, "threshold", -1.0)


def made_field(decoder: str, shell: float = 1.0, keep: float = 0.5, raw: float = -2.5, seed: int = 0) -> Field:
    return random_field(shell, 32, decoder, keep=keep, raw=raw, seed=seed)


def some_picks(pool: PixelPool, seed: int, count: int) -> torch.Tensor:
    return torch.randperm(len(pool), generator=torch.Generator().manual_seed(seed))[:count]


@pytest.mark.parametrize("decoder", DECODERS)
@pytest.mark.parametrize("shell", [0.0, 1.0])
@pytest.mark.parametrize("keep", [1.0, 0.3, 0.02])
def test_renders_agree(decoder: str, shell: float, keep: float) -> None:
    field = made_field(decoder, shell, keep, -2.0)
    # Now and then a ray ends a sample earlier in one of the two, within rounding of STOP: none of these.
    origins, directions = random_rays(500, 1)
    if shell:
        origins = origins * torch.linspace(0.02, 3, 500)[:, None]
    expected = render_rays(field, origins, directions)
    got = NumbaRenderer(field, 1).render(origins, directions)
    assert float(expected.opacity.std()) > 0 and float(expected.colour.std()) > 0.05
    torch.testing.assert_close(got[:, :3], expected.colour, atol=1e-4, rtol=0)
    # With the paper's decoder a ray ends where less than STOP of its light is left, which the reference looks at too: 1e-4, and rounding.
    torch.testing.assert_close(got[:, 4], expected.opacity, atol=1e-4 if decoder == "deferred" else 2e-4, rtol=0)
    # The distance jumps where the light left passes one half within rounding of a sample's border.
    close = (got[:, 3] - expected.distance).abs() < 1e-3 * (1 + expected.distance)
    assert float(close.float().mean()) > 0.99
    assert torch.equal(got, NumbaRenderer(field, 2).render(origins, directions))


@pytest.mark.parametrize(("seed", "threads", "rates"), [(0, 1, RATES), (1, 3, RATES), (2, 1, SLOW)])
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_gradients_agree(shell: float, seed: int, threads: int, rates: Rates, pool: PixelPool) -> None:
    """Compiled, torch, and torch in float64: within 1e-4 of the largest, every value of every tensor."""
    field, picks = made_field("deferred", shell, seed=seed), some_picks(pool, seed, 300)
    exact = exact_gradients(field, weighed(pool, picks), rates)
    reference = torch_gradients(field, weighed(pool, picks), rates)
    compiled = numba_gradients(NumbaEngine(field, pool, threads=threads), picks, rates)
    for wanted, of_torch, of_ours in zip(exact, reference, compiled, strict=True):
        scale = float(wanted.abs().max())
        assert scale > 0
        for one, other in ((of_ours, of_torch), (of_ours, wanted), (of_torch, wanted)):
            assert float((one.double() - other.double()).abs().max()) <= 1e-4 * scale


# Largest error of the largest gradient, and share of the values that rays touch within 1e-4 of it; worst of twelve random fields with and
# without a shell: densities 7e-4 and 0.9995, features 1e-3 and 0.9994, first layer 2e-4 and 0.991, all others 9e-5 and 1. A place within a
# voxel is worth few digits in float32, and features and the weights behind them are found at sines of it, up to 16π times as steep: the
# torch engine is as far from float64 as that too (features 5e-4, 0.9995).
BOUNDS = {"density_rows": (1e-3, 0.999), "feature_rows": (1.5e-3, 0.999), "body.0.weight": (5e-4, 0.99)}
CLEAR = 2e-3  # the same steepness puts a hidden unit whose input is nearer to zero on the other side of its ReLU


@pytest.mark.parametrize(("seed", "threads", "rates"), [(0, 1, RATES), (1, 3, RATES), (2, 1, SLOW)])
@pytest.mark.parametrize("shell", [0.0, 1.0])
@pytest.mark.usefixtures("every_sample")
def test_gradients_of_the_papers_decoder_agree(
    shell: float, seed: int, threads: int, rates: Rates, pool: PixelPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled, torch, and torch in float64, on rays of which rounding cannot put a hidden unit on the other side of its ReLU."""
    field, picks = made_field("per_sample", shell, raw=-3.5, seed=seed), some_picks(pool, seed, 600)
    picks = picks[clear_of_zero(field, pool.take(picks), CLEAR)]
    assert len(picks) > 60
    exact = exact_gradients(field, weighed(pool, picks), rates)
    with monkeypatch.context() as patch:
        # In float32 the reference's own angles are off by 1e-5.
        patch.setattr("fieldfuse.nerfusion.decoder.positional", lambda values, count: positional(values.double(), count).float())
        reference = torch_gradients(field, weighed(pool, picks), rates)
    compiled = numba_gradients(NumbaEngine(field, pool, threads=threads), picks, rates)
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


@pytest.mark.usefixtures("every_sample")
def test_what_is_left_out_has_no_weight(pool: PixelPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays end where their light is spent; gradients are the same within half a hundredth: those of the rows, and the decoder's as one, of
    which what gives density is a small part that nearly cancels."""
    field, picks = made_field("per_sample"), some_picks(pool, 2, 200)
    whole = NumbaEngine(field, pool, threads=1)
    wanted = numba_gradients(whole, picks, RATES)
    monkeypatch.undo()
    ended = NumbaEngine(field, pool, threads=1)
    got = numba_gradients(ended, picks, RATES)
    assert int(ended.visits.sum()) < 0.8 * int(whole.visits.sum())
    for values, others in ((got[:1], wanted[:1]), (got[1:2], wanted[1:2]), (got[2:], wanted[2:])):
        value, other = (torch.cat([part.reshape(-1) for part in parts]) for parts in (values, others))
        assert float((value - other).norm()) < 5e-3 * float(other.norm())


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
        per_sample.encode((0,) * 16, row)
    error = np.abs(given - wanted).max()
    assert error < 4e-6 and error < 2 * np.abs(positional(values, 5).numpy() - wanted).max() + 2e-6


@pytest.mark.parametrize(("channels", "hidden"), [(8, 16), (16, 32), (5, 20)])
def test_weights_survive_the_way_there_and_back(channels: int, hidden: int) -> None:
    """Widths that are padded too."""
    decoder, other = PerSample(channels, hidden), PerSample(channels, hidden)
    per_sample.write_net(per_sample.net_of(decoder), other)
    for name, value in decoder.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


@pytest.mark.parametrize("rays", [0, 1, 3, 4, 31, decode.RAYS])
@pytest.mark.parametrize(("channels", "hidden"), [(16, 96), (8, 32), (5, 20)])
def test_a_few_rays_are_decoded_as_by_torch(channels: int, hidden: int, rays: int) -> None:
    """Colours and all gradients of a block of rays, twice in a row, against autograd in float64; widths that are no whole number of lanes
    are padded with zeros, which stay zero; rows beyond the block's rays, here not a number, do not matter."""
    generator = torch.Generator().manual_seed(rays)
    decoder = Deferred(channels, hidden)
    layers = decode.layers_of(decoder_arrays(decoder))
    turned, tape = decode.turned(layers, channels), decode.make_tape(layers, channels)
    exact = copy.deepcopy(decoder).double()
    features = torch.randn(2, rays, channels, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(2, rays, 3, generator=generator), dim=-1)
    g_colour = torch.randn(2, rays, 3, generator=generator)
    decode.forget_gradients(tape.total)
    for block in range(2):
        given = features[block].double().requires_grad_(True)
        colour = exact(given, directions[block].double())
        colour.backward(g_colour[block].double())
        tape.given[:rays, :channels] = features[block].numpy()
        tape.given[:rays, channels : channels + 16] = spherical_harmonics(directions[block]).numpy()
        tape.given[rays:] = np.nan
        decode.decode(layers, tape, rays)
        np.testing.assert_allclose(tape.colour[:rays], colour.detach(), atol=1e-5)
        tape.g_logit[:rays] = (g_colour[block].double() * colour * (1 - colour)).detach()
        decode.decode_backward(layers, turned, tape, rays)
        np.testing.assert_allclose(tape.g_given[:rays, :channels], given.grad, atol=1e-5)
    for layer, (weight, bias) in zip(exact.layers, decode.in_order(tape.total), strict=True):
        for got, wanted in ((weight, layer.weight), (bias, layer.bias)):
            own = tuple(slice(0, size) for size in wanted.shape)
            np.testing.assert_allclose(got[own], 0 if wanted.grad is None else wanted.grad, atol=1e-4)
            rest = got.copy()
            rest[own] = 0
            assert not rest.any()


@pytest.mark.usefixtures("every_sample")
@pytest.mark.parametrize("decoder", DECODERS)
def test_a_step_moves_rows_as_the_reference_does(decoder: str, pool: PixelPool) -> None:
    """Three steps of both engines on the same pixels: the same field, within what a sign flip of a vanishing gradient may do."""
    fields = [made_field(decoder, raw=-2.5 if decoder == "deferred" else -3.5) for _ in range(2)]
    reference, compiled = TorchEngine(fields[0], pool), NumbaEngine(fields[1], pool, threads=2)
    before = fields[0].feature_rows.clone()
    for number in range(3):
        picks = some_picks(pool, number, 400)
        a = reference.step_on(pool.take(picks), MOVING, torch.zeros(400))
        b = compiled.step_on(picks.numpy(), np.zeros(400, np.float32), MOVING)
        assert b[0] == pytest.approx(a[0], rel=2e-4)
        if number == 0:  # no row has moved yet, so every voxel was seen alike
            seen = reference.seen > 0.01
            assert bool(seen.any())
            torch.testing.assert_close(compiled.seen[seen], reference.seen[seen], atol=1e-3 if decoder == "deferred" else 1e-2, rtol=0)
    moved = (fields[0].feature_rows - before).abs() > 1e-3
    assert float(moved.float().mean()) > 0.01
    for name in ("feature_rows", "density_rows"):
        difference = (getattr(fields[0], name) - getattr(fields[1], name)).abs()
        assert float((difference < (1e-3 if decoder == "deferred" else 2e-3)).float().mean()) > (0.999 if decoder == "deferred" else 0.99)
    compiled.sync()
    for a_weight, b_weight in zip(fields[0].decoder.parameters(), fields[1].decoder.parameters(), strict=True):
        torch.testing.assert_close(a_weight, b_weight, atol=2e-4 if decoder == "deferred" else 5e-4, rtol=1e-3)
    seen = reference.seen > 0.01
    # Later steps look at rows of which, as above, a few went the other way; how many depends on the processor's rounding.
    assert float(((compiled.seen - reference.seen)[seen].abs() < 1e-2).float().mean()) > 0.995


@pytest.mark.parametrize("decoder", DECODERS)
@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_field(decoder: str, threads: int, pool: PixelPool) -> None:
    """Bit for bit, for a fixed number of threads; and its colours are those that the engine has."""
    results = []
    for _ in range(2):
        engine = NumbaEngine(made_field(decoder), pool, seed=4, threads=threads)
        for _ in range(5):
            engine.step(256, MOVING)
        results.append(engine.sync())
    for a, b in zip(values_of(results[0]), values_of(results[1]), strict=True):
        assert torch.equal(a, b)
    origins, directions = random_rays(200)
    torch.testing.assert_close(engine.colours(origins, directions), render_rays(results[1], origins, directions).colour, atol=2e-4, rtol=0)


def values_of(field: Field) -> list[torch.Tensor]:
    return [field.density_rows, field.feature_rows, *field.decoder.parameters()]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.lists(st.floats(0, 200, width=32), min_size=1, max_size=300))
def test_threads_get_equal_work(threads: int, work: list[float]) -> None:
    """Every part is within one ray of its due; together they are the whole batch."""
    memory = np.zeros((len(work), 2), np.float32)
    memory[:, 1] = work
    tiles = np.random.default_rng(0).permutation(len(work)).astype(np.int32)
    cuts = np.array([0, *[-1] * (threads - 1), len(work)], np.int64)
    train_batch.split_work(tiles, memory, cuts)
    assert (np.diff(cuts) >= 0).all()
    each = memory[tiles, 1].astype(float) + train_batch.RAY_WORK
    for part in range(threads):
        got = each[cuts[part] : cuts[part + 1]].sum()
        assert abs(got - each.sum() / threads) <= each.max() * 1.01


@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_is_drawn_anew_when_its_size_or_pixels_change(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of a batch is found beside the step before it, and dropped when it is no longer the one wanted."""
    pool, got = PixelPool(made_views(), depth=True), []
    engine = NumbaEngine(made_field("deferred", 0.0), pool, threads=threads)
    original = engine.decoder.gradient_pass

    def noted(thread: int, around: object, pixels: object, part: train_batch.Part, *rest: object) -> tuple[int, float, int]:
        got.append(part.picks)
        return original(thread, around, pixels, part, *rest)

    monkeypatch.setattr(engine.decoder, "gradient_pass", noted)
    batches = []
    for rays, limit in ((200, len(pool)), (200, len(pool)), (200, 50), (120, 50), (120, 50)):
        pool.limit = limit
        got.clear()
        engine.step(rays, RATES)
        batches.append(np.sort(np.concatenate(got)))
        assert len(got) == threads and len(batches[-1]) == rays and batches[-1].max() < limit
    assert len({tuple(batch) for batch in batches}) == len(batches)


@pytest.mark.parametrize("threads", [1, 2])
def test_numbers_of_rows_begin_again_before_they_are_too_large(threads: int, pool: PixelPool) -> None:
    """What a batch notes of its rows is never wiped but outgrown; before 32 bits are full all begins anew, and nothing else changes."""
    fields = []
    for late in (False, True):
        engine = NumbaEngine(made_field("deferred"), pool, seed=4, threads=threads)
        first = np.iinfo(np.int32).max - len(engine.rows.index) if late else 0
        engine.rows.bases[:], bases = first, [first]
        for _ in range(4):
            engine.step(256, MOVING)
            bases.append(int(engine.rows.bases[0]))
        assert bases[1] == first and (0 in bases[2:]) == late  # the first batch fits, the second might not
        fields.append(engine.sync())
    for a, b in zip(values_of(fields[0]), values_of(fields[1]), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_a_thread_that_fails_is_heard_and_stops_the_others(failing: int, pool: PixelPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """They wait for each other within a step; none waits for one that does not come, and the next step is as good as any."""
    engine = NumbaEngine(made_field("deferred"), pool, threads=3)
    original = engine.decoder.gradient_pass

    def spoilt(thread: int, *rest: object) -> tuple[int, float, int]:
        if thread == failing:
            raise OSError(f"thread {thread} has had enough")
        return original(thread, *rest)

    before = engine.field.density_rows.clone()
    with monkeypatch.context() as patch:
        patch.setattr(engine.decoder, "gradient_pass", spoilt)
        with pytest.raises(OSError, match=f"thread {failing} has had enough"):
            engine.step(256, MOVING)
    assert torch.equal(before, engine.field.density_rows)
    error, looked = engine.step(256, MOVING)
    assert np.isfinite(error) and looked > 0 and not torch.equal(before, engine.field.density_rows)


@pytest.mark.parametrize("decoder", DECODERS)
def test_pruned_voxels_are_left_alone(decoder: str, pool: PixelPool) -> None:
    """After pruning rows stay where they are, so the optimiser state stays good and erased voxels get no gradient."""
    field = made_field(decoder, keep=1.0)
    engine = NumbaEngine(field, pool, seed=1, threads=1)
    engine.step(256, MOVING)
    records = sum(engine.given)
    engine.go_on_with(replace(field, occupied=torch.zeros_like(field.occupied)))
    before = field.density_rows.clone()
    error, looked = engine.step(256, MOVING)
    assert looked == 0 and np.isfinite(error) and sum(engine.given) == records > 0
    assert torch.equal(before, field.density_rows)
