"""Memory of a fit: estimated from the voxels that stay, refused or lowered with both numbers."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest
import torch

from fieldfuse import memory
from fieldfuse.errors import InputError
from fieldfuse.training import memory_limits
from fieldfuse.training.engine import make_engine
from fieldfuse.training.fit import Begin, fit_field
from fieldfuse.training.levels import finer
from fieldfuse.training.losses import Rates
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.schedule import Schedule
from fieldfuse.volume.grid import GridHost
from tests.pages import in_memory
from tests.training.test_fit import scene, sphere_views, ticking, wanted


def allow(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(memory, "available", lambda: free)


@pytest.fixture(scope="module")
def apart() -> Iterator[ProcessPoolExecutor]:
    """A process of its own: what tests before have freed is given out again, all of its pages in memory whoever wrote to them."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.mark.skipif(memory.madvise is None, reason="this system takes no pages back early")
@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
@pytest.mark.parametrize("threads", [1, 2])
def test_what_the_compiled_engine_needs_is_what_it_takes(decoder: str, threads: int, apart: ProcessPoolExecutor) -> None:
    held, foreseen, replacing = apart.submit(held_and_foreseen, decoder, threads).result()
    assert 0.8 * held < foreseen < 2 * held + threads * memory_limits.SUMS  # this ball has more of its rows touched than captures have
    assert replacing < foreseen


def held_and_foreseen(decoder: str, threads: int) -> tuple[float, int, int]:
    """Bytes of the rows' arrays, as the system holds them page by page after some steps on the finer lattice; what was foreseen of them,
    and what if they take the place of others."""
    settings = wanted(f"decoder={decoder}", "engine=numba", "budget=3", "field.resolution=64", f"threads={threads}")
    with pytest.MonkeyPatch.context() as patch:
        ticking(patch, 0.1)
        field = fit_field(sphere_views(), scene(), settings).field
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    host = GridHost()
    grown = finer(field, torch.ones_like(field.occupied), 128, host)
    engine = make_engine(settings, grown, PixelPool(sphere_views()))
    for _ in range(40):
        engine.step(512, Rates(0.1, 0.1, 1e-3, 0.01))
    torch.set_num_threads(before)
    arrays = [*(rows for rows in engine.rows if rows is not engine.rows.bases), engine.marks]
    arrays += [grown.density_rows.numpy(), grown.feature_rows.numpy()]
    held = sum(in_memory(rows) * rows.nbytes for rows in arrays)
    everything = torch.ones_like(field.occupied)
    foreseen = memory_limits.level_bytes(field, everything, 128, settings, replaced=False)
    replacing = memory_limits.level_bytes(field, everything, 128, settings)
    host.close()
    return held, foreseen, replacing


def test_a_fit_climbs_where_there_is_little_memory_but_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is sized for the worst case and never written is not reserved."""
    settings = wanted("engine=numba", "budget=3", "field.resolution=64", "threads=1")
    monkeypatch.setattr(Schedule, "worth", lambda self, voxels, rays_left, bounded=True: True)
    reached = []
    for free in (2**21, 2**26):
        ticking(monkeypatch, 0.02)
        allow(monkeypatch, memory.SPARE + free)
        result = fit_field(sphere_views(), scene(), settings, begin=Begin(GridHost()))
        reached.append(result.field.resolution)
        assert len(result.notes) == (result.field.resolution < 64)
    assert reached == [32, 64]


def test_a_level_that_does_not_fit_is_not_made_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.02)
    monkeypatch.setattr(Schedule, "worth", lambda self, voxels, rays_left, bounded=True: True)
    settings = wanted("engine=torch", "budget=3", "field.resolution=64")
    assert fit_field(sphere_views(), scene(), settings).field.resolution == 64
    ticking(monkeypatch, 0.02)
    allow(monkeypatch, memory.SPARE + 2**21)
    result = fit_field(sphere_views(), scene(), settings)
    assert result.field.resolution == 32 and result.timeline[-1]["psnr"] > 12
    (note,) = result.notes
    assert "stayed at 32³, because 64³ would take about" in note and "0.0 GB is free" in note


def test_what_cannot_begin_is_refused_with_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.2)
    settings = wanted("engine=torch", "budget=2", "field.resolution=32")
    field = fit_field(sphere_views(), scene(), settings).field
    allow(monkeypatch, memory.SPARE + 2**17)
    with pytest.raises(InputError, match=r"a fit to 0 million pixels needs about 0\.0 GB of memory .* is free; lower --image-size"):
        fit_field(sphere_views(), scene(), settings)
    allow(monkeypatch, memory.SPARE + 2**20)
    with pytest.raises(InputError, match=r"going on from a field of [\d,]+ blocks needs about .* is free; fit it anew"):
        fit_field(sphere_views(), scene(), settings, begin=Begin(start=field))
    with pytest.raises(InputError, match=r"going on from a field of [\d,]+ blocks needs about"):
        fit_field(sphere_views(), scene(), wanted("engine=numba", "budget=2", "field.resolution=32"), begin=Begin(start=field))
    allow(monkeypatch, 2**50)
    assert not fit_field(sphere_views(), scene(), settings, begin=Begin(start=field)).notes
