"""A run whose pictures' light was corrected: everything that it shows is held against the photos as they were taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from fieldfuse.camera import Similarity
from fieldfuse.capture.storage import load_views
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.geometry import read_mesh
from fieldfuse.evaluation.metrics import psnr
from fieldfuse.evaluation.score import nearest_image_scores
from fieldfuse.evaluation.sphere import around
from fieldfuse.evaluation.sphere import lens as around_lens
from fieldfuse.files import read_json
from fieldfuse.pipelines.cli import app
from fieldfuse.pipelines.pictures import camera_of
from fieldfuse.pipelines.rendered import Pictures, load_pictures, to_picture, write_pngs
from fieldfuse.pipelines.surfaces import write_surface
from fieldfuse.render.image import render_view
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate
from fieldfuse.tone import Tone, exposed
from fieldfuse.tsdf.mesh import Mesh
from fieldfuse.tsdf.volume import Points
from tests.render.made import coloured_field

SCENE = {
    "scene": "room",
    "seed": 3,
    "side": 1,
    "depth": True,
    "camera": {"width": 176, "height": 132},
    "path": {"kind": "walk", "frames": 16, "fps": 5, "speed": 0.5, "shake": 4},
}


def test_field_surface_and_nearest_picture_are_scored_against_the_photos(tmp_path: Path) -> None:
    place, out = tmp_path / "drift", tmp_path / "run"
    simulate(scene_file(SCENE, "test"), place, effects=["exposure:strong", "vignetting:strong"], workers=1)
    told = CliRunner().invoke(
        app, ["run", str(place), "--out", str(out), "--budget", "2", "--threads", "1", "--init", "classical", "--quiet", "--set",
              "effects.off=[poses,distortion,motion_blur]", "--set", "export.formats=[cameras]"]
    )  # fmt: skip
    assert told.exit_code == 0, told.output
    views, found, report = load_views(out / "views.safetensors"), read_json(out / "evaluation.json"), read_json(out / "report.json")
    assert {entry["effect"] for entry in report["effects"]["effects"] if entry["on"]} >= {"exposure", "vignetting"}
    assert report["effects"]["dimmed"] >= 1 and views.exposure == pytest.approx(report["effects"]["dimmed"], rel=1e-3)
    indices = np.flatnonzero(views.test)
    plain = {path.stem: path for path in (place / "images").iterdir()}
    for index in indices:
        photo = cv2.imread(str(plain[Path(views.names[index]).stem]))[..., ::-1]
        assert np.array_equal(views.photo(index), photo) and not np.array_equal(views.images[index], photo)
    for name in ("field", "tsdf"):
        shown = load_pictures(out / "renders" / f"{name}.safetensors")
        pairs = [(views.as_taken(index, shown.pictures[place].rgb / 255), views.photo(index)) for place, index in enumerate(indices)]
        assert found[name]["psnr"] == pytest.approx(np.mean([psnr(*pair) for pair in pairs]), abs=1e-6)  # type: ignore[arg-type]
        canonical = [psnr(picture.rgb, views.photo(index)) for picture, index in zip(shown.pictures, indices, strict=True)]
        assert found[name]["psnr"] > np.mean(canonical) + 3  # type: ignore[arg-type]
    assert found["nearest_image"]["psnr"] == pytest.approx(nearest_image_scores(views, indices)["psnr"], abs=1e-6)
    assert "exports are in the corrected colours" in (out / "report.html").read_text() or report["effects"]["dimmed"] == 1


def views_of(gains: list[float]) -> Views:
    """Small pictures, of which so much was taken out; the last one is held out."""
    count, lens = len(gains), around_lens(24, 18)
    pictures = [np.full((18, 24, 3), 90, np.uint8)] * count
    test = np.arange(count) == count - 1
    tones = [Tone((gain,) * 3, 0.5) for gain in gains]
    return Views([f"{i}" for i in range(count)], pictures, [lens] * count, np.array(around()[:count]), test, tones=tones)


def test_exposure_is_what_was_taken_out_of_the_training_pictures() -> None:
    assert views_of([1.0, 4.0, 9.0]).exposure == pytest.approx(2.0)
    assert views_of([1.0, 4.0, 9.0]).subset([0]).exposure == 1 and views_of([0.5, 2.0, 9.0]).exposure == 1
    assert views_of([1.0002, 1.0, 9.0]).exposure == 1  # rounded gains
    assert replace(views_of([2.0, 2.0]), tones=[]).exposure == 1 and views_of([2.0]).exposure == 1  # nothing is fitted: nothing is known


def test_cameras_points_and_meshes_show_it_as_bright_as_it_was_taken(tmp_path: Path) -> None:
    field, views = coloured_field(), views_of([1.5, 1.5, 9.0])
    lens, pose = views.intrinsics[0], views.world_from_camera[0]
    plain = to_picture(render_view(field, lens, pose)).rgb
    seen = camera_of(None, field, views, None, baked=False)(lens, pose)  # type: ignore[arg-type]
    assert plain.std() > 5 and np.array_equal(to_picture(seen).rgb, exposed(plain, views.exposure))
    same = camera_of(None, field, replace(views, tones=[]), None, baked=False)(lens, pose)  # type: ignore[arg-type]
    assert same.rgb.dtype != np.uint8 and np.array_equal(to_picture(same).rgb, plain)

    picture = to_picture(render_view(field, lens, pose))
    png, _ = write_pngs(tmp_path, "field", Pictures(["a"], [picture], [0.0]), views.exposure)
    assert np.array_equal(cv2.imread(str(png))[..., ::-1], exposed(plain, views.exposure))

    colours = np.random.default_rng(0).integers(0, 256, (4, 3), dtype=np.uint8)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = Mesh.create(corners, np.array([[0, 1, 2], [0, 3, 1]]), colours, np.tile([0.0, 0, 1], (4, 1)))
    ready: Any = SimpleNamespace(scene=SimpleNamespace(working_from_input=Similarity.identity()), views=SimpleNamespace(exposure=1.5))
    write_surface(ready, tmp_path, mesh, Points(corners, colours, np.tile([0.0, 0, 1], (4, 1))))
    assert np.array_equal(read_mesh(tmp_path / "mesh.ply").colours, exposed(colours, 1.5))
    assert np.array_equal(trimesh.load(tmp_path / "points.ply").colors[:, :3], exposed(colours, 1.5))  # type: ignore[union-attr]
