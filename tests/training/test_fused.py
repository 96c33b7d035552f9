"""The compiled engine against the torch reference: colours, gradients, the optimiser's step, and independence of threads."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.backends.numba import train_decoder, train_order
from fieldfuse.backends.numba.decode import RAYS, decode, layers_of
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.encoding import spherical_harmonics
from fieldfuse.render.numba_renderer import NumbaRenderer, decoder_arrays
from fieldfuse.render.rays import render_rays
from fieldfuse.training.depth import ROUGH
from fieldfuse.training.numba_engine import NumbaOptimiser
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Optimiser, Rates
from tests.render.made import random_field, random_rays
from tests.training.gradients import exact_gradients, some_weights, torch_gradients, weighed

RATES = Rates(0.0, 0.0, 0.0, 0.01, 0.03, depth=0.05)
SLOW = replace(RATES, slow_within=3.0, depth_noise=ROUGH.noise)  # the made views look from 3 away: half of what they see moves slowly


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
    depths[-1] = None  # one picture whose depth nobody knows
    return Views([f"{i}" for i in range(count)], images, lens, poses, np.zeros(count, bool), depths=depths)


@pytest.mark.parametrize("shell", [0.0, 1.0])
@pytest.mark.parametrize("keep", [1.0, 0.3, 0.02])
def test_pictures_agree(shell: float, keep: float) -> None:
    field = random_field(shell, 32, keep=keep, raw=-2.0)
    origins, directions = random_rays(500)
    if shell:
        origins = origins * torch.linspace(0.02, 3, 500)[:, None]
    expected = render_rays(field, origins, directions)
    got = NumbaRenderer(field, 1).render(origins, directions)
    assert float(expected.opacity.std()) > 0 and float(expected.colour.std()) > 0.05
    torch.testing.assert_close(got[:, :3], expected.colour, atol=1e-4, rtol=0)
    torch.testing.assert_close(got[:, 4], expected.opacity, atol=1e-4, rtol=0)
    # The distance jumps where the light left passes one half within rounding of a sample's border.
    close = (got[:, 3] - expected.distance).abs() < 1e-3 * (1 + expected.distance)
    assert float(close.float().mean()) > 0.99


def gradients(engine: NumbaOptimiser, picks: torch.Tensor, rates: Rates = RATES) -> list[torch.Tensor]:
    """Dense gradients of densities and features, and the decoder's in the order of its parameters."""
    field, counts = engine.field, {}

    def keep_sums(width: object, volume: object, index: np.ndarray, *rest: object) -> None:
        thread, used = rest[5:7]
        counts[thread] = used

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fieldfuse.training.numba_engine.moves.adam_pass", keep_sums)
        engine.step_on(picks.numpy(), np.zeros(len(picks), np.float32), rates, some_weights(len(picks)).numpy())
    assert len(counts) == engine.threads
    dense = [torch.zeros_like(field.density_rows), torch.zeros_like(field.feature_rows)]
    for thread, used in counts.items():
        rows = torch.from_numpy(engine.touched[thread, :used].astype(np.int64))
        dense[0].index_add_(0, rows, torch.from_numpy(engine.density_sums[thread, :used]))
        dense[1].index_add_(0, rows, torch.from_numpy(engine.feature_sums[thread, :used]))
    totals = [train_decoder.in_order(block.tape.total) for block in engine.blocks]
    for number, layer in enumerate(field.decoder.layers):
        weight, bias = (torch.from_numpy(sum(total[number][part] for total in totals)) for part in (0, 1))
        dense += [weight[: layer.out_features, : layer.in_features], bias[: layer.out_features]]
    return dense


@pytest.mark.parametrize(("seed", "threads", "rates"), [(0, 1, RATES), (1, 3, RATES), (2, 1, SLOW)])
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_gradients_agree(shell: float, seed: int, threads: int, rates: Rates) -> None:
    """Compiled, torch, and torch in float64: within 1e-4 of the largest, every value of every tensor."""
    field = random_field(shell, 32, keep=0.5, raw=-2.5, seed=seed)
    pool = PixelPool(made_views(), depth=True)
    picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(seed))[:300]
    exact = exact_gradients(field, weighed(pool, picks), rates)
    reference = torch_gradients(field, weighed(pool, picks), rates)
    compiled = gradients(NumbaOptimiser(field, pool, threads=threads), picks, rates)
    for wanted, of_torch, of_ours in zip(exact, reference, compiled, strict=True):
        scale = float(wanted.abs().max())
        assert scale > 0
        for one, other in ((of_ours, of_torch), (of_ours, wanted), (of_torch, wanted)):
            assert float((one.double() - other.double()).abs().max()) <= 1e-4 * scale


