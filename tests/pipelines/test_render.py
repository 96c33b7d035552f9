"""`fieldfuse render` on a finished run: paths, given cameras, the baked field, and what it refuses."""

from __future__ import annotations

import base64
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.rendered import Picture, Pictures, depth_step, depth_steps, write_pngs
from fieldfuse.poses.scene import Scene
from tests.evaluation.driven import driven, until
from tests.pipelines.made import call, circle, shoot
from tests.pipelines.short import report

Capsys = pytest.CaptureFixture[str]


def test_render_paths(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "render", done, "--frames", 3, "--to", tmp_path / "o.mp4", "--image-size", 32, "--quiet")
    assert answer.code == 0, answer.err
    film = cv2.VideoCapture(str(tmp_path / "o.mp4"))
    assert (film.get(cv2.CAP_PROP_FRAME_COUNT), film.get(cv2.CAP_PROP_FRAME_WIDTH)) == (3, 32)
    answer = call(capsys, "render", done, "--views", "test", "--to", tmp_path / "test", "--json", "--quiet")
    assert answer.code == 0 and json.loads(answer.out)["pictures"] == 2
    kept = sorted((done / "renders").glob("field_*[0-9].png"))
    for path, before in zip(sorted((tmp_path / "test").iterdir()), kept, strict=True):
        assert np.abs(cv2.imread(str(path)).astype(int) - cv2.imread(str(before))).max() <= 1
    cameras = done / "exports" / "cameras" / "transforms.json"
    answer = call(capsys, "render", done, "--cameras", cameras, "--to", tmp_path / "given", "--image-size", 24, "--quiet")
    assert answer.code == 0, answer.err
    assert len(list((tmp_path / "given").iterdir())) == 16


def test_pictures_of_two_commands_are_not_mixed(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    cameras = read_json(done / "exports" / "cameras" / "transforms.json")
    place = done / "renders" / "cameras"
    for first, count in ((0, 5), (6, 2)):
        write_json(tmp_path / "path.json", {**cameras, "frames": cameras["frames"][first : first + count]})
        answer = call(capsys, "render", done, "--cameras", tmp_path / "path.json", "--image-size", 24, "--quiet", "--json")
        assert answer.code == 0 and json.loads(answer.out)["others"] == 0, answer.err
        names = [Path(frame["file_path"]).stem for frame in cameras["frames"][first : first + count]]
        assert sorted(path.name for path in place.iterdir()) == [f"{index:04d}_{name}.png" for index, name in enumerate(names)]
    assert not list(place.parent.glob(".tmp*"))
    # A folder of one's own keeps what it holds, and that is told.
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "0009_before.png").write_bytes(b"another picture")
    answer = call(capsys, "render", done, "--cameras", tmp_path / "path.json", "--to", mine, "--image-size", 24)
    assert answer.code == 0 and f"note: {mine} holds 1 other pictures" in answer.out and (mine / "0009_before.png").is_file()
    (tmp_path / "file").write_text("in the way")
    answer = call(capsys, "render", done, "--cameras", tmp_path / "path.json", "--to", tmp_path / "file" / "x", "--image-size", 24)
    assert answer.code == 2 and "cannot write" in answer.sentence() and "--out" not in answer.err


