"""The engine for CUDA against the torch reference. Without a GPU its kernels run in Triton's interpreter, with one on it."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fieldfuse.render.field import Field
from fieldfuse.render.rays import render_rays
from fieldfuse.training.losses import ROUGH, Rates
from fieldfuse.training.nonfinite_policy import NotFiniteError
from fieldfuse.training.pixels import TOP, PixelPool, TileErrors
from fieldfuse.training.torch_engine import TorchEngine
from tests.render.made import random_field, random_rays
from tests.training.gradients import exact_gradients, made_views, weighed

triton = pytest.importorskip("triton", reason="triton is not installed: it comes with torch for CUDA, and with `make test` on Linux")

from fieldfuse.config import load_settings  # noqa: E402
from fieldfuse.render.triton_renderer import TritonRenderer, bricks_to_skip  # noqa: E402
from fieldfuse.training.engine import use_every_kernel  # noqa: E402
from fieldfuse.training.triton_engine import TritonEngine  # noqa: E402

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
RATES = Rates(0.0, 0.0, 0.0, 0.01, 0.03, depth=0.05, slow_within=3.0, depth_noise=ROUGH.noise)
RAYS = 32  # one program's


@pytest.fixture(autouse=True)
def unchecked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Triton's interpreter looks for overflow at each sum and product of integers, half of its time: here where pixels are drawn alone."""
    if triton.knobs.runtime.interpret and request.function is not test_pixels_are_drawn_by_their_tiles_errors:
        from triton.runtime.interpreter import interpreter_builder

        monkeypatch.setattr(interpreter_builder, "options", replace(interpreter_builder.options, sanitize_overflow=False))


def field_of(shell: float, keep: float = 0.5, seed: int = 0, raw: float = -1.0) -> Field:
    return random_field(shell, 16, keep=keep, raw=raw, seed=seed)


def engine_of(field: Field, views: object = None, **options: object) -> TritonEngine:
    return TritonEngine(copy.deepcopy(field).to(DEVICE), PixelPool(views or made_views(), DEVICE, depth=True), **options)


def picks(pool: PixelPool, seed: int = 0) -> torch.Tensor:
    return torch.randperm(len(pool), generator=torch.Generator().manual_seed(seed))[:RAYS]


@pytest.mark.parametrize(("shell", "keep", "rays"), [(0.0, 1.0, RAYS), (0.0, 0.03, RAYS + 9), (1.0, 0.3, RAYS - 9)])
def test_pictures_agree(shell: float, keep: float, rays: int) -> None:
    field = field_of(shell, keep, raw=0.0)
    origins, directions = random_rays(rays)
    if shell:
        origins = origins * torch.linspace(0.02, 3, len(origins))[:, None]
    expected = render_rays(field, origins, directions)
    got = TritonRenderer(copy.deepcopy(field).to(DEVICE), RAYS)(origins, directions)
    assert float(expected.opacity.std()) > 0 and float(expected.colour.std()) > 0.05
    torch.testing.assert_close(got.colour.cpu(), expected.colour, atol=1e-4, rtol=0)
    torch.testing.assert_close(got.opacity.cpu(), expected.opacity, atol=1e-4, rtol=0)
    # The distance jumps where the light left passes one half within rounding of a sample's border.
    close = (got.distance.cpu() - expected.distance).abs() < 1e-3 * (1 + expected.distance)
    assert float(close.float().mean()) > 0.98


@pytest.mark.parametrize(("shell", "seed"), [(0.0, 0), (1.0, 1)])
def test_gradients_agree(shell: float, seed: int) -> None:
    """Within 1e-4 of the largest of those in float64, every value of every tensor, as the compiled engine's are."""
    field, pool = field_of(shell, seed=seed), PixelPool(made_views(), depth=True)
    chosen = picks(pool, seed)
    exact = exact_gradients(field, weighed(pool, chosen), RATES)
    engine = engine_of(field)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "_move", lambda: None)
        engine.step_on(weighed(engine.pool, chosen.to(DEVICE)), RATES, torch.zeros(RAYS, device=DEVICE))
    for wanted, got in zip(exact, [engine.g_density, engine.g_feature, *engine.decoder.gradients], strict=True):
        scale = float(wanted.abs().max())
        assert scale > 0
        assert float((got.cpu().double() - wanted).abs().max()) <= 1e-4 * scale


def test_steps_agree() -> None:
    """Two steps: rows, decoder, what was seen and how often, as the reference has them."""
    field, rates = field_of(1.0, raw=0.0), replace(RATES, density=0.02, feature=0.03, decoder=0.004)
    engine, start = engine_of(field), field.feature_rows.clone()
    pool = PixelPool(made_views(), depth=True)
    reference = TorchEngine(field, pool)
    for seed in range(2):
        chosen = picks(pool, seed)
        jitter = torch.rand(RAYS, generator=torch.Generator().manual_seed(seed))
        error, _ = reference.step_on(weighed(pool, chosen), rates, jitter)
        assert engine.step_on(weighed(engine.pool, chosen.to(DEVICE)), rates, jitter.to(DEVICE)) == pytest.approx(error, rel=1e-4)
    assert float((field.feature_rows - start).abs().max()) > 0.03
    for wanted, got in zip([field.density_rows, field.feature_rows], [engine.field.density_rows, engine.field.feature_rows], strict=True):
        # Where a gradient is next to nothing a step of Adam still has full length, in a direction that last digits decide.
        assert float(((got.cpu() - wanted).abs() > 1e-3).float().mean()) < 1e-3
    for wanted, got in zip(field.decoder.parameters(), engine.field.decoder.parameters(), strict=True):
        torch.testing.assert_close(got.detach().cpu(), wanted.detach(), atol=1e-5, rtol=0)
    torch.testing.assert_close(engine.seen.cpu(), reference.seen, atol=1e-4, rtol=0)
    torch.testing.assert_close(engine.visits.cpu(), reference.visits, atol=1, rtol=0)


