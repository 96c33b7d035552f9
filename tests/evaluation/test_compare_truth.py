"""The exact depth that a capture brings: found, brought to the views, refused when damaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from fieldfuse.camera import OPENCV, Array, Intrinsics
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.errors import InputError
from fieldfuse.evaluation.compare_truth import find_truth, true_depths

CAMERA = Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0)


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
