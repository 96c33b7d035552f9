"""`import fieldfuse as ff`: what the README shows, held against the command line and against exact depth."""

from __future__ import annotations

import random
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import fieldfuse as ff
from fieldfuse.progress import Bar
from tests.pipelines.made import CAMERA, circle, make_room, said, shoot
from tests.pipelines.short import SMALL, report, steady

FIT = {"budget": 3, "init": "classical", "resolution": 32}
KEYWORDS = {"threads": 1, "init": "classical", "settings": {"field.resolution": 32, "export.mesh_views": 6}}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ff.Scene:
    folder = tmp_path_factory.mktemp("api") / "room"
    make_room(folder, 12, depth=True)
    return ff.load(folder, **KEYWORDS)


@pytest.fixture(scope="module")
def fitted(scene: ff.Scene) -> ff.Field:
    with steady():
        return ff.fit(scene, budget=3)


def mean_error(rendered: np.ndarray, true: np.ndarray) -> float:
    return float(np.abs(rendered.astype(float) - true).mean())


def test_a_scene_is_in_the_frame_of_its_source(scene: ff.Scene) -> None:
    poses = circle(12)
    assert [len(scene.train), len(scene.test)] == [10, 2] and scene.test.names[0].endswith("000")
    for split, indices in ((scene.test, (0, 8)), (scene.train, (1, 2, 3, 4, 5, 6, 7, 9, 10, 11))):
        for camera, image, index in zip(split.cameras, split.images, indices, strict=True):
            np.testing.assert_allclose(camera.world_from_camera, poses[index], atol=1e-9)
            assert mean_error(image, shoot(poses[index])[0]) < 0.5


def test_a_render_has_colour_and_depth_in_the_units_of_the_source(scene: ff.Scene, fitted: ff.Field) -> None:
    rendered = fitted.render(scene.test.cameras[0])
    colours, depth = shoot(circle(12)[0])
    assert rendered.rgb.shape == (72, 96, 3) and rendered.rgb.dtype == np.uint8
    assert mean_error(rendered.rgb, colours) < 12
    assert np.median(np.abs(rendered.depth - depth)) < 0.05 and np.median(rendered.opacity) > 0.95
    several = fitted.render(scene.test.cameras)
    assert len(several) == 2 and np.array_equal(several[0].rgb, rendered.rgb)
    assert fitted.render(scene.test.cameras[0].resized(48, 36)).rgb.shape == (36, 48, 3)


def test_scores_are_those_of_the_command_line(scene: ff.Scene, fitted: ff.Field, tmp_path: Path) -> None:
    """The same steps behind both, so the same numbers but for what a field's file rounds."""
    with steady():
        assert said("run", scene.capture.root, "--out", tmp_path / "out", *SMALL, "--set", "export.formats=[]").code == 0
    expected, found = report(tmp_path / "out")["evaluation"], ff.evaluate(fitted, scene)
    assert found.psnr == pytest.approx(expected["field"]["psnr"], abs=0.05)
    assert found.nearest_image == pytest.approx(expected["nearest_image"]["psnr"], abs=1e-6)
    assert ff.evaluate(ff.fuse_tsdf(scene), scene).psnr == pytest.approx(expected["tsdf"]["psnr"], abs=0.01)
    assert found.psnr > found.nearest_image + 3
    opened = ff.Field.open(tmp_path / "out" / "field.safetensors", scene)
    assert ff.evaluate(opened, scene).psnr == pytest.approx(expected["field"]["psnr"], abs=0.01)


def test_a_field_is_saved_opened_and_meshed(scene: ff.Scene, fitted: ff.Field, tmp_path: Path) -> None:
    fitted.save(tmp_path / "field.safetensors")
    alone = ff.Field.open(tmp_path / "field.safetensors")
    camera = scene.test.cameras[1]
    assert mean_error(alone.render(camera).rgb, fitted.render(camera).rgb) < 0.5
    with pytest.raises(ff.InputError, match="has no scene"):
        alone.to_mesh()
    ff.Field.open(tmp_path / "field.safetensors", scene).to_mesh(smooth=0).save(tmp_path / "mesh.glb")
    mesh = trimesh.load(tmp_path / "mesh.glb").to_geometry()
    assert len(mesh.faces) > 1000
    off = np.abs(np.abs(np.asarray(mesh.vertices)) - np.array([2.0, 1.5, 2.0])).min(axis=1)
    assert np.median(off) < 0.03, "the mesh is not where the room's walls are"


def test_a_field_is_cropped_and_cleaned(scene: ff.Scene, fitted: ff.Field, tmp_path: Path) -> None:
    part, clean = fitted.cropped("-9,-9,-9,9,9,0"), fitted.cleaned()
    assert 0.2 < part.sparse.voxels / fitted.sparse.voxels < 0.8 and clean.sparse.voxels <= fitted.sparse.voxels
    camera = scene.train.cameras[0]
    assert np.abs(clean.render(camera).opacity - fitted.render(camera).opacity).mean() < 0.01
    assert part.render(camera).opacity.mean() < fitted.render(camera).opacity.mean()
    with pytest.raises(ff.InputError, match="nothing of the field lies in the region"):
        fitted.cropped("50,50,50,51,51,51")
    fitted.save(tmp_path / "field.safetensors")
    with pytest.raises(ff.InputError, match="has no scene"):
        ff.Field.open(tmp_path / "field.safetensors").cropped()


