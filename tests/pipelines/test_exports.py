"""What `fieldfuse export` adds, what a run writes from then on, and what becomes of it when the capture is gone."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from fieldfuse.files import read_json
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.fields import fit_radiance_field, starting_field
from fieldfuse.pipelines.job import open_job
from fieldfuse.pipelines.options import Place, gather
from fieldfuse.pipelines.prepare import choose_frames, find_capture, prepare
from fieldfuse.pipelines.stages import BEFORE
from tests.capture.films import film
from tests.pipelines.made import call, circle, shoot
from tests.pipelines.short import ALONE, finished, stages

Capsys = pytest.CaptureFixture[str]
FEW = ["--image-size", "48", "--budget", "1", *ALONE, "--set", "field.resolution=16", "--set", "export.mesh_views=3", "--quiet", "--json"]
WISH = ["--set", "export.formats=[points,cameras]"]
AGAIN = ["--threads", "1", "--quiet", "--json"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on pictures half as wide as the photos are, so that meshes need the photos: a folder with it and its capture."""
    folder = tmp_path_factory.mktemp("exports")
    finished(folder / "now" / "out", 10, *FEW, *WISH)
    shutil.copytree(folder / "now", folder / "made")
    return folder


@pytest.fixture
def out(made: Path) -> Path:
    """The run with its capture at the place where they were made, as they were."""
    shutil.rmtree(made / "now")
    shutil.copytree(made / "made", made / "now")
    return made / "now" / "out"


def files(out: Path) -> set[str]:
    return {path.name for path in (out / "exports").iterdir()} - {"facts.json"}


def test_formats_of_one_command_are_not_those_of_the_run(out: Path, capsys: Capsys) -> None:
    asked = {"points.ply", "cameras"}
    assert files(out) == asked
    answer = call(capsys, "export", out, "--formats", "ply", *AGAIN)
    assert answer.code == 0 and not stages(json.loads(answer.out))["export"], answer.err
    assert files(out) == asked | {"mesh.ply"} and (out / "mesh.ply").is_file()
    assert read_json(out / "run.json")["settings"]["export"]["formats"] == ["points", "cameras"]
    # What the run's settings name is there all the time, and is reused.
    assert stages(json.loads(call(capsys, "export", out, *AGAIN).out))["export"]
    again = json.loads(call(capsys, "run", out.parent / "room", "--out", out, *FEW, *WISH).out)
    assert all(stages(again).values()), stages(again)
    assert files(out) == asked | {"mesh.ply"}
    # Of the next field it is made; what was added for once is removed, and that is told.
    answer = call(capsys, "finetune", out, "--budget", 0.5, *AGAIN)
    assert answer.code == 0, answer.err
    assert files(out) == asked
    assert any(note.startswith("of an earlier field, and removed: mesh.ply; `fieldfuse") for note in json.loads(answer.out)["warnings"])


def test_info_tells_what_is_of_an_earlier_field(out: Path, capsys: Capsys) -> None:
    def told() -> tuple[list[str], set[str]]:
        data = json.loads(call(capsys, "info", out, "--json").out)
        return data["outdated"], {stage["name"] for stage in data["stages"] if stage["outdated"]}

    assert told() == ([], set())
    # As far as a `finetune` comes that is interrupted after its fit.
    with open_job(Place(out), gather(None, None, None, budget=0.3), make_progress(True), BEFORE) as job:
        ready = prepare(job)
        fit_radiance_field(job, ready, starting_field(job, ready), go_on=True)
    sentences, stale = told()
    assert stale == {"render", "evaluate", "export"} and len(sentences) == 2
    text = call(capsys, "info", out).out
    assert f"`fieldfuse evaluate {out}` renews them" in text and f"`fieldfuse export {out}` renews them" in text
    assert "render" in text and text.count("(out of date)") == 3
    assert call(capsys, "export", out, *AGAIN).code == 0
    assert told()[1] == {"render"}  # what is scored of a field is not made by an export
    assert call(capsys, "evaluate", out, *AGAIN).code == 0
    assert told() == ([], set())


def test_a_part_is_not_taken_for_the_whole(out: Path, capsys: Capsys) -> None:
    (out / "exports" / "points.ply").unlink()
    assert call(capsys, "export", out, "--formats", "cameras", *AGAIN).code == 0
    assert files(out) == {"cameras"}
    assert call(capsys, "export", out, *AGAIN).code == 0
    assert files(out) == {"cameras", "points.ply"}
    answer = call(capsys, "export", out, "--formats", "textur")
    assert answer.code == 2 and "--formats: there is no format 'textur' (did you mean 'texture'?)" in answer.sentence()


