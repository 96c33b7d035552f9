"""Memory of a fit: estimated from the voxels that stay, refused or lowered with both numbers."""

from __future__ import annotations

import pytest
import torch

from tests.training.test_fit import scene, sphere_views, ticking, wanted
from toolkit import memory
from toolkit.errors import InputError
from toolkit.training import room
from toolkit.training.engine import make_engine
from toolkit.training.fit import fit_field
from toolkit.training.levels import finer
from toolkit.training.rays import PixelPool
from toolkit.training.schedule import Schedule
from toolkit.training.step import Rates
from toolkit.volume.host import TorchHost


def allow(monkeypatch: pytest.MonkeyPatch, free: int | None) -> None:
    monkeypatch.setattr(memory, "available", lambda: free)


@pytest.mark.parametrize("ratio", [2.0, 1.5])
def test_rows_of_a_finer_level_are_about_what_is_foreseen(ratio: float, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.05)
    field = fit_field(sphere_views(), scene(), wanted("engine=torch", "budget=3", "field.resolution=32")).field
    for share in (1.0, 0.3, 0.02):
        keep = field.occupied & (torch.rand(len(field.occupied), generator=torch.Generator().manual_seed(1)) < share)
        made = len(finer(field, keep, int(ratio * field.resolution), TorchHost()).density_rows)
        assert 0.6 < room.level_rows(keep, ratio) / made < 2.5, share


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_bytes_of_a_row_are_those_of_the_compiled_engine(decoder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.2)
    settings = wanted(f"decoder={decoder}", "engine=numba", "budget=2", "field.resolution=32", "threads=1")
    field = fit_field(sphere_views(), scene(), settings).field
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    engine = make_engine(settings, field, PixelPool(sphere_views()))
    torch.set_num_threads(before)
    engine.step(64, Rates(0.1, 0.1, 1e-3, 0.01))
    names = ("index", "records", "touched", "density_sums", "feature_sums", "marks")
    held = sum(getattr(engine, name).nbytes for name in names) + field.density_rows.nbytes + field.feature_rows.nbytes
    assert room.row_bytes(settings, field.device) == pytest.approx(held / len(field.density_rows), rel=0.05)


def test_a_level_that_does_not_fit_is_not_made_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.02)
    monkeypatch.setattr(Schedule, "worth", lambda self, voxels, rays_left: True)
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
        fit_field(sphere_views(), scene(), settings, start=field)
    allow(monkeypatch, None)
    assert not fit_field(sphere_views(), scene(), settings, start=field).notes
