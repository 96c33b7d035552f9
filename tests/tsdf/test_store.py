"""Volumes on disk: what is read is what was written, and what is damaged is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from fieldfuse.errors import InputError
from fieldfuse.tsdf.fuse import TsdfVolume, fuse_frames
from fieldfuse.tsdf.store import load_volume, save_volume
from tests.tsdf.scenes import CAMERA, all_round, sphere_frame

CENTRE = np.array([0.1, 0.2, 0.3])
FACTS = {"version": 1, "voxel_size": 0.02, "depth_max": 3.0, "truncation": 4.0, "frames": 8, "empty_frames": 0, "touches": 400}


@pytest.fixture(scope="module")
def volume() -> TsdfVolume:
    return fuse_frames([sphere_frame(pose, CENTRE, 0.5) for pose in all_round(CENTRE, 1.6, 8)], 0.02, 3.0)


def test_a_volume_comes_back_and_goes_on(volume: TsdfVolume, tmp_path: Path) -> None:
    path = tmp_path / "volume.safetensors"
    save_volume(path, volume)
    back = load_volume(path)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    assert (back.voxel_size, back.depth_max, back.frames, back.blocks) == (0.02, 3.0, 8, volume.blocks)
    assert back.weight_threshold == volume.weight_threshold
    ours, theirs = volume.mesh(), back.mesh()
    assert len(ours.triangles) == len(theirs.triangles) > 1000
    assert np.allclose(np.sort(ours.vertices, axis=0), np.sort(theirs.vertices, axis=0), atol=1e-6)
    assert ours.colours.astype(int).sum() == theirs.colours.astype(int).sum()
    pose = all_round(CENTRE, 1.6, 9)[4]
    before = back.render(CAMERA, pose).depth
    assert np.allclose(before, volume.render(CAMERA, pose).depth, atol=1e-5)
    assert back.integrate(sphere_frame(pose, CENTRE, 0.5))
    assert back.frames == 9


def stored(volume: TsdfVolume, tmp_path: Path) -> tuple[Path, dict[str, np.ndarray]]:
    path = tmp_path / "volume.safetensors"
    save_volume(path, volume)
    return path, load_file(path)


def rewrite(path: Path, arrays: dict[str, np.ndarray], **facts: object) -> None:
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    save_file(arrays, path, metadata={"tsdf": json.dumps({**FACTS, **facts})})


def test_the_tampering_below_starts_from_a_file_that_reads(volume: TsdfVolume, tmp_path: Path) -> None:
    path, arrays = stored(volume, tmp_path)
    rewrite(path, arrays)
    assert load_volume(path).blocks == volume.blocks


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("keys", lambda a: a.astype(np.int64)),
        ("keys", lambda a: a[:-1]),
        ("keys", lambda a: np.concatenate([a[:-1], a[:1]])),
        ("keys", lambda a: a[0]),
        ("tsdf", lambda a: a[:, :100]),
        ("tsdf", lambda a: np.where(a > 0, np.float32(np.nan), a)),
        ("color", lambda a: a[..., :2]),
        ("weight", lambda a: a.astype(np.float64)),
    ],
)
def test_tampered_arrays_are_refused(volume: TsdfVolume, tmp_path: Path, name: str, change: object) -> None:
    path, arrays = stored(volume, tmp_path)
    assert callable(change)
    rewrite(path, {**arrays, name: change(arrays[name])})
    with pytest.raises(InputError, match=path.name):
        load_volume(path)


@pytest.mark.parametrize(
    "facts",
    [{"version": 2}, {"voxel_size": -1.0}, {"voxel_size": "x"}, {"voxel_size": None}, {"depth_max": float("inf")}, {"frames": [1]}],
)
def test_tampered_facts_are_refused(volume: TsdfVolume, tmp_path: Path, facts: dict[str, object]) -> None:
    path, arrays = stored(volume, tmp_path)
    rewrite(path, arrays, **facts)
    with pytest.raises(InputError):
        load_volume(path)


def test_files_of_another_kind_are_refused(volume: TsdfVolume, tmp_path: Path) -> None:
    path, _ = stored(volume, tmp_path)
    data = path.read_bytes()
    for content in (b"", b"not a tensor", data[: len(data) // 2], b"\xff" * 8 + data[8:]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            load_volume(path)
    save_file({"x": np.zeros(3)}, path)
    with pytest.raises(InputError, match="version"):
        load_volume(path)
    with pytest.raises(InputError, match="does not exist"):
        load_volume(tmp_path / "nothing.safetensors")
