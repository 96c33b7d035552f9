"""Whole captures: readers open them, ground truth agrees with them, the same seed gives the same bytes, and nothing half-made stays."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from fieldfuse.camera import FISHEYE, Intrinsics, directions_of, pixel_grid, unproject
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.ply_points import read_ply_points
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.simulate import procedural
from fieldfuse.simulate.materials import texture_bank
from fieldfuse.simulate.mesh_scene import load_mesh_scene
from fieldfuse.simulate.settings import read_scene_file, scene_file
from fieldfuse.simulate.simulate import simulate
from tests.stereo.made import Stopping

SMALL = {"camera": {"width": 64, "height": 48}, "path": {"frames": 4, "fps": 4, "speed": 0.4}, "side": 1}


@pytest.fixture(autouse=True)
def small_textures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedural, "texture_bank", lambda: texture_bank(size=128))


def made(out: Path, effects: Any = (), **rest: Any) -> Path:
    simulate(scene_file({**SMALL, **rest, "effects": list(effects)}, "test"), out)
    return out


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


ALL = ["distortion", "exposure", "vignetting", "highlights", "background", "rolling_shutter", {"motion_blur": {"samples": 2}}]
ALL += ["passers", "sensor_noise", "depth_offset", "depth_noise", "compression"]


def test_readers_open_it_and_it_says_what_the_truth_says(tmp_path: Path) -> None:
    folder = made(tmp_path / "capture", ["distortion", "depth_noise"], depth=True)
    capture = check_capture(open_capture(folder))
    truth = json.loads((folder / "ground_truth" / "cameras.json").read_text())
    assert capture.kind == "transforms" and len(capture.frames) == 4 and capture.posed and capture.has_depth and not capture.warnings
    assert capture.depth_scale == 1000
    for frame, known in zip(capture.frames, truth["frames"], strict=True):
        assert frame.intrinsics is not None and frame.intrinsics.to_dict() == truth["intrinsics"]
        assert frame.intrinsics.distorted
        np.testing.assert_allclose(frame.world_from_camera, known["world_from_camera"], atol=1e-12)
        depth = cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED) / 1000
        exact = load_file(str(folder / known["truth"]))
        assert exact["depth"].shape == depth.shape == (48, 64) and exact["normals"].shape == (48, 64, 3)
        got = depth > 0
        assert got.mean() > 0.4
        assert np.median(np.abs(depth - exact["depth"])[got]) < 0.02


def test_same_seed_same_bytes_with_any_number_of_workers(tmp_path: Path) -> None:
    settings = scene_file({**SMALL, "depth": True, "effects": ALL, "seed": 5}, "test")
    for name, workers in (("a", 1), ("b", 3)):
        simulate(settings, tmp_path / name, workers=workers)
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    settings.seed = 6
    simulate(settings, tmp_path / "c")
    other = digests(tmp_path / "c")
    assert other.keys() == digests(tmp_path / "a").keys()
    assert all(other[name] != digest for name, digest in digests(tmp_path / "a").items() if name.startswith(("images", "depth")))


def test_effects_of_the_picture_leave_the_truth_as_it_is(tmp_path: Path) -> None:
    clean, dressed = made(tmp_path / "clean"), made(tmp_path / "dressed", ["exposure", "vignetting", "sensor_noise"])
    a, b = digests(clean), digests(dressed)
    for name in a:
        same = a[name] == b[name]
        assert same == (not name.startswith("images") and name != "ground_truth/effects.json"), name
    facts = json.loads((dressed / "ground_truth" / "effects.json").read_text())
    assert set(facts["effects"]) == {"exposure", "vignetting", "sensor_noise"}
    assert len(facts["frames"]) == 4 and len(facts["frames"][2]["exposure"]["gain"]) == 3
    assert json.loads((clean / "ground_truth" / "effects.json").read_text())["effects"] == {}


def test_the_mesh_is_the_scenes(tmp_path: Path) -> None:
    """Points of the exact depth lie on the triangles of mesh.ply."""
    import trimesh

    folder = made(tmp_path / "capture", scene="sphere", camera={"width": 32, "height": 24})
    mesh = trimesh.load(folder / "ground_truth" / "mesh.ply", process=False)
    points = read_ply_points(folder / "ground_truth" / "mesh.ply")
    assert isinstance(mesh, trimesh.Trimesh) and points is not None and len(points) == len(mesh.vertices)
    truth = json.loads((folder / "ground_truth" / "cameras.json").read_text())
    capture = open_capture(folder)
    known = truth["frames"][0]
    depth = load_file(str(folder / known["truth"]))["depth"]
    v, u = np.mgrid[0:24:2, 0:32:2].reshape(2, -1)
    assert capture.frames[0].intrinsics is not None
    pose = np.array(known["world_from_camera"])
    seen = unproject(capture.frames[0].intrinsics, pose, np.stack([u + 0.5, v + 0.5], axis=1), depth[v, u])
    off = load_mesh_scene(folder / "ground_truth" / "mesh.ply").clearance(torch.from_numpy(seen)).numpy()
    assert np.quantile(off, 0.99) < 2e-3 and max(off) < 0.005
    normal = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    inward = ((mesh.triangles_center - pose[:3, 3]) * normal).sum(1)  # the room's own walls face the camera
    assert (inward[: 6 * 2 * 10] < 0).any()


@pytest.mark.parametrize("output", ["photos", "video"])
def test_captures_without_poses(tmp_path: Path, output: str) -> None:
    folder = made(tmp_path / "capture", output=output)
    capture = open_capture(folder)
    assert capture.kind == output and len(capture.frames) == 4 and not capture.posed
    truth = json.loads((folder / "ground_truth" / "cameras.json").read_text())
    assert len(truth["frames"]) == 4
    assert not (folder / "transforms.json").exists()


def test_compressed_pictures_are_jpeg_files(tmp_path: Path) -> None:
    folder = made(tmp_path / "capture", [{"compression": {"quality": 30}}])
    files = sorted((folder / "images").iterdir())
    assert [file.suffix for file in files] == [".jpg"] * 4
    assert len(open_capture(folder).frames) == 4
    facts = json.loads((folder / "ground_truth" / "effects.json").read_text())
    assert facts["frames"][0]["compression"]["bytes"] == files[0].stat().st_size


def test_stopping_or_failing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        simulate(scene_file(SMALL, "test"), tmp_path / "out", progress=Stopping())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    with pytest.raises(InputError, match="already holds something"):
        simulate(scene_file(SMALL, "test"), tmp_path / "full")
    assert (tmp_path / "full" / "file").read_text() == "mine"
    (tmp_path / "empty").mkdir()
    assert len(open_capture(made(tmp_path / "empty")).frames) == 4


def test_depth_noise_without_depth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="set `depth: true`"):
        made(tmp_path / "capture", ["depth_noise"])
    assert not (tmp_path / "capture").exists()


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ({"scen": "room"}, "did you mean 'scene'"),
        ({"path": {"speeed": 1}}, "did you mean 'path.speed'"),
        ({"path": 3}, "must hold `key: value` pairs"),
        ({"camera": {"width": "wide"}}, "camera.width is 'wide'; it must be a valid integer"),
        ({"camera": {"fov": 200}}, "at most 140"),
        ({"path": {"frames": 0}}, "at least 1"),
        ({"path": {"speed": float("nan")}}, "finite number"),
        ({"output": "film"}, "must be one of"),
        ({"output": "video", "camera": {"width": 65}}, "even width"),
        ({"output": "video", "depth": True}, "depth needs"),
        ({"mesh": {"up": "x"}}, "one of z, y"),
        ({"mesh": {"free": [[0, 0, 0]]}}, "at least 2 items"),
    ],
)
def test_mistakes_in_scene_files_are_told(data: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as told:
        scene_file(data, "scene.yaml")
    assert str(told.value).startswith("scene.yaml")


@pytest.mark.parametrize("text", ["- a\n- b\n", "scene: [", "a: b: c", "\x00"])
def test_files_that_are_no_scene_files_are_told(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"scene\.yaml"):
        read_scene_file(path)
    with pytest.raises(InputError, match="cannot read"):
        read_scene_file(tmp_path / "none.yaml")


SCENES = sorted((Path(__file__).parents[2] / "configs" / "scenes").glob("*.yaml"))


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_scenes_that_come_along_can_be_filmed(path: Path, tmp_path: Path) -> None:
    settings = read_scene_file(path)
    settings.camera.width, settings.camera.height, settings.side = 32, 24, 1
    settings.path.frames = 2
    simulate(settings, tmp_path / "out")
    assert (tmp_path / "out" / "ground_truth" / "mesh.ply").stat().st_size > 100


def test_the_command_films_and_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from fieldfuse.pipelines.cli import app, main

    (tmp_path / "scene.yaml").write_text("camera: {width: 32, height: 24}\npath: {frames: 2}\neffects: [vignetting]\n")

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["fieldfuse", "simulate", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        answer = capsys.readouterr()
        return int(ended.value.code or 0), answer.out, answer.err

    assert "simulate" in {command.name or command.callback.__name__ for command in app.registered_commands if command.callback}
    scene = str(tmp_path / "scene.yaml")
    code, out, _ = run(scene, "--out", str(tmp_path / "a"), "--json", "--seed", "3")
    assert code == 0 and json.loads(out) == {
        "capture": str(tmp_path / "a"),
        "scene": "room",
        "seed": 3,
        "frames": 2,
        "effects": ["vignetting"],
    }
    code, out, _ = run(scene, "--out", str(tmp_path / "b"), "--effects", "none", "--seed", "3")
    assert code == 0 and "effects: none" in out
    assert digests(tmp_path / "a")["images/000000.png"] != digests(tmp_path / "b")["images/000000.png"]
    code, out, _ = run(scene, "--out", str(tmp_path / "c"), "--effects", "exposure:weak,compression", "--quiet")
    assert code == 0 and out == "" and len(list((tmp_path / "c" / "images").glob("*.jpg"))) == 2
    for arguments, sentence in (
        ([scene, "--out", str(tmp_path / "a")], "already holds something"),
        (["nowhere", "--out", str(tmp_path / "d")], "there is no scene file nowhere"),
        ([scene, "--out", str(tmp_path / "d"), "--effects", "blurr"], "there is no effect 'blurr'"),
    ):
        code, _, err = run(*arguments)
        assert code == 2 and sentence in err and len(err.strip().splitlines()) <= 3 and "Traceback" not in err
    assert not (tmp_path / "d").exists()


def test_a_panorama_camera_films_the_whole_sphere_upright(tmp_path: Path) -> None:
    folder = made(tmp_path / "capture", camera={"kind": "panorama", "width": 128, "height": 64})
    capture = open_capture(folder)
    assert capture.posed and json.loads((folder / "transforms.json").read_text())["camera_model"] == "EQUIRECTANGULAR"
    truth = load_file(folder / "ground_truth" / "frames" / "000001.safetensors")
    frame = capture.frames[1]
    assert frame.intrinsics == Intrinsics.equirectangular(128, 64) and frame.world_from_camera is not None
    assert abs(frame.world_from_camera[2, 2]) < 0.1  # it looks along the horizon
    rays = directions_of(frame.intrinsics, pixel_grid(128, 64)) @ frame.world_from_camera[:3, :3].T
    points = frame.world_from_camera[:3, 3] + rays * truth["depth"].reshape(-1, 1)
    down, up = points[rays[:, 2] < -0.95], points[rays[:, 2] > 0.95]
    assert np.median(np.abs(down[:, 2])) < 0.8 and np.ptp(np.round(up[:, 2], 3)) < 0.02  # floor or furniture below, the ceiling above


def test_a_fisheye_camera_is_the_readers(tmp_path: Path) -> None:
    folder = made(tmp_path / "capture", camera={"kind": "fisheye", "width": 64, "height": 48, "fov": 180})
    camera = open_capture(folder).frames[0].intrinsics
    assert camera is not None and camera.lens == FISHEYE and camera.fx == pytest.approx(64 / np.pi)


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ({"camera": {"kind": "panorama"}}, "a panorama is twice as wide as high"),
        ({"camera": {"fov": 170}}, "a pinhole's fov is at most 140 degrees"),
        ({"camera": {"kind": "fisheye"}, "depth": True}, "the depth camera is a pinhole"),
        ({"camera": {"kind": "fisheye"}, "effects": ["vignetting"]}, "vignetting is listed, which is modelled for a pinhole camera only"),
    ],
)
def test_what_does_not_go_with_a_camera_is_refused(tmp_path: Path, rest: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(scene_file(rest, "test"), tmp_path / "capture")