def test_pixels_are_drawn_by_their_tiles_errors() -> None:
    """Rays are those of unmasked pixels before the limit; how many come from a tile goes with its density, and each counts its inverse."""
    views = made_views(count=3)
    views.valid = [np.random.default_rng(0).random((24, 24)) < 0.7 for _ in range(3)]
    engine = engine_of(field_of(0.0), views)
    pool = engine.pool
    pool.limit = int(pool.starts[2])
    engine.tile_density.copy_(torch.linspace(0.2, TOP, len(engine.tile_density)))
    every = pool.take(torch.arange(len(pool), device=DEVICE))
    tiles = TileErrors(pool).tiles(torch.arange(len(pool), device=DEVICE))
    rays = 256
    engine.limit.fill_(pool.limit)
    engine._stage(RATES)
    engine._room_for(rays)
    counts = torch.zeros(len(engine.tile_density))
    for step in range(2):
        engine.state[0] = step
        engine._draw(rays)
        around = engine.buffers[0]
        # The pixel of each ray: that of the same camera and direction.
        apart = torch.cdist(around[:6].T, torch.cat([every.origins, every.directions], 1), compute_mode="donot_use_mm_for_euclid_dist")
        nearest, pixel = apart.min(1)
        assert float(nearest.max()) < 1e-4 and int(pixel.max()) < pool.limit
        torch.testing.assert_close(around[6:9].T, every.colour[pixel], atol=1e-6, rtol=0)
        assert every.distance is not None
        torch.testing.assert_close(around[10], every.distance[pixel], atol=1e-6, rtol=0)
        assert torch.equal(engine.tiles.long(), tiles[pixel])
        torch.testing.assert_close(around[9], 1 / (engine.tile_density[tiles[pixel]] * rays))
        assert float(around[11].min()) >= 0 and float(around[11].max()) < 1 and 0.4 < float(around[11].mean()) < 0.6
        counts += torch.bincount(engine.tiles.cpu().long(), minlength=len(counts))
    before = tiles[: pool.limit].cpu()
    expected = torch.bincount(before, minlength=len(counts)) * engine.tile_density.cpu()
    expected *= 2 * rays / expected.sum()
    some = expected > 5
    chi = ((counts - expected)[some] ** 2 / expected[some]).sum()
    assert float(chi) < int(some.sum()) + 5 * (2 * int(some.sum())) ** 0.5


def test_what_is_not_finite_moves_nothing() -> None:
    engine = engine_of(field_of(0.0, raw=1.0))
    rates = replace(RATES, density=0.02, feature=0.03, decoder=0.004)
    good = engine.pool.take(picks(engine.pool).to(DEVICE))
    jitter = torch.zeros(RAYS, device=DEVICE)
    engine.step_on(good, rates, jitter)
    everything = [engine.field.density_rows, engine.field.feature_rows, engine.second_density, engine.second_feature, engine.touch_steps]
    everything += [engine.decoder.values, engine.decoder.first, engine.decoder.second]
    before = [value.clone() for value in everything]
    colour = good.colour.clone()
    colour[3, 1] = float("nan")
    with pytest.raises(NotFiniteError, match="not finite"):
        engine.step_on(replace(good, colour=colour), rates, jitter)
    for was, value in zip(before, everything, strict=True):
        assert torch.equal(was, value)
    assert not engine.touched.any() and not engine.g_feature.any() and not engine.g_density.any()
    engine.step_on(good, rates, jitter)
    assert not torch.equal(before[1], engine.field.feature_rows)


def test_the_skipped_distance_is_that_to_the_nearest_brick() -> None:
    bricks = torch.zeros(9, 9, 9, dtype=torch.bool)
    bricks[2, 3, 4] = bricks[7, 7, 1] = True
    z, y, x = torch.meshgrid(*[torch.arange(9)] * 3, indexing="ij")
    wanted = torch.minimum(
        torch.stack([(z - 2).abs(), (y - 3).abs(), (x - 4).abs()]).amax(0),
        torch.stack([(z - 7).abs(), (y - 7).abs(), (x - 1).abs()]).amax(0),
    )
    assert torch.equal(bricks_to_skip(bricks).view(9, 9, 9), wanted.to(torch.uint8))


def test_every_kernel_is_warmed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that a fit calls runs once, pruning and a finer lattice between."""
    if DEVICE.type == "cpu":
        monkeypatch.setattr(TritonEngine, "EAGER", -1)  # nothing is recorded here: one step instead of four
        monkeypatch.setattr("fieldfuse.training.engine.make_renderer", TritonRenderer)
    use_every_kernel(TritonEngine, load_settings(pairs=["field.channels=4", "field.hidden=8"]), DEVICE, 32)


@pytest.mark.skipif(sys.platform != "linux", reason="Triton compiles on Linux")
def test_kernels_compile_without_a_gpu(tmp_path: Path) -> None:
    """With the types and constants of a fit, for a GPU that need not be there: the interpreter takes what the compiler refuses."""
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path)}
    environment.pop("TRITON_INTERPRET", None)
    command = [sys.executable, "-m", "tests.training.triton_ahead"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=Path(__file__).parents[2], timeout=500)
    assert done.returncode == 0, done.stderr[-2000:]
    names = "composite count_step draw inspect judge learn move spread walk"
    assert done.stdout.splitlines()[0] == names
