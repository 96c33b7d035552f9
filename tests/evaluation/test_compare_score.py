"""Scores of several methods side by side, and the truth that a capture brings."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from fieldfuse.camera import OPENCV, Array, Intrinsics
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.compare_truth import find_truth, true_depths
from fieldfuse.evaluation.metrics import depth_accuracy, psnr, ssim
from fieldfuse.evaluation.score import compare_views, depth_scale, matched_depth_scores
from fieldfuse.stereo.match import StereoDepth

CAMERA = Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """LPIPS has tests of its own; here it would only take time."""
    monkeypatch.setattr("fieldfuse.evaluation.perceptual._layers", lambda: None)


@dataclass
class Shown:
    rgb: Array
    depth: Array
    mask: Array | None = None


def made(count: int = 3) -> tuple[Views, list[Shown], list[Shown]]:
    """Views with depth; a field that is a little off everywhere; a surface that is exact on the left half and missing on the right."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (36, 48, 3)).astype(np.uint8) for _ in range(count)]
    depths: list[Array | None] = [np.full((36, 48), 2.0, np.float32) for _ in range(count)]
    views = Views([str(i) for i in range(count)], images, [CAMERA] * count, np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool))
    views.depths = depths
    left = np.broadcast_to(np.arange(48) < 24, (36, 48))
    field = [Shown(np.clip(image / 255 + 0.05, 0, 1), np.full((36, 48), 2.06, np.float32)) for image in images]
    surface = [Shown(np.where(left[..., None], image, 0).astype(np.uint8), np.where(left, 2.0, 0), left) for image in images]
    return views, field, surface


def test_both_are_scored_on_the_same_pixels() -> None:
    views, field, surface = made()
    out = compare_views({"field": field, "tsdf": surface}, views, [0, 1, 2], {"field": [1, 2, 3], "tsdf": [0.1, 0.1, 0.1]})
    assert out["tsdf"]["on"]["tsdf"]["psnr"] == 100 and out["tsdf"]["psnr"] < 15
    assert out["tsdf"]["coverage"] == 0.5 and out["field"]["coverage"] is None
    assert out["field"]["seconds_per_view"] == 2
    left = surface[0].mask
    expected = [psnr(one.rgb, image, left) for one, image in zip(field, views.images, strict=True)]
    assert out["field"]["on"]["tsdf"]["psnr"] == pytest.approx(np.mean(np.array(expected, float)))
    expected = [ssim(one.rgb, image, left) for one, image in zip(field, views.images, strict=True)]
    assert out["field"]["on"]["tsdf"]["ssim"] == pytest.approx(np.mean(np.array(expected, float)))
    assert set(out["tsdf"]["on"]) == {"tsdf"}  # one surface on the pixels of another says nothing


def test_depth_is_told_in_shares_of_the_scale() -> None:
    views, field, surface = made()
    out = compare_views({"field": field, "tsdf": surface}, views, [0, 1, 2])
    assert out["field"]["depth_scale"] == 2
    assert out["field"]["abs_err"] == pytest.approx(0.03, rel=1e-5)
    assert (out["field"]["acc_1"], out["field"]["acc_5"]) == (0, 1)
    assert (out["tsdf"]["abs_err"], out["tsdf"]["acc_1"], out["tsdf"]["acc_5"]) == (0, 0.5, 0.5)
    assert out["tsdf"]["depth"]["coverage"] == 0.5


def test_true_depth_replaces_the_sensors() -> None:
    views, field, _ = made()
    exact: list[Array | None] = [np.full((36, 48), 4.12, np.float32), None]
    out = compare_views({"field": field[1:]}, views, [1, 2], depths=exact)
    assert out["field"]["abs_err"] == pytest.approx(0.5, rel=1e-4) and out["field"]["depth_scale"] == pytest.approx(4.12)
    assert views.depths[1] is not None and views.depths[1][0, 0] == 2  # the views themselves stay
    views.depths = []
    assert compare_views({"field": field}, views, [0, 1, 2])["field"]["abs_err"] is None


def test_depth_accuracy_counts_what_is_missing_as_wrong() -> None:
    truth, rendered = np.full((2, 2), 1.0), np.array([[1.005, 1.03], [0, np.nan]])
    found = depth_accuracy(rendered, truth, 1.0)
    assert found == {"abs_err": pytest.approx(0.0175), "acc_1": 0.25, "acc_5": 0.5}
    assert depth_accuracy(rendered, truth, 1.0, np.array([[True, False], [False, False]]))["acc_1"] == 1
    assert depth_accuracy(rendered, np.zeros((2, 2)), 1.0) == {"abs_err": None, "acc_1": None, "acc_5": None}
    assert depth_scale([None, np.zeros((3, 3))]) is None


