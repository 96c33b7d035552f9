"""`--marker`, `--scale` and GPS from the command line: what is written, what is said, what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.cli import app
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate

UNIT = 0.4  # of the capture's poses to a metre
SCENE = {
    "scene": "table",
    "seed": 3,
    "camera": {"width": 400, "height": 300, "fov": 42},
    "path": {"kind": "orbit", "frames": 8, "fps": 5, "speed": 0.7},
    "markers": [{"at": [0.25, 0.1, -0.118], "side": 0.12, "number": 3}, {"at": [-0.25, -0.1, -0.118], "side": 0.12, "number": 7}],
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scaled") / "capture"
    simulate(scene_file(SCENE, "the test"), root)
    data = read_json(root / "transforms.json")
    for frame in data["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] *= UNIT
        frame["transform_matrix"] = pose.tolist()
    write_json(root / "transforms.json", data)
    return root


def poses(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["poses", *map(str, arguments), "--json", "--quiet"])
    return result.exit_code, result.stdout if result.exit_code == 0 else str(result.exception or result.output)


def test_markers_make_given_poses_metric(capture: Path, tmp_path: Path) -> None:
    code, out = poses(capture, "--out", tmp_path / "run", "--marker", "DICT_4X4_50:0.12")
    assert code == 0, out
    found = json.loads(out)["poses"]
    assert found["metric"] and found["scaling"]["source"] == "marker" and found["scaling"]["factor"] == pytest.approx(1 / UNIT, rel=0.01)
    assert "all lengths were multiplied by 2." in " ".join(json.loads(out)["warnings"])
    written = read_json(tmp_path / "run" / "exports" / "cameras" / "transforms.json")["frames"]
    true = read_json(capture / "ground_truth" / "cameras.json")["frames"]
    for one, other in zip(written, true, strict=True):
        place, real = np.array(one["transform_matrix"])[:3, 3], np.array(other["world_from_camera"])[:3, 3]
        assert np.linalg.norm(place - real) < 0.01 * np.linalg.norm(real)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--marker", "DICT_6X6_50:0.12"), "shows a marker of DICT_6X6_50"),
        (("--scale", "000001:1,2 nowhere:3,4 = 1"), "no image 'nowhere'"),
        (("--scale", "000001:1,2"), "no length after"),
        (("--depth-scale", "0.25mm"), "has no depth"),
    ],
)
def test_refusals(capture: Path, tmp_path: Path, arguments: tuple[str, ...], why: str) -> None:
    code, said = poses(capture, "--out", tmp_path / "run", *arguments)
    assert code != 0 and why in said
