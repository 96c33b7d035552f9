"""Readers of the published data sets, each on a small folder of the same layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.samples import TrainingScene, draw_sample
from fieldfuse.nerfusion.training.scenes import (
    dtu_scene,
    dtu_scenes,
    scanned_object_folders,
    scanned_object_scene,
    scannet_folders,
    scannet_scene,
    synthetic_folders,
    synthetic_scene,
)
from fieldfuse.nerfusion.training.settings import PictureSettings, VolumeSettings
from tests.nerfusion.training import layouts


def check_sample(scene: TrainingScene) -> None:
    """A sample can be drawn, and its pictures stand where its cameras say."""
    sample = draw_sample(scene, np.random.default_rng(0), PictureSettings(targets=2), VolumeSettings(), key_frames=2)
    assert sample.references.shape == (2, 3) and sample.targets.shape == (2, 2)
    assert 0 < sample.near < sample.far
    for row, targets in zip(sample.references.tolist(), sample.targets.tolist(), strict=True):
        assert len(set(row)) == 3 and not set(row) & set(targets)
    red = (sample.pictures.images[:, 0].mean((1, 2)) * 25.5).round().int().tolist()  # the frame's number, by construction
    x = sample.pictures.world_from_camera[:, 0, 3]
    order = torch.argsort(x)
    assert [red[i] for i in order] == sorted(red)


def test_scannet_finds_scans_and_reads_metres(tmp_path: Path) -> None:
    root = layouts.scannet(tmp_path)
    folders = scannet_folders(root)
    assert [path.name for path in folders] == ["scene0000_00", "scene0001_00"]
    (root / "scannetv2_train.txt").write_text("scene0001_00\nscene0999_00\n", encoding="utf-8")
    assert [path.name for path in scannet_folders(root)] == ["scene0001_00"]
    (root / "scannetv2_train.txt").write_text("scene0999_00\n", encoding="utf-8")
    with pytest.raises(InputError, match="none of the scenes"):
        scannet_folders(root)
    scene = scannet_scene(folders[0], 64)
    assert scene.kind == "room" and scene.ordered
    pictures = scene.pictures([0, 5])
    assert pictures.images.shape == (2, 3, 48, 64) and pictures.background is None
    assert torch.allclose(pictures.depths[:, 4:-4, 4:-4], torch.tensor(layouts.DEPTH))
    expected = layouts.camera(64, 48)
    assert pictures.intrinsics[0].tolist() == pytest.approx([expected.fx, expected.fy, expected.cx, expected.cy], rel=1e-5)
    check_sample(scene)


@pytest.mark.parametrize("full_depth", [False, True])
def test_dtu_pairs_views_cameras_and_depth(tmp_path: Path, full_depth: bool) -> None:
    root = layouts.dtu(tmp_path / "mvs_training" / "dtu", views=5, scans=(1,), lights=(3,), full_depth=full_depth)
    (only,) = dtu_scenes(tmp_path)
    assert (only.scan, only.light, only.root) == ("scan1", 3, root)
    scene = dtu_scene(only, 160)
    pictures = scene.pictures([0, 3])
    assert pictures.images.shape == (2, 3, 128, 160)
    assert torch.allclose(pictures.depths[:, 2:-2, 2:-2], torch.tensor(layouts.DEPTH))  # 400 mm are 2 units
    assert pictures.world_from_camera[:, 0, 3].tolist() == pytest.approx([-0.3, 0.15])
    # The files' K is for 160×128 with pixel centres of the halved originals.
    fx, fy, cx, cy = pictures.intrinsics[0].tolist()
    assert (fx, fy) == pytest.approx((361.5, 360.4))
    assert (cx, cy) == pytest.approx((82.9 + 0.25 / 4, 66.4 + 0.25 / 4))
    check_sample(scene)


def test_dtu_depth_of_the_originals_lies_on_the_halved_middle(tmp_path: Path) -> None:
    """A step in the 1600×1200 depth map must land where the 640×512 picture shows it."""
    layouts.dtu(tmp_path, views=4, scans=(1,), lights=(0,), full_depth=True)
    column = 2 * (80 + 320)  # of the original: the middle column of the picture
    depth = np.full((1200, 1600), 400, np.float32)
    depth[:, column:] = 600
    layouts.write(tmp_path / "Depths" / "scan1" / "depth_map_0000.pfm", depth)
    seen = dtu_scene(dtu_scenes(tmp_path)[0], 640).pictures([0]).depths[0]
    assert seen.shape == (512, 640)
    assert torch.all(seen[:, :319] == 2.0) and torch.all(seen[:, 321:] == 3.0)


def test_dtu_lists_every_light_and_follows_the_list_of_scans(tmp_path: Path) -> None:
    layouts.dtu(tmp_path, views=4)
    assert [(one.scan, one.light) for one in dtu_scenes(tmp_path)] == [("scan1", 0), ("scan1", 3), ("scan4", 0), ("scan4", 3)]
    (tmp_path / "train.txt").write_text("scan4\n", encoding="utf-8")
    assert {one.scan for one in dtu_scenes(tmp_path)} == {"scan4"}


def test_dtu_names_a_broken_camera_file(tmp_path: Path) -> None:
    layouts.dtu(tmp_path, views=4, scans=(1,), lights=(0,))
    path = tmp_path / "Cameras" / "train" / "00000002_cam.txt"
    path.write_text("extrinsic\n1 2 3\n", encoding="utf-8")
    with pytest.raises(InputError, match="00000002_cam"):
        dtu_scene(dtu_scenes(tmp_path)[0], 160)


def test_scanned_objects_look_at_the_origin(tmp_path: Path) -> None:
    root = layouts.scanned_objects(tmp_path / "google_scanned_objects")
    folders = scanned_object_folders(tmp_path)
    assert [path.parent for path in folders] == [root, root]
    scene = scanned_object_scene(folders[1], 32)
    assert scene.kind == "object" and not scene.ordered
    assert scene.depth_hint == pytest.approx(layouts.DEPTH, rel=0.05)
    assert scene.pictures([0]).background == (1.0, 1.0, 1.0)  # opaque pictures, but white is nothing and no wall
    check_sample(scene)


def test_scanned_objects_miss_a_camera(tmp_path: Path) -> None:
    root = layouts.scanned_objects(tmp_path)
    (root / "object_0" / "intrinsics" / "003.txt").unlink()
    with pytest.raises(InputError, match=r"003\.txt"):
        scanned_object_scene(scanned_object_folders(root)[0], 32)


def test_synthetic_never_shows_test_pictures(tmp_path: Path) -> None:
    folders = synthetic_folders(layouts.synthetic(tmp_path))
    assert [path.name for path in folders] == ["chair", "drums"]
    scene = synthetic_scene(folders[0], 32)
    pictures = scene.pictures(range(len(scene.world_from_camera)))
    assert len(pictures) == 8 and pictures.background == (1.0, 1.0, 1.0)
    assert float(pictures.images[:, 0].mean((1, 2)).max()) * 25.5 < 10  # test pictures are numbered from 20
    check_sample(scene)


@pytest.mark.parametrize("find", [scannet_folders, dtu_scenes, scanned_object_folders, synthetic_folders])
def test_a_folder_without_the_layout_is_refused_in_one_sentence(find, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "something.txt").write_text("x", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        find(tmp_path)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)
