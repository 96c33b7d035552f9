"""The texture of a run is made of pictures as they were taken, also where the fit has smaller ones."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from fieldfuse.effects.correct import Corrections
from fieldfuse.errors import InputError
from fieldfuse.export.surface import Originals
from fieldfuse.files import read_json
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.job import open_job
from fieldfuse.pipelines.options import Place, gather
from fieldfuse.pipelines.prepare import prepare
from fieldfuse.tone import Tone
from tests.pipelines.made import CAMERA, call, make_room, said
from tests.pipelines.short import ALONE, steady

Capsys = pytest.CaptureFixture[str]
FEW = ["--image-size", "48", "--budget", "1", *ALONE, "--set", "field.resolution=32", "--set", "export.mesh_views=6", "--quiet"]
FEW += ["--set", "tsdf.enabled=off"]
TAKEN = CAMERA.scaled(192, 144)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on pictures a quarter as wide as the photos are."""
    folder = tmp_path_factory.mktemp("textured")
    make_room(folder / "room", 9, depth=True, camera=TAKEN)
    with steady():
        answer = said("run", folder / "room", "--out", folder / "out", *FEW, "--set", "export.formats=[texture]")
    assert answer.code == 0, answer.err
    return folder


def test_a_texture_has_texels_of_the_photos(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = shutil.copytree(run / "out", tmp_path / "out")
    large = trimesh.load(out / "exports" / "textured.glb").to_geometry().visual.material.baseColorTexture.size
    assert call(capsys, "export", out, "--set", "export.texture_size=48", "--formats", "texture", "--quiet").code == 0
    small = trimesh.load(out / "exports" / "textured.glb").to_geometry().visual.material.baseColorTexture.size
    assert large[0] > small[0]


def test_formats_of_other_programs_are_made_when_they_are_named(
    run: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    out = shutil.copytree(run / "out", tmp_path / "out")
    monkeypatch.setitem(sys.modules, "pxr", None)
    answer = call(capsys, "export", out, "--formats", "points,laz,usdz,e57", "--quiet")
    assert answer.code == 0, answer.err
    made = {path.name for path in (out / "exports").iterdir()} - {"facts.json"}
    assert made == {"textured.glb", "points.ply", "points.laz", "points.e57"}
    cloud, read = trimesh.load(out / "exports" / "points.ply", process=False), laspy.read(out / "exports" / "points.laz")
    assert np.abs(read.xyz - cloud.vertices).max() < 1e-5 and np.array_equal(np.asarray(read.red) // 257, cloud.colors[:, 0])
    said_so = " ".join(read_json(out / "report.json")["warnings"])
    assert 'usdz was left out: the format usdz needs the package pxr; install it (pip install "fieldfuse[usd]")' in said_so
    answer = call(capsys, "export", out, "--formats", "usdz", "--quiet")
    assert answer.code == 2 and answer.sentence().count("usdz") == 2
    monkeypatch.delitem(sys.modules, "pxr")
    pytest.importorskip("pxr", reason="the extra `usd` is not installed")
    answer = call(capsys, "export", out, "--formats", "usdz", "--quiet")
    assert answer.code == 0 and (out / "exports" / "textured.usdz").is_file(), answer.err


@pytest.mark.parametrize(("side", "expected"), [(1280, 192), (96, 96), (48, None), (20, None)])
def test_pictures_are_as_large_as_they_were_taken(run: Path, side: int, expected: int | None) -> None:
    """Up to so many pixels; where that is no more than the fit has, its own pictures."""
    options = gather(None, None, None, image_size=48)
    with open_job(Place(run / "room", run / "other"), options, make_progress(True)) as job:
        ready = prepare(job)
        posed, views = ready.posed, ready.views
        train = np.flatnonzero(~views.test)
        shown = views.subset(train)
        lenses, pictures = Originals(posed, ready.corrections).at(train, shown, side)
        found = list(pictures)
    assert len(found) == len(lenses) == len(train)
    if expected is None:
        assert lenses == shown.intrinsics and all(a is b for a, b in zip(found, shown.images, strict=True))
        return
    for index, lens, picture in zip(train, lenses, found, strict=True):
        assert picture.shape == (lens.height, lens.width, 3) == (expected * 3 // 4, expected, 3)
        assert lens.fx == pytest.approx(TAKEN.fx * expected / 192)
        whole = cv2.imread(str(posed.frames[index].image))
        assert whole is not None
        small = cv2.resize(whole, (expected, expected * 3 // 4), interpolation=cv2.INTER_AREA)[..., ::-1]
        assert np.array_equal(picture, small)


def test_large_pictures_are_corrected_as_those_of_the_fit(run: Path) -> None:
    with open_job(Place(run / "room", run / "other"), gather(None, None, None, image_size=48), make_progress(True)) as job:
        ready = prepare(job)
        posed, views = ready.posed, ready.views
        shown = views.subset([1])
        plain = next(iter(Originals(posed, ready.corrections).at(np.array([1]), shown, 1280)[1]))
        made = Corrections({views.names[1]: (1.5, 1.0, 0.8)})
        corrected = next(iter(Originals(posed, made).at(np.array([1]), shown, 1280)[1]))
    assert np.array_equal(corrected, Tone((1.5, 1.0, 0.8)).undone(plain, TAKEN)[0])
    assert (corrected[..., 0] < plain[..., 0]).mean() > 0.9 and np.array_equal(corrected[..., 1], plain[..., 1])


def test_a_mesh_is_made_of_pictures_as_they_were_taken_where_there_is_room(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = gather(None, None, ["export.mesh_size=128"], image_size=48)
    with open_job(Place(run / "room", run / "other"), options, make_progress(True)) as job:
        ready = prepare(job)
        posed, views = ready.posed, ready.views
        train = np.flatnonzero(~views.test)
        shown, cameras = Originals(posed, ready.corrections).finer(views, train, job.settings.export)
        assert {picture.shape for picture in shown.images} == {(96, 128, 3)}
        assert {(camera.width, camera.height) for camera in cameras} == {(128, 96)}
        assert shown.names == [views.names[index] for index in train]
        monkeypatch.setattr("fieldfuse.memory.available", lambda: 130 * 2**20)
        shown, cameras = Originals(posed, ready.corrections).finer(views, train, job.settings.export)
        assert {picture.shape for picture in shown.images} == {(36, 48, 3)} and {camera.width for camera in cameras} == {48}


@pytest.mark.parametrize("name", ["texture_size", "mesh_size"])
def test_a_size_of_nothing_is_refused(tmp_path: Path, capsys: Capsys, name: str) -> None:
    make_room(tmp_path / "room", 4)
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", "--set", f"export.{name}=0")
    assert answer.code == 2 and f"export.{name} is 0; it must be greater than 0" in answer.sentence()


def test_a_mesh_stays_when_its_texture_cannot_be_made(
    run: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_many(*_: object, **__: object) -> None:
        raise InputError("80000 triangles do not fit into a texture")

    monkeypatch.setattr("fieldfuse.export.texture.textured", too_many)
    out = shutil.copytree(run / "out", tmp_path / "out")
    (out / "exports" / "textured.glb").unlink()
    answer = call(capsys, "run", run / "room", "--out", out, *FEW, "--set", "export.formats=[ply,texture]")
    assert answer.code == 0, answer.err
    assert (out / "exports" / "mesh.ply").is_file() and not (out / "exports" / "textured.glb").exists()
    assert "the texture was left out: 80000 triangles" in " ".join(read_json(out / "report.json")["warnings"])