def capture_with_truth(folder: Path, lens: Intrinsics = CAMERA) -> tuple[Capture, Array]:
    depth = np.random.default_rng(0).uniform(1, 3, (36, 48)).astype(np.float32)
    (folder / "ground_truth" / "frames").mkdir(parents=True)
    save_file({"depth": depth}, str(folder / "ground_truth" / "frames" / "0.safetensors"))
    frames = [{"picture": "images/0.png", "truth": "ground_truth/frames/0.safetensors"}]
    (folder / "ground_truth" / "cameras.json").write_text(json.dumps({"intrinsics": lens.to_dict(), "frames": frames}))
    listed = tuple(Frame(name, folder / "images" / f"{name}.png", CAMERA, np.eye(4)) for name in ("0", "1"))
    return Capture("transforms", folder, listed), depth


def test_true_depth_is_found_and_brought_to_the_view(tmp_path: Path) -> None:
    capture, depth = capture_with_truth(tmp_path)
    truth = find_truth(capture)
    assert truth is not None and truth.mesh is None
    small = CAMERA.scaled(24, 18)
    blank = np.zeros((36, 48, 3), np.uint8)
    views = Views(["0", "1"], [blank, blank], [CAMERA, small], np.tile(np.eye(4), (2, 1, 1)), np.ones(2, bool))
    first, second = true_depths(truth, capture, views, [0, 1], 2.0)
    assert first is not None and np.array_equal(first, 2 * depth) and second is None
    views.intrinsics[0] = small
    (half,) = true_depths(truth, capture, views, [0], 1.0)
    assert half is not None and half.shape == (18, 24) and np.isin(half, depth).all()


def test_true_depth_through_a_lens_is_straightened(tmp_path: Path) -> None:
    bent = Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0, OPENCV, (-0.2, 0.03, 0.0, 0.0))
    capture, depth = capture_with_truth(tmp_path, bent)
    truth = find_truth(capture)
    assert truth is not None
    views = Views(["0"], [np.zeros((36, 48, 3), np.uint8)], [CAMERA], np.eye(4)[None], np.ones(1, bool))
    (straight,) = true_depths(truth, capture, views, [0], 1.0)
    assert straight is not None
    assert straight[18, 24] == depth[18, 24]  # the middle stays
    assert straight[18, 44] == depth[18, 43]  # the edge moves outwards


def test_truth_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    assert find_truth(Capture("transforms", tmp_path, ())) is None
    capture, _ = capture_with_truth(tmp_path)
    path = tmp_path / "ground_truth" / "cameras.json"
    data = json.loads(path.read_text())
    data["frames"][0]["truth"] = "../../outside.safetensors"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match="outside"):
        find_truth(capture)
    path.write_text("[]")
    with pytest.raises(InputError, match="does not list cameras"):
        find_truth(capture)
    path.unlink()
    assert find_truth(capture) is None
    (tmp_path / "ground_truth" / "mesh.ply").write_text("a mesh")
    found = find_truth(capture)
    assert found is not None and found.mesh is not None and not found.depths


def test_damaged_true_depth_is_named(tmp_path: Path) -> None:
    capture, _ = capture_with_truth(tmp_path)
    file = tmp_path / "ground_truth" / "frames" / "0.safetensors"
    file.write_bytes(file.read_bytes()[:200])
    truth = find_truth(capture)
    assert truth is not None
    views = Views(["0"], [np.zeros((36, 48, 3), np.uint8)], [CAMERA], np.eye(4)[None], np.ones(1, bool))
    with pytest.raises(InputError, match=r"0\.safetensors"):
        true_depths(truth, capture, views, [0], 1.0)


def test_matched_depth_is_measured_on_textured_pixels_too() -> None:
    rng = np.random.default_rng(0)
    image = np.full((36, 48, 3), 120, np.uint8)
    image[:, :24] = rng.integers(0, 256, (36, 24, 3))  # texture on the left half
    views = Views(["a", "b"], [image, image], [CAMERA] * 2, np.tile(np.eye(4), (2, 1, 1)), np.zeros(2, bool))
    truth = np.full((36, 48), 2.0, np.float32)
    depth = np.where(np.arange(48) < 18, np.float32(2.02), np.float32(0)) * np.ones((36, 1), np.float32)
    depth[:, 40:] = 3.0
    found = StereoDepth(depth, (depth > 0).astype(np.float32), CAMERA)
    scores = matched_depth_scores(views, [found, found], [truth, None])
    assert scores is not None and scores["views"] == 1
    assert scores["coverage"] == pytest.approx(26 / 48) and scores["median_rel"] == pytest.approx(0.01, rel=1e-4)
    assert scores["coverage_textured"] == pytest.approx(18 / 27, abs=0.03)  # windows reach three pixels over the edge
    assert scores["textured"] == pytest.approx(27 / 48, abs=0.03)
    large = np.full((72, 96), 2.0, np.float32)
    again = matched_depth_scores(views, [found, found], [large, large])
    assert again is not None and again["views"] == 2 and again["coverage"] == scores["coverage"]
    assert matched_depth_scores(views, [found, found], [None, np.zeros_like(truth)]) is None
