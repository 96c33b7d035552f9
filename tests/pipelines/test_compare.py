"""`fieldfuse compare` from end to end on small captures: with a sensor, with ground truth, and with pictures alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from safetensors.numpy import save_file

from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.evaluation.compare_truth import GroundTruth
from fieldfuse.export.mesh import write_mesh
from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.comparison import choose_surfaces
from fieldfuse.tsdf.mesh import Mesh
from tests.evaluation.browser import embedded_pictures, open_page
from tests.pipelines.made import bench, call
from tests.pipelines.short import steady
from tests.pipelines.test_matched import CAMERA, make_corner
from tests.poses.textured import PLANES, arc, render

Capsys = pytest.CaptureFixture[str]
PAIRS = ["init=classical", "fit.budget=1", "field.resolution=32", "export.mesh_views=4"]
SMALL = ["--holdout", "4", "--threads", "1", *(word for pair in PAIRS for word in ("--set", pair))]


def corner_mesh() -> Mesh:
    """The textured corner's rectangles as triangles."""
    corners = [
        np.array([corner, np.add(corner, a), np.add(np.add(corner, a), b), np.add(corner, b)], dtype=np.float64) for corner, a, b in PLANES
    ]
    triangles = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * index for index in range(len(corners))]
    return Mesh.create(np.concatenate(corners), np.concatenate(triangles))


def add_truth(folder: Path, count: int = 9) -> None:
    """Mesh and exact depth beside the corner's transforms.json, as a simulated capture has them."""
    truth = folder / "ground_truth"
    (truth / "frames").mkdir(parents=True)
    write_mesh(truth / "mesh.ply", corner_mesh())
    frames = []
    for index, pose in enumerate(arc(count, 44.0)):
        name = f"ground_truth/frames/{index:03d}.safetensors"
        save_file({"depth": render(pose, CAMERA)[1]}, str(folder / name))
        frames.append({"picture": f"images/{index:03d}.png", "truth": name})
    write_json(truth / "cameras.json", {"intrinsics": CAMERA.to_dict(), "frames": frames})


