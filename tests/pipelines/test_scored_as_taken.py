"""A run whose pictures' light was corrected: everything that it shows is held against the photos as they were taken."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.rendered import load_pictures
from toolkit.capture.views_file import load_views
from toolkit.evaluate.baseline import nearest_image_scores
from toolkit.evaluate.images import psnr
from toolkit.files import read_json
from toolkit.simulate.settings import scene_file
from toolkit.simulate.simulate import simulate

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
    assert report["effects"]["dimmed"] >= 1
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
