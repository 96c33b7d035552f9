"""The field as a file and as a picture."""

from __future__ import annotations

import mmap
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from fieldfuse import memory
from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.errors import InputError
from fieldfuse.render.field import Field, density
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.render.rays import render_rays
from tests.pages import mapped
from tests.render.made import random_field, random_rays


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_a_saved_field_renders_the_same(tmp_path: Path, decoder: str) -> None:
    field = random_field(background=1.0, decoder=decoder, keep=0.3)
    path = tmp_path / "field.safetensors"
    field.save(path, Similarity(2.0, np.eye(3), np.ones(3)), {"note": "x"})
    again = Field.load(path)
    origins, directions = random_rays(200)
    before, after = render_rays(field, origins, directions), render_rays(again, origins, directions)
    assert torch.allclose(before.colour, after.colour, atol=5e-3)  # features are stored as float16
    assert torch.allclose(before.opacity, after.opacity, atol=1e-5)
    assert again.voxels == field.voxels and again.voxel_size == pytest.approx(field.voxel_size)


def test_a_field_larger_than_memory_is_read_rendered_and_written_from_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place := tmp_path / "place").mkdir()
    random_field(keep=0.3).save(tmp_path / "field.safetensors")
    usual, (origins, directions) = Field.load(tmp_path / "field.safetensors"), random_rays(200)
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    monkeypatch.setattr(memory, "available", lambda: memory.SPARE + 2**17)
    large = Field.load(tmp_path / "field.safetensors")
    assert sorted(mapped(place), reverse=True)[:2] == [-(-rows.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE for rows in rows_of(large)]
    assert all(torch.equal(one, two) for one, two in zip(rows_of(usual), rows_of(large), strict=True))
    assert torch.equal(make_renderer(usual)(origins, directions).colour, make_renderer(large)(origins, directions).colour)
    large.settled().save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "field.safetensors").read_bytes()
    assert not list(place.iterdir())


def rows_of(field: Field) -> tuple[torch.Tensor, torch.Tensor]:
    return field.feature_rows, field.density_rows


def test_settling_changes_nothing_that_is_seen() -> None:
    field = random_field(keep=0.02)
    origins, directions = random_rays(100)
    assert torch.allclose(
        render_rays(field, origins, directions).colour, render_rays(field.packed()(), origins, directions).colour, atol=1e-6
    )


@pytest.mark.parametrize(
    "change",
    [
        {"resolution": -1}, {"decoder": "evil"}, {"space": {}}, {"hidden": 10**9}, {"background": ["a"]}, {"background": [0.2, 0.5, "nan"]},
        {"background": [0, 0, 1e30]}, {"near": "nan"},
        {"space": {"centre": [0, "nan", 0], "half": 1, "shell": 0, "box": [1, 1, 1]}},
    ],
)  # fmt: skip
def test_a_field_with_a_spoiled_configuration_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    from fieldfuse.volume.store import read_field, write_field

    path = tmp_path / "field.safetensors"
    random_field(keep=0.02).save(path)
    data = read_field(path)
    data.config.update(change)
    write_field(path, data)
    with pytest.raises(InputError, match="fit it again"):
        Field.load(path)


def test_an_empty_direction_shows_the_background_and_no_depth() -> None:
    field = random_field()
    away = np.eye(4)
    away[:3, 3] = [0, 0, 10]
    picture = render_view(field, Intrinsics(8, 6, 20, 20, 4, 3), away)
    assert np.allclose(picture.rgb, [0.2, 0.4, 0.6], atol=1e-6)
    assert not picture.depth.any() and not picture.opacity.any()


def test_depth_is_along_z_of_a_wall() -> None:
    """A slab that is opaque beyond z = 0.05 (the region's centre) seen from z = -3: z-depth is constant over the picture."""
    field = random_field(resolution=64, raw=0.0)
    rows = torch.arange(len(field.occupied))
    slot, local = rows // 512, rows % 512
    z = field.topology.keys[slot, 2] * 8 + local // 64
    field.density_rows[:-1] = torch.where(z >= 32, 8.0, -20.0)
    pose = np.eye(4)
    pose[:3, 3] = [0.2, -0.1, -3]
    picture = render_view(field, Intrinsics(33, 33, 60, 60, 16.5, 16.5), pose)
    assert picture.opacity.min() > 0.99
    assert np.abs(picture.depth - 3.05).max() < field.voxel_size


def test_density_stays_finite() -> None:
    raw = torch.tensor([-1e30, -50.0, 0.0, 50.0, 1e30])
    assert bool(torch.isfinite(density(raw)).all())