def methods(data: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {method["key"]: method for method in data["methods"]}


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One comparison with everything that there is."""
    folder = tmp_path_factory.mktemp("compare")
    make_corner(folder / "corner", depth=True)
    add_truth(folder / "corner")
    from fieldfuse.pipelines.comparison import compare_run
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.options import Place, gather

    options = gather("fast", None, [*PAIRS[1:], "export.formats=[ply]", "network.voxels=16"], holdout=4, threads=1)
    with steady():
        compare_run(Place(folder / "corner", folder / "out"), options, "auto", make_progress(quiet=True))
    return folder / "out"


def test_all_methods_are_scored_alike(compared: Path) -> None:
    data = read_json(compared / "compare.json")
    found = methods(data)
    assert list(found) == ["field", "direct", "tsdf", "tsdf_stereo", "tsdf_exact"]
    direct = found.pop("direct")
    assert [stage["name"] for stage in direct["stages"]] == ["network", "direct"] and direct["geometry"] is None
    assert direct["score"]["psnr"] > 5 and direct["disk_bytes"] > 1000 and direct["memory_bytes"] > 1000
    for key, method in found.items():
        assert method["score"]["views"] == 3 and method["score"]["psnr"] > 8
        assert method["seconds"] > 0 and method["peak_memory_mb"] > 50 and method["disk_bytes"] > 1000 and method["memory_bytes"] > 1000
        assert method["score"]["acc_5"] is not None and method["geometry"]["f_score_4"] is not None
        assert method["reference"] is (key == "tsdf_exact") or method["reference"] is None
    assert found["field"]["note"] == "fitted to colours and the sensor's depth"
    assert [stage["name"] for stage in found["field"]["stages"]] == ["field", "render"]
    assert found["tsdf"]["score"]["on"]["tsdf"]["psnr"] > found["tsdf"]["score"]["psnr"]
    assert set(found["field"]["score"]["on"]) == {"tsdf", "tsdf_stereo", "tsdf_exact"} == set(direct["score"]["on"])
    assert data["truth"] == {"mesh": True, "depth": "exact", "seen_share": data["truth"]["seen_share"], "unit": "input units"}
    assert 0.1 < data["truth"]["seen_share"] < 0.9


def test_geometry_is_in_the_inputs_units(compared: Path) -> None:
    found = methods(read_json(compared / "compare.json"))
    scene = read_json(compared / "scene.json")
    exact = found["tsdf_exact"]["geometry"]
    assert exact["f_score_1"] > 0.9 and exact["accuracy"] < 0.5 * exact["voxel_size"]
    working = read_json(compared / "compare" / "scores.json")["scores"]["tsdf_exact"]["depth_scale"]
    assert working == pytest.approx(scene["median_depth"], rel=0.3)
    assert 0.01 < exact["voxel_size"] < 0.1  # of a corner of some metres, pictures of 128 pixels
    assert found["tsdf_stereo"]["geometry"]["f_score_4"] > 0.6
    assert found["tsdf_stereo"]["score"]["depth"]["median_rel"] < 0.03 and found["tsdf_stereo"]["score"]["depth"]["coverage"] > 0.6
    matching = read_json(compared / "compare.json")["matching"]
    assert matching["views"] == 6 and matching["median_rel_textured"] < 0.02 and matching["coverage_textured"] > 0.6


def test_the_page_shows_them(compared: Path, tmp_path: Path) -> None:
    html = (compared / "compare.html").read_text(encoding="utf-8")
    shown = embedded_pictures(html)
    assert len(shown) > 40 and all(picture is not None for picture in shown)
    assert "<script" not in html and "http://" not in html.replace("http://www.w3.org", "")
    seen = open_page(compared / "compare.html", tmp_path)
    assert seen.pictures == len(shown) and not seen.broken and not seen.errors


def test_its_table_goes_into_a_page(compared: Path, tmp_path: Path, capsys: Capsys) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Numbers\n", encoding="utf-8")
    assert bench(capsys, "table", compared / "compare.json", "--into", page, "--name", "corner").code == 0
    text = page.read_text(encoding="utf-8")
    head = "|  | Field | Field, not fitted | TSDF | TSDF of matched pictures | TSDF of exact depth |"
    assert head in text and "F-score at 1 voxel" in text and "Depth by matching, training views" in text
    assert all(line.count("|") == 7 for line in text.splitlines() if line.startswith("|"))


def test_a_second_look_reuses_everything(compared: Path, capsys: Capsys) -> None:
    before = read_json(compared / "compare.json")
    answer = call(capsys, "compare", compared, "--quiet", "--json")
    assert answer.code == 0, answer.err
    again = json.loads(answer.out)
    assert all(stage["cached"] for stage in again["stages"])
    assert [method["score"] for method in again["methods"]] == [method["score"] for method in before["methods"]]
    only = json.loads(call(capsys, "compare", compared, "--depth", "matching", "--quiet", "--json").out)
    assert list(methods(only)) == ["field", "direct", "tsdf_stereo"]


def test_pictures_alone(tmp_path: Path, capsys: Capsys) -> None:
    make_corner(tmp_path / "corner", 7)
    answer = call(capsys, "compare", tmp_path / "corner", "--out", tmp_path / "out", "--preset", "fast", *SMALL)
    assert answer.code == 0, answer.err
    assert "TSDF of matched pictures" in answer.out and "PSNR" in answer.out and "compare.html" in answer.out
    data = read_json(tmp_path / "out" / "compare.json")
    assert list(methods(data)) == ["field", "tsdf_stereo"]
    assert data["truth"]["mesh"] is False and data["truth"]["depth"] is None
    # The field knew the matched depth, and its time says so.
    assert [stage["name"] for stage in methods(data)["field"]["stages"]] == ["stereo", "field", "render"]
    assert methods(data)["tsdf_stereo"]["geometry"] is None and methods(data)["tsdf_stereo"]["score"]["coverage"] > 0.5
    assert not list((tmp_path / "out" / "exports").glob("*.mp4"))  # only what is compared is made


def test_little_depth_is_told(tmp_path: Path, capsys: Capsys) -> None:
    """Pictures that mostly show a bare wall: the surface is made of what there is, and the page says so."""
    make_corner(tmp_path / "corner", 6)
    for path in (tmp_path / "corner" / "images").iterdir():
        picture = cv2.imread(str(path))
        picture[:, :100] = 120
        cv2.imwrite(str(path), picture)
    options = [*SMALL, "--set", "field.background=off"]
    answer = call(capsys, "compare", tmp_path / "corner", "--out", tmp_path / "out", "--preset", "fast", *options, "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert any("matching the pictures gave depth for" in warning for warning in json.loads(answer.out)["warnings"])
    assert "--poses sfm finds others" in (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")


def test_what_cannot_be_compared_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    make_corner(tmp_path / "corner", 5)
    for arguments, words in (
        (["--holdout", "0"], "--holdout 8"),
        (["--holdout", "3", "--depth", "sensor"], "no sensor depth"),
        (["--holdout", "3", "--depth", "lidar"], "auto, or of sensor, matching, exact"),
    ):
        answer = call(capsys, "compare", tmp_path / "corner", "--out", tmp_path / "out", "--quiet", *arguments)
        assert answer.code == 2 and words in answer.sentence()


def test_which_depth_is_used(tmp_path: Path) -> None:
    bare = Capture("transforms", tmp_path, (Frame("0", tmp_path / "0.png"),))
    sensed = Capture("transforms", tmp_path, (Frame("0", tmp_path / "0.png", depth=tmp_path / "0d.png"),))
    truth = GroundTruth(None, {tmp_path: tmp_path}, None)
    assert choose_surfaces("auto", bare, None) == ["matching"]
    assert choose_surfaces("auto", sensed, None) == ["sensor"]
    assert choose_surfaces("auto", bare, truth) == ["matching", "exact"]
    assert choose_surfaces("auto", sensed, truth) == ["sensor", "matching", "exact"]
    assert choose_surfaces("matching, sensor", sensed, None) == ["sensor", "matching"]
    with pytest.raises(InputError, match="no exact depth"):
        choose_surfaces("exact", sensed, None)