def test_without_the_capture_nothing_is_lost_and_all_is_told(out: Path, capsys: Capsys) -> None:
    room, away = out.parent / "room", out.parent / "away"
    room.rename(away)
    for formats in ("ply", "texture", "points,texture"):
        answer = call(capsys, "export", out, "--formats", formats, "--threads", 1, "--quiet")
        assert answer.code == 2 and "nothing was exported: points and meshes were left out: the folder of the capture, " in answer.err
        assert f"{room}, is not there any more" in answer.err and "put it back" in answer.sentence()
    answer = call(capsys, "export", out, "--formats", "glb,cameras", *AGAIN)
    assert answer.code == 0, answer.err
    assert any(f"the folder of the capture, {room}, is not there any more" in note for note in json.loads(answer.out)["warnings"])

    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    answer = call(capsys, "finetune", out, "--budget", 0.5, "--threads", 1, "--quiet")
    assert answer.code == 2 and "put it back" in answer.sentence() and "--set 'export.formats=[cameras]'" in answer.err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    answer = call(capsys, "finetune", out, "--budget", 0.5, "--set", "export.formats=[cameras]", *AGAIN)
    assert answer.code == 0 and files(out) == {"cameras"}, answer.err
    assert any("of an earlier field, and removed: points.ply; " in note for note in json.loads(answer.out)["warnings"])

    away.rename(room)
    assert call(capsys, "export", out, "--set", "export.formats=[glb,cameras]", *AGAIN).code == 0
    assert files(out) == {"cameras", "mesh.glb"}


def test_a_capture_that_was_moved_is_the_same_one(out: Path, capsys: Capsys) -> None:
    room, away = out.parent / "room", out.parent / "elsewhere" / "hall"
    shutil.copytree(room, out.parent / "double")
    away.parent.mkdir()
    arguments = ["--out", out, *FEW, *WISH]
    answer = call(capsys, "run", out.parent / "double", *arguments)
    assert answer.code == 2 and "choose another --out folder" in answer.sentence()  # the run's own capture is still there
    room.rename(away)
    picture = out.parent / "double" / "images" / "003.png"
    os.utime(picture, ns=(0, 0))
    answer = call(capsys, "run", out.parent / "double", *arguments)
    assert answer.code == 2 and "is not there any more, and the files of" in answer.sentence()
    answer = call(capsys, "run", away, *arguments)
    assert answer.code == 0 and all(stages(json.loads(answer.out)).values()), answer.err
    assert read_json(out / "run.json")["source"] == str(away) and str(room) not in (out / "capture.json").read_text()
    answer = call(capsys, "export", out, "--formats", "ply", *AGAIN)  # needs its pictures
    assert answer.code == 0 and "mesh.ply" in files(out), answer.err


def test_a_video_that_was_moved_keeps_its_frames(tmp_path: Path) -> None:
    seen = [shoot(pose)[0] for pose in circle(60, 0.25)]
    before, now = film(tmp_path / "films" / "walk.mp4", seen), tmp_path / "kept" / "walk.mp4"
    now.parent.mkdir()
    for source in (before, now):
        with open_job(Place(source, tmp_path / "out"), gather(), make_progress(True)) as job:
            chosen = choose_frames(job, find_capture(job))
        assert job.stages.cached == dict.fromkeys(("capture", "frames"), source == now)
        assert chosen.root == source.parent and {frame.image.parent for frame in chosen.frames} == {tmp_path / "out" / "frames"}
        if source == before:
            before.rename(now)
    assert str(before) not in (tmp_path / "out" / "capture.json").read_text()


def test_what_could_not_be_made_without_the_capture_is_made_when_it_is_back(out: Path, capsys: Capsys) -> None:
    room, away = out.parent / "room", out.parent / "away"
    room.rename(away)
    wish = ["--set", "export.formats=[glb,cameras]"]
    for _ in range(2):
        answer = call(capsys, "export", out, *wish, *AGAIN)
        assert answer.code == 0 and "mesh.glb" not in files(out), answer.err
    away.rename(room)
    assert call(capsys, "export", out, *AGAIN).code == 0
    assert files(out) >= {"cameras", "mesh.glb"}


