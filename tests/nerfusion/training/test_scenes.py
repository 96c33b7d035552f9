"""Procedural scenes, camera paths and shards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.procedural import ProceduralScene, around, hand_held, look_at, wander
from fieldfuse.nerfusion.training.scenes import ShardScene, shard_files, write_shard
from fieldfuse.simulate.eye import take, take_all


def test_cameras_look_at_their_targets_and_stand_upright() -> None:
    rng = np.random.default_rng(0)
    centres, targets = rng.normal(0, 2, (20, 3)), rng.normal([5, 0, 0], 2, (20, 3))
    poses = look_at(centres, targets, np.zeros(20))
    for pose, centre, target in zip(poses, centres, targets, strict=True):
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3)) and np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        local = pose[:3, :3].T @ (target - centre)
        assert np.allclose(local, [0, 0, np.linalg.norm(target - centre)], atol=1e-9)
        assert pose[2, 0] == pytest.approx(0, abs=1e-9) and pose[2, 1] < 0  # x level, y down
    rolled = look_at(centres, targets, np.full(20, 0.3))
    assert np.allclose(rolled[:, :3, 2], poses[:, :3, 2])


def test_a_wander_is_smooth_and_of_its_size() -> None:
    walks = [wander(np.random.default_rng(seed), 50, 0.2) for seed in range(200)]
    assert 0.1 < float(np.std(walks)) < 0.4
    steps = np.abs(np.diff(walks[0], axis=0)).max()
    assert steps < 0.25 * np.ptp(walks[0])


@pytest.mark.parametrize("make", [hand_held, around])
def test_paths_keep_clear_of_surfaces(make) -> None:  # type: ignore[no-untyped-def]
    free, focus = np.array([[-2, -2, 0.2], [2, 2, 2.2]]), np.array([0, 0, 0.8])

    def around_a_ball(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - focus, axis=1) - 0.3

    found = [make(np.random.default_rng(seed), 12, free, focus, around_a_ball) for seed in range(6)]
    paths = [path for path in found if path is not None]
    assert len(paths) >= 4
    for path in paths:
        assert path.shape == (12, 4, 4) and around_a_ball(path[:, :3, 3]).min() > 0.02
    assert make(np.random.default_rng(0), 12, free, focus, lambda points: np.full(len(points), -1.0)) is None


@pytest.mark.parametrize("kind", ["object", "room"])
def test_procedural_depth_agrees_between_views(kind: str) -> None:
    """A surface point of one picture, projected into the next, lies on the surface that the next one sees (or behind it)."""
    scene = ProceduralScene(kind, np.random.default_rng(11), 64, 12)
    pictures = scene.pictures([5, 6])
    fx, fy, cx, cy = pictures.intrinsics[0].tolist()
    height, width = pictures.images.shape[2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    depth = pictures.depths[0]
    local = torch.stack([(u + 0.5 - cx) / fx * depth, (v + 0.5 - cy) / fy * depth, depth], -1)[depth > 0]
    first, second = pictures.world_from_camera
    world = local @ first[:3, :3].T + first[:3, 3]
    other = (world - second[:3, 3]) @ second[:3, :3]
    column, row = (other[:, 0] / other[:, 2] * fx + cx).floor().long(), (other[:, 1] / other[:, 2] * fy + cy).floor().long()
    inside = (other[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    assert int(inside.sum()) > 200
    seen = pictures.depths[1][row[inside], column[inside]]
    ratio = other[inside, 2] / seen
    assert float((ratio > 0.95).float().mean()) > 0.9  # never in front of what is seen there
    assert float(((ratio - 1).abs() < 0.05).float().mean()) > 0.5


def test_procedural_scenes_repeat_themselves_and_differ_in_everything() -> None:
    def make(seed: int) -> ProceduralScene:
        return ProceduralScene("object", np.random.default_rng(seed), 48, 8)

    first, again = make(1).pictures([3, 1]), make(1).pictures([1])
    assert torch.equal(first.images[1], again.images[0]) and torch.equal(first.depths[1], again.depths[0])
    scenes = [make(seed) for seed in range(6)]
    assert len({tuple(scene.pictures([0]).intrinsics[0].tolist()) for scene in scenes}) == 6
    sizes = [scene.depth_hint for scene in scenes if scene.depth_hint is not None]
    assert max(sizes) > 2 * min(sizes)


def shard(path: Path, frames: int = 6, size: tuple[int, int] = (24, 32)) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 6e6 + np.arange(frames)
    data = {
        "images": rng.integers(0, 255, (frames, 3, *size), dtype=np.uint8),
        "depths": rng.uniform(1, 2, (frames, *size)).astype(np.float32),
        "intrinsics": np.tile([30.0, 31.0, 16.0, 12.0], (frames, 1)),
        "world_from_camera": poses,
    }
    write_shard(path, *data.values(), kind="room", ordered=True)
    return data


def test_shards_come_back_as_they_were(tmp_path: Path) -> None:
    data = shard(tmp_path / "a.safetensors")
    (path,) = shard_files(tmp_path)
    scene = ShardScene(path, 32)
    assert (scene.kind, scene.ordered, scene.name) == ("room", True, "a")
    assert np.array_equal(scene.world_from_camera[:, 0, 3], data["world_from_camera"][:, 0, 3])  # float64, far from the origin
    pictures = scene.pictures([4, 1])
    assert torch.equal((pictures.images[0] * 255).round().byte(), torch.from_numpy(data["images"][4]))
    assert torch.equal(pictures.depths[1], torch.from_numpy(data["depths"][1]))


def test_shards_are_averaged_down_with_their_cameras(tmp_path: Path) -> None:
    data = shard(tmp_path / "a.safetensors")
    pictures = ShardScene(tmp_path / "a.safetensors", 16).pictures([0])
    assert pictures.images.shape == (1, 3, 12, 16)
    mean = data["images"][0].reshape(3, 12, 2, 16, 2).astype(np.float64).mean((2, 4)) / 255
    assert np.allclose(pictures.images[0].numpy(), mean, atol=1e-6)
    assert pictures.intrinsics[0].tolist() == pytest.approx([15.0, 15.5, 8.0, 6.0])
    assert np.isin(pictures.depths[0].numpy(), data["depths"][0]).all()  # depths are never mixed


def test_what_is_not_a_shard_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no shards"):
        shard_files(tmp_path)
    shard(tmp_path / "a.safetensors")
    whole = (tmp_path / "a.safetensors").read_bytes()
    for number, broken in enumerate((b"", whole[:100], whole[:-50], b"x" * 100)):
        path = tmp_path / f"b{number}.safetensors"
        path.write_bytes(broken)
        with pytest.raises(InputError, match=path.name):
            ShardScene(path, 32)
    with pytest.raises(ValueError, match="as many entries"):
        write_shard(
            tmp_path / "c", np.zeros((2, 3, 4, 4)), np.zeros((3, 4, 4)), np.zeros((2, 4)), np.zeros((2, 4, 4)), kind="x", ordered=True
        )


def test_frames_drawn_at_once_are_those_drawn_alone() -> None:
    scene = ProceduralScene("room", np.random.default_rng(1), 48, 8, 0)
    for index, many in zip((1, 5), take_all(scene._scene, scene._eye, scene._poses[[1, 5]]), strict=True):
        one = take(scene._scene, scene._eye, scene._poses[index][None])
        for name in ("linear", "depth", "normals", "albedo", "gloss"):
            torch.testing.assert_close(getattr(many, name), getattr(one, name), atol=1e-6, rtol=0)