def test_the_folder_of_a_run_is_no_capture(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    for name in ("run", "render", "export", "poses"):
        answer = call(capsys, name, done, "--out", tmp_path / "x")
        room = done.parent / "room"
        assert answer.code == 2 and f"{done} is the folder of a run (of {room}); leave --out away to work on it" in answer.sentence()
    assert list(tmp_path.iterdir()) == []


def test_the_baked_field_is_made_once_and_looks_like_the_field(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert call(capsys, "render", done, "--views", "test", "--to", tmp_path / "exact", "--quiet").code == 0
    made = []
    for folder in ("first", "second", "third"):
        if folder == "third":
            os.utime(done / "field.safetensors")  # a field that is newer than its baked copy is baked again
        answer = call(capsys, "render", done, "--views", "test", "--baked", "--to", tmp_path / folder, "--quiet")
        assert answer.code == 0, answer.err
        made.append((done / "exports" / "baked.safetensors").stat().st_mtime_ns)
    assert made[0] == made[1] < made[2]
    for path in sorted((tmp_path / "exact").iterdir()):
        exact, first, second = (cv2.imread(str(tmp_path / folder / path.name)) / 255 for folder in ("exact", "first", "second"))
        assert np.array_equal(first, second)
        assert -10 * np.log10(np.mean((exact - first) ** 2) + 1e-12) > 30


def test_bake_and_report_tell_the_same_number(done: Path, capsys: Capsys) -> None:
    answer = call(capsys, "bake", done, "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["psnr"] == pytest.approx(report(done)["evaluation"]["field"]["psnr"], abs=0.001)


@pytest.mark.parametrize(("scale", "metric", "step"), [(1.0, True, 0.001), (0.02, False, 0.01), (2.0, False, 0.001), (0.02, True, 0.001)])
def test_depth_pictures_are_in_the_inputs_unit(done: Path, tmp_path: Path, scale: float, metric: bool, step: float) -> None:
    scene = Scene.from_dict(read_json(done / "scene.json"))
    scene = replace(scene, working_from_input=replace(scene.working_from_input, scale=scale), metric=metric, far=9.0)
    assert depth_step(scene) == pytest.approx(step)
    depth = np.array([[0.0, 1.5, 3.0, 1e6]], np.float32)  # working units
    picture = Picture(np.zeros((1, 4, 3), np.uint8), depth)
    _, path = write_pngs(tmp_path, "field", Pictures(["a"], [picture], [0.0]), 1.0, depth_steps(scene))
    kept = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    wanted = np.minimum(depth / scale / step, 65535)
    assert kept.dtype == np.uint16 and np.abs(kept - wanted).max() <= 0.51


def test_depth_pictures_of_a_run_are_millimetres(done: Path) -> None:
    assert report(done)["views"]["depth_step"] == 0.001
    shown = cv2.imread(str(min((done / "renders").glob("tsdf_*_depth.png"))), cv2.IMREAD_UNCHANGED)
    truth = shoot(circle(16)[0])[1] * 1000  # the first held-out picture
    assert np.median(np.abs(shown - truth)[shown > 0]) < 20


def test_render_refuses_what_it_cannot_do(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert "orbit or test" in call(capsys, "render", done, "--views", "train").sentence()
    assert ".mp4" in call(capsys, "render", done, "--to", tmp_path / "x.gif").sentence()


def test_a_path_of_the_page_is_rendered_as_the_page_shows_it(done: Path, tmp_path: Path, capsys: Capsys) -> None:
    """In a browser: two views as key poses, what is downloaded is given to `--path`, and the first picture is what stood there."""
    with driven((done / "exports" / "field.html").as_uri(), tmp_path, (400, 300)) as browser:
        until(lambda: browser.run("!!window.fieldfuse"))
        start = browser.run("fieldfuse.about.start")
        told = read_json(done / "report.json")
        held_out = {view["name"] for view in told["evaluation"]["field"]["per_view"]}
        assert browser.run(f"fieldfuse.about.photos[{start}].name") not in held_out
        assert browser.run("fieldfuse.about.metric") == told["scene"]["metric"]
        for shown in (start, 0):
            browser.run(f"fieldfuse.to({shown})")
            until(lambda: browser.run("!fieldfuse.walker.journey"))
            browser.run("document.getElementById('add').click(), document.getElementById('seconds').value = 0.1")
        (tmp_path / "path.json").write_text(browser.run("JSON.stringify(fieldfuse.tools.path())"))
        lens = browser.run("fieldfuse.photoLens")
        width, height = 48, round(48 * lens[1] / lens[0])
        factor = width / lens[0]
        view = f"{factor * lens[2]}, {factor * lens[3]}, {width / 2}, {height / 2}"
        script = f"btoa(String.fromCharCode(...fieldfuse.picture(fieldfuse.about.photos[{start}].pose, [{view}], {width}, {height})))"
        seen = np.frombuffer(base64.b64decode(browser.run(script)), np.uint8).reshape(height, width, 4)[..., :3]
        assert not browser.errors
    for to in (tmp_path / "pictures", tmp_path / "film.mp4"):
        answer = call(capsys, "render", done, "--path", tmp_path / "path.json", "--to", to, "--image-size", width, "--json", "--quiet")
        assert answer.code == 0 and json.loads(answer.out)["pictures"] == 3, answer.err
    assert cv2.VideoCapture(str(tmp_path / "film.mp4")).get(cv2.CAP_PROP_FPS) == 30
    rendered = cv2.imread(str(tmp_path / "pictures" / "0000_camera_0000.png"))[..., ::-1]
    assert rendered.shape == seen.shape and 10 * np.log10(255**2 / ((rendered.astype(float) - seen) ** 2).mean()) > 30
