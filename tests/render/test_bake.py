"""Baked fields: the same render from bytes, on disk and back, and files that are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from fieldfuse.errors import InputError
from fieldfuse.evaluation.sphere import around, lens
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.bake import BakedField, bake, seen_voxels
from fieldfuse.render.bake_file import METADATA_KEY, read_baked, write_baked
from fieldfuse.render.field import Field
from fieldfuse.render.image import render_view
from tests.render.made import coloured_field, random_field

CAMERA, POSE = lens(40, 30), around()[1]


@pytest.fixture(scope="module")
def field() -> Field:
    return coloured_field()


@pytest.fixture(scope="module")
def baked(field: Field) -> BakedField:
    return bake(field)


def picture(field: BakedField) -> np.ndarray:
    return render_view(field.to_field(), CAMERA, POSE).rgb


@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_the_picture_is_the_fields_own(shell: float) -> None:
    """Quantisation alone moves colours by less than two of 255 steps on average, and depth hardly."""
    given = coloured_field(shell)
    expected, got = (render_view(one, CAMERA, POSE) for one in (given, bake(given).to_field()))
    assert expected.rgb.std() > 0.1 and 0.1 < expected.opacity.mean() < 0.999
    assert np.abs(got.rgb - expected.rgb).mean() < 2 / 255
    assert np.abs(got.opacity - expected.opacity).max() < 0.03
    both = (got.depth > 0) & (expected.depth > 0)
    assert both.mean() > 0.1 and np.median(np.abs(got.depth - expected.depth)[both] / expected.depth[both]) < 2e-3


def test_the_values_of_every_corner_are_the_fields_own(field: Field, baked: BakedField) -> None:
    """Each stored corner is within half a step of the field's, but for the few that are clipped; also those on faces between blocks."""
    again = baked.to_field()
    assert again.voxels == field.voxels
    lookup = {tuple(key): slot for slot, key in enumerate(field.topology.keys.tolist())}
    rows = np.concatenate([lookup[tuple(key)] * 512 + np.arange(512) for key in again.topology.keys.tolist()])
    used = np.flatnonzero(again.feature_rows[:-1].numpy().any(1))
    off = np.abs(again.feature_rows.numpy()[used] - field.feature_rows.numpy()[rows[used]])
    assert np.mean(off > 0.51 * baked.arrays.scale) < 0.01 and len(used) > 1000
    assert np.median(np.abs(again.density_rows.numpy()[used] - field.density_rows.numpy()[rows[used]])) < 0.05


def test_only_corners_beside_voxels_are_stored(field: Field, baked: BakedField) -> None:
    from fieldfuse.volume.edit import corner_nodes

    beside = int(corner_nodes(field.topology, field.occupied).sum())
    assert beside <= baked.corners < 1.5 * beside  # those on faces between blocks are stored with each
    assert baked.voxels == field.voxels
    assert baked.bytes < field.bytes / 3


def test_a_file_holds_all_of_it(baked: BakedField, tmp_path: Path) -> None:
    path = tmp_path / "baked.safetensors"
    write_baked(path, baked)
    again = read_baked(path)
    assert np.array_equal(picture(again), picture(baked))
    assert all(np.array_equal(a, b) for a, b in zip(again.arrays, baked.arrays, strict=True))


DAMAGE: dict[str, Any] = {
    "table": lambda a: np.where(a >= 0, a + 10_000, a),
    "first": lambda a: a + 5,
    "rows": lambda a: a + (1 << 9),
    "base": lambda a: a + 1,
    "bits": lambda a: np.full_like(a, 255),
    "feature": lambda a: a[:-1],
    "packed": lambda a: a[:-1],
    "bricks": lambda a: a[:-1],
    "thickness": lambda a: np.where(np.arange(len(a)) == 3, np.float32("nan"), a),
    "scale": lambda a: a.astype(np.float64),
    "decoder.w1": lambda a: a[:-1],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_files_are_refused(baked: BakedField, tmp_path: Path, name: str) -> None:
    """No index may lead outside."""
    from safetensors import safe_open

    path = tmp_path / "baked.safetensors"
    write_baked(path, baked)
    with safe_open(str(path), framework="np") as source:
        metadata = source.metadata()
    tensors = load_file(str(path))
    tensors[name] = np.ascontiguousarray(DAMAGE[name](tensors[name]))
    save_file(tensors, str(path), metadata=metadata)
    with pytest.raises(InputError, match="cannot be used"):
        read_baked(path)


def test_other_files_are_refused(baked: BakedField, tmp_path: Path) -> None:
    path = tmp_path / "baked.safetensors"
    with pytest.raises(InputError, match="there is no baked field"):
        read_baked(path)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match="cannot be used"):
        read_baked(path)
    write_baked(path, baked)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="cannot be used"):
        read_baked(path)
    save_file({"a": np.zeros(1, np.float32)}, str(path), metadata={METADATA_KEY: "{}"})
    with pytest.raises(InputError, match="cannot be used"):
        read_baked(path)


def test_what_no_view_sees_is_left_out(field: Field) -> None:
    """A camera before an opaque sphere sees one side of it."""
    solid = replace(field, density_rows=field.density_rows + 4)
    keep = seen_voxels(solid, [CAMERA], POSE[None])
    assert 0.02 < float(keep.sum()) / solid.voxels < 0.2  # the near half of the outermost of eight layers
    assert not bool((keep & ~solid.occupied).any())
    small = bake(solid, keep)
    whole, part = (picture(f) for f in (bake(solid), small))
    assert small.bytes < bake(solid).bytes and np.abs(whole - part).mean() < 0.01
    behind = POSE.copy()
    behind[:3, :3] = behind[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    with pytest.raises(InputError, match="nothing to bake"):
        bake(solid, seen_voxels(solid, [CAMERA], behind[None]))


def test_what_cannot_be_baked_is_refused() -> None:
    with pytest.raises(InputError, match="deferred"):
        bake(replace(random_field(), decoder=make_decoder("per_sample", 8, 16)))