@pytest.mark.parametrize("rays", [0, 1, 3, 4, 31, RAYS])
@pytest.mark.parametrize(("channels", "hidden"), [(16, 96), (8, 32), (5, 20)])
def test_a_few_rays_are_decoded_as_by_torch(channels: int, hidden: int, rays: int) -> None:
    """Colours and all gradients of a block of rays, twice in a row, against autograd in float64; widths that are no whole number of lanes
    are padded with zeros, which stay zero; rows beyond the block's rays, here not a number, do not matter."""
    generator = torch.Generator().manual_seed(rays)
    decoder = Deferred(channels, hidden)
    layers = layers_of(decoder_arrays(decoder))
    turned, tape = train_decoder.turned(layers, channels), train_decoder.make_tape(layers, channels)
    exact = copy.deepcopy(decoder).double()
    features = torch.randn(2, rays, channels, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(2, rays, 3, generator=generator), dim=-1)
    g_colour = torch.randn(2, rays, 3, generator=generator)
    train_decoder.forget_gradients(tape.total)
    for block in range(2):
        given = features[block].double().requires_grad_(True)
        colour = exact(given, directions[block].double())
        colour.backward(g_colour[block].double())
        tape.given[:rays, :channels] = features[block].numpy()
        tape.given[:rays, channels : channels + 16] = spherical_harmonics(directions[block]).numpy()
        tape.given[rays:] = np.nan
        decode(layers, tape, rays)
        np.testing.assert_allclose(tape.colour[:rays], colour.detach(), atol=1e-5)
        tape.g_logit[:rays] = (g_colour[block].double() * colour * (1 - colour)).detach()
        train_decoder.decode_backward(layers, turned, tape, rays)
        np.testing.assert_allclose(tape.g_given[:rays, :channels], given.grad, atol=1e-5)
    for layer, (weight, bias) in zip(exact.layers, train_decoder.in_order(tape.total), strict=True):
        for got, wanted in ((weight, layer.weight), (bias, layer.bias)):
            own = tuple(slice(0, size) for size in wanted.shape)
            np.testing.assert_allclose(got[own], 0 if wanted.grad is None else wanted.grad, atol=1e-4)
            rest = got.copy()
            rest[own] = 0
            assert not rest.any()


def test_a_step_moves_rows_as_the_reference_does() -> None:
    """Three steps of both engines on the same pixels: the same field, within what a sign flip of a vanishing gradient may do."""
    pool = PixelPool(made_views(), depth=True)
    fields = [random_field(1.0, 32, keep=0.5, raw=-2.5) for _ in range(2)]
    rates = replace(RATES, density=0.1, feature=0.05, decoder=1e-3)
    reference, fused = Optimiser(fields[0]), NumbaOptimiser(fields[1], pool, threads=2)
    before = fields[0].feature_rows.clone()
    for number in range(3):
        picks = torch.randperm(len(pool), generator=torch.Generator().manual_seed(number))[:400]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "rand", lambda *size, generator=None: torch.zeros(*size))
            a = reference.step(pool.take(picks), rates, torch.Generator())
        b = fused.step_on(picks.numpy(), np.zeros(400, np.float32), rates)
        assert b[0] == pytest.approx(a[0], rel=1e-4)
    moved = (fields[0].feature_rows - before).abs() > 1e-3
    assert float(moved.float().mean()) > 0.01
    for name in ("feature_rows", "density_rows"):
        difference = (getattr(fields[0], name) - getattr(fields[1], name)).abs()
        assert float(difference.quantile(0.999) if difference.numel() < 1e6 else difference.flatten()[::7].quantile(0.999)) < 1e-3
    fused.sync()
    for a_weight, b_weight in zip(fields[0].decoder.parameters(), fields[1].decoder.parameters(), strict=True):
        torch.testing.assert_close(a_weight, b_weight, atol=2e-4, rtol=1e-3)
    seen = reference.seen > 0.01
    assert bool(seen.any())
    torch.testing.assert_close(fused.seen[seen], reference.seen[seen], atol=1e-3, rtol=0)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_field(threads: int) -> None:
    """Bit for bit, for a fixed number of threads."""
    pool = PixelPool(made_views(), depth=True)
    results = []
    for _ in range(2):
        field = random_field(1.0, 32, keep=0.5, raw=-2.5)
        engine = NumbaOptimiser(field, pool, seed=4, threads=threads)
        for _ in range(5):
            engine.step(256, replace(RATES, density=0.1, feature=0.05, decoder=1e-3))
        results.append(engine.sync())
    assert torch.equal(results[0].density_rows, results[1].density_rows)
    assert torch.equal(results[0].feature_rows, results[1].feature_rows)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.lists(st.floats(0, 200, width=32), min_size=1, max_size=300))