def test_cameras_come_with_points_and_pinhole_images_with_both(out: Path, capsys: Capsys) -> None:
    (out / "exports" / "points.ply").unlink()
    answer = call(capsys, "export", out, "--formats", "cameras", "--undistorted", *AGAIN)
    assert answer.code == 0 and files(out) == {"cameras", "undistorted"}, answer.err
    folder = out / "exports" / "undistorted"
    for lines in ((out / "exports" / "cameras" / "colmap" / "points3D.txt"), folder / "sparse" / "0" / "points3D.txt"):
        assert len(lines.read_text().splitlines()) > 50
    data = read_json(folder / "transforms.json")
    assert {entry["file_path"] for entry in data["frames"]} == {f"images/{path.name}" for path in (folder / "images").iterdir()}
    assert len(data["frames"]) == 10 and len(data["test_filenames"]) == 2
    shutil.rmtree(out.parent / "room")
    answer = call(capsys, "export", out, "--undistorted", *AGAIN)
    assert answer.code == 2 and "undistorted images were left out" in answer.sentence()


def test_a_crop_holds_for_all_that_is_exported(out: Path, capsys: Capsys) -> None:
    cloud = trimesh.load(out / "exports" / "points.ply", process=False)
    low, high = cloud.vertices.min(axis=0), cloud.vertices.max(axis=0)
    box = [*low, *(0.5 * low + 0.5 * high)]
    numbers = ",".join(f"{value:.6f}" for value in box)
    answer = call(capsys, "export", out, "--formats", "points,ply", "--crop", numbers, *AGAIN)
    assert answer.code == 0, answer.err
    warnings = json.loads(answer.out)["warnings"]
    assert any("exports are cropped" in text for text in warnings)
    assert any("another crop, and removed" in text and "transforms.json" in text for text in warnings)
    assert files(out) == {"points.ply", "mesh.ply", "cameras"} and not (out / "exports" / "cameras" / "transforms.json").exists()
    size = np.ptp(np.asarray(cloud.vertices), axis=0).max()
    for name in ("points.ply", "mesh.ply"):
        part = trimesh.load(out / "exports" / name, process=False)
        assert len(part.vertices) > 10
        assert (part.vertices >= low - 0.1 * size).all() and (part.vertices <= box[3:] + 0.1 * size).all()
    # The next export has the same part, and --crop off all of it.
    assert read_json(out / "run.json")["settings"]["export"]["crop"] == numbers
    answer = call(capsys, "export", out, "--formats", "glb", *AGAIN)
    assert answer.code == 0 and {"points.ply", "mesh.glb"} <= files(out)
    assert call(capsys, "export", out, "--formats", "points", "--crop", "off", *AGAIN).code == 0
    assert files(out) == {"points.ply", "cameras"}
    again = trimesh.load(out / "exports" / "points.ply", process=False)
    assert np.allclose(again.vertices.max(axis=0), high)
    answer = call(capsys, "export", out, "--crop", "9000,9000,9000,9001,9001,9001", *AGAIN)
    assert answer.code == 2 and "nothing of the field lies in the region" in answer.sentence()
    answer = call(capsys, "export", out, "--crop", "bix", *AGAIN)
    assert answer.code == 2 and "did you mean" not in answer.sentence() and "x0,y0,z0,x1,y1,z1" in answer.sentence()


def test_parts_of_a_large_field_are_the_runs_as_long_as_it_is_large(out: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.export.page.MOST_BYTES", 0)
    answer = call(capsys, "export", out, "--formats", "page", *AGAIN)
    assert answer.code == 0, answer.err
    parts = out / "exports" / "field_parts"
    listed = {name for name in read_json(out / "stages" / "export.json")["outputs"] if "field_parts" in name}
    assert len(listed) >= 2 and listed == {path.relative_to(out).as_posix() for path in parts.iterdir()}
    assert [row["path"] for row in read_json(out / "report.json")["exports"] if "field" in row["path"]] == ["exports/field.html"]
    monkeypatch.undo()
    answer = call(capsys, "export", out, "--formats", "page", *AGAIN)
    assert answer.code == 0 and not parts.exists() and (out / "exports" / "field.html").is_file()
    assert not any(".bin" in text for text in json.loads(answer.out)["warnings"])
    assert not [name for name in read_json(out / "stages" / "export.json")["outputs"] if "field_parts" in name]