def test_sensor_depth_is_fused(scene: ff.Scene, tmp_path: Path) -> None:
    surface = ff.fuse_tsdf(scene, voxel_size=0.04)
    rendered, (_, depth) = surface.render(scene.test.cameras[0]), shoot(circle(12)[0])
    seen = rendered.opacity > 0
    assert seen.mean() > 0.8 and np.median(np.abs(rendered.depth - depth)[seen]) < 0.01
    surface.points.save(tmp_path / "points.ply")
    assert len(trimesh.load(tmp_path / "points.ply").vertices) == len(surface.points.points) > 1000
    with pytest.raises(ff.InputError, match="auto, sensor or matching"):
        ff.fuse_tsdf(scene, depth_from="guess")


def test_the_networks_alone_give_a_field(scene: ff.Scene) -> None:
    settings = {"keyframes.most": 3, "network.voxels": 16, "network.agreement": False}
    score = ff.evaluate(ff.infer(scene, settings=settings), scene).psnr
    assert score is not None and score > 12
    field = ff.fit(scene, finetune=False, init="auto", settings=settings)
    assert len(field.timeline) == 0 and ff.evaluate(field, scene).psnr == pytest.approx(score, abs=0.01)
    with pytest.raises(ff.InputError, match="fieldfuse run SOURCE"):
        ff.fit(scene, cells=4)
    with pytest.raises(ff.InputError, match="without fine-tuning"):
        ff.fit(scene, finetune=False)  # its start is classical


def test_a_listener_hears_every_stage_and_may_stop(scene: ff.Scene) -> None:
    heard: list[str] = []
    ff.load(scene.capture.root, progress=lambda stage, done, total, note: heard.append(stage), image_size=48, **KEYWORDS)
    assert {"capture", "effects", "views"} <= set(heard)
    with steady():
        early = ff.fit(scene, budget=500, progress=lambda stage, done, total, note: done < 1)
    assert early.timeline[-1]["seconds"] < 250 and early.render(scene.test.cameras[0]).rgb.any()
    with pytest.raises(ff.Interrupted):
        ff.evaluate(early, scene, progress=lambda *_: False)


def test_a_bar_ends_with_its_stage(capsys: pytest.CaptureFixture[str]) -> None:
    bar = Bar("fit")
    bar.update(1, 2, "half")
    bar.update(2, 2)
    assert bar._bars.finished and not bar._bars.live.is_started


def test_two_fits_at_once_are_as_each_alone(scene: ff.Scene) -> None:
    """And neither moves the caller's random numbers or threads."""
    torch.manual_seed(5), np.random.seed(5), random.seed(5)
    expected = (torch.rand(1).item(), np.random.rand(), random.random(), torch.get_num_threads())
    torch.manual_seed(5), np.random.seed(5), random.seed(5)
    found: list[ff.Field] = []
    with steady():
        one = ff.fit(scene, budget=1)
        threads = [threading.Thread(target=lambda: found.append(ff.fit(scene, budget=1))) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    score = ff.evaluate(one, scene).psnr
    assert score is not None and len(found) == 2
    for field in found:
        assert ff.evaluate(field, scene).psnr == pytest.approx(score, abs=0.5)
    assert (torch.rand(1).item(), np.random.rand(), random.random(), torch.get_num_threads()) == expected


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"image_sizes": 3}, "there is no setting 'image_sizes'; did you mean 'image_size'"),
        ({"preset": "best"}, "there is no preset 'best'"),
        ({"poses": "guess"}, "poses.source is 'guess'"),
    ],
)
def test_wrong_settings_are_refused_by_name(scene: ff.Scene, wrong: dict[str, object], sentence: str) -> None:
    with pytest.raises(ff.InputError, match=sentence):
        ff.load(scene.capture.root, **wrong)


def test_what_decides_the_scene_cannot_be_changed_later(scene: ff.Scene) -> None:
    with pytest.raises(ff.InputError, match=r"capture decide the scene; give them to load"):
        ff.fit(scene, image_size=32)
    with pytest.raises(ff.InputError, match="does not exist"):
        ff.load("nowhere")
    bent = replace(CAMERA, distortion=(0.1, 0, 0, 0), lens="opencv")
    with pytest.raises(ff.InputError, match="pinhole"):
        ff.fuse_tsdf(scene).render(ff.Camera(bent, np.eye(4)))


def test_importing_loads_nothing_heavy_and_all_names_are_there() -> None:
    code = "import sys, fieldfuse as ff; heavy = {'torch', 'numpy', 'open3d', 'cv2'} & set(sys.modules); print(sorted(heavy), *dir(ff))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.startswith("[] ") and {*ff.__all__} <= {*shown.split()}
    assert all(getattr(ff, name).__doc__ for name in ff.__all__)


def test_splats_show_what_the_field_shows(scene: ff.Scene, fitted: ff.Field, tmp_path: Path) -> None:
    with steady():
        splats = fitted.to_splats(splat_seconds=1)
    ours, theirs = ff.evaluate(splats, scene), ff.evaluate(fitted, scene)
    assert ours.psnr is not None and theirs.psnr is not None and ours.psnr > theirs.psnr - 4  # of coarse voxels
    camera = scene.test.cameras[0]
    shown, depth = splats.render(camera), shoot(circle(12)[0])[1]
    assert np.median(np.abs(shown.depth - depth)) < 0.1 and np.median(shown.opacity) > 0.95
    for name, most in (("a.ply", 0.01), ("a.spz", 4)):  # grey levels; the file has another frame than the field, in float32
        splats.save(tmp_path / name)
        again = ff.Splats.open(tmp_path / name)
        assert len(again) == len(splats) and mean_error(again.render(camera).rgb, shown.rgb.astype(float)) <= most