def test_threads_get_equal_work(threads: int, work: list[float]) -> None:
    """Every part is within one ray of its due; together they are the whole batch."""
    memory = np.zeros((len(work), 2), np.float32)
    memory[:, 1] = work
    tiles = np.random.default_rng(0).permutation(len(work)).astype(np.int32)
    cuts = np.array([0, *[-1] * (threads - 1), len(work)], np.int64)
    train_order.share(tiles, memory, cuts)
    assert (np.diff(cuts) >= 0).all()
    each = memory[tiles, 1].astype(float) + train_order.RAY_WORK
    for part in range(threads):
        got = each[cuts[part] : cuts[part + 1]].sum()
        assert abs(got - each.sum() / threads) <= each.max() * 1.01


@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_is_drawn_anew_when_what_is_asked_for_changes(threads: int) -> None:
    """The order of a batch is found beside the step before it, and dropped when its size or its pixels are no longer those wanted."""
    pool = PixelPool(made_views(), depth=True)
    engine, got = NumbaOptimiser(random_field(0.0, 32, keep=0.5, raw=-2.5), pool, threads=threads), []
    original = engine._gradients

    def noted(thread: int, part: slice, picks: np.ndarray, *rest: object) -> tuple[int, float, int]:
        got.append((part, picks))
        return original(thread, part, picks, *rest)  # type: ignore[arg-type]

    engine._gradients = noted  # type: ignore[method-assign,assignment]
    batches = []
    for rays, limit in ((200, len(pool)), (200, len(pool)), (200, 50), (120, 50), (120, 50)):
        pool.limit = limit
        got.clear()
        engine.step(rays, RATES)
        assert {id(picks) for _, picks in got} == {id(got[0][1])}
        batches.append(got[0][1])
        assert len(batches[-1]) == rays and batches[-1].max() < limit
        assert sorted(i for part, _ in got for i in range(part.start, part.stop)) == list(range(rays))
    assert len({tuple(batch) for batch in batches}) == len(batches)


@pytest.mark.parametrize("threads", [1, 2])
def test_numbers_of_rows_begin_again_before_they_are_too_large(threads: int) -> None:
    """What a batch notes of its rows is never wiped but outgrown; before 32 bits are full all begins anew, and nothing else changes."""
    pool, fields = PixelPool(made_views(), depth=True), []
    for late in (False, True):
        engine = NumbaOptimiser(random_field(1.0, 32, keep=0.5, raw=-2.5), pool, seed=4, threads=threads)
        first = np.iinfo(np.int32).max - len(engine.index) if late else 0
        engine.bases[:], bases = first, [first]
        for _ in range(4):
            engine.step(256, replace(RATES, density=0.1, feature=0.05, decoder=1e-3))
            bases.append(int(engine.bases[0]))
        assert bases[1] == first and (0 in bases[2:]) == late  # the first batch fits, the second might not
        fields.append(engine.sync())
    assert torch.equal(fields[0].density_rows, fields[1].density_rows)
    assert torch.equal(fields[0].feature_rows, fields[1].feature_rows)


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_a_thread_that_fails_is_heard_and_stops_the_others(failing: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """They wait for each other within a step; none waits for one that does not come, and the next step is as good as any."""
    engine = NumbaOptimiser(random_field(1.0, 32, keep=0.5, raw=-2.5), PixelPool(made_views(), depth=True), threads=3)
    original = engine._gradients

    def spoilt(thread: int, *rest: object) -> tuple[int, float, int]:
        if thread == failing:
            raise OSError(f"thread {thread} has had enough")
        return original(thread, *rest)  # type: ignore[arg-type]

    before = engine.field.density_rows.clone()
    with monkeypatch.context() as patch:
        patch.setattr(engine, "_gradients", spoilt)
        with pytest.raises(OSError, match=f"thread {failing} has had enough"):
            engine.step(256, replace(RATES, density=0.1))
    assert torch.equal(before, engine.field.density_rows)
    error, looked = engine.step(256, replace(RATES, density=0.1))
    assert np.isfinite(error) and looked > 0 and not torch.equal(before, engine.field.density_rows)


def test_pruned_voxels_are_left_alone() -> None:
    """After pruning rows stay where they are, so the optimiser state stays good and erased voxels get no gradient."""
    pool = PixelPool(made_views(), depth=True)
    field = random_field(1.0, 32, keep=1.0, raw=-2.5)
    engine = NumbaOptimiser(field, pool, seed=1, threads=1)
    engine.step(256, replace(RATES, density=0.1, feature=0.05))
    records = engine.next_record
    empty = replace(field, occupied=torch.zeros_like(field.occupied))
    engine.go_on_with(empty)
    before = field.density_rows.clone()
    error, looked = engine.step(256, replace(RATES, density=0.1, feature=0.05))
    assert looked == 0 and np.isfinite(error) and engine.next_record == records
    assert torch.equal(before, field.density_rows)
