"""Parts of the main job alone, and what another run in the same folder does again."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from fieldfuse.errors import InputError
from fieldfuse.files import read_json
from fieldfuse.pipelines.folder import FILES, SUBFOLDERS
from fieldfuse.pipelines.options import THREAD_VARIABLES, bound_threads
from tests.pipelines.made import bench, call, make_room
from tests.pipelines.short import FAST, finished, report, stages

Capsys = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run beside its capture, made once."""
    folder = tmp_path_factory.mktemp("parts")
    finished(folder / "made", 10, *FAST, "--quiet")
    return folder


@pytest.fixture
def out(made: Path) -> Path:
    """The finished run as it was, for a test to change; its capture is `room` beside it."""
    shutil.rmtree(made / "out", ignore_errors=True)
    return Path(shutil.copytree(made / "made", made / "out"))


def test_a_changed_picture_is_noticed(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 6)
    arguments = ["poses", tmp_path / "room", "--out", tmp_path / "room" / "out", "--quiet", "--json"]
    assert call(capsys, *arguments).code == 0
    assert all(stages(json.loads(call(capsys, *arguments).out)).values())  # its own folder inside the source changes nothing
    picture = tmp_path / "room" / "images" / "002.png"
    cv2.imwrite(str(picture), cv2.imread(str(picture))[::-1])
    assert not any(stages(json.loads(call(capsys, *arguments).out)).values())


def test_poses_alone(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 6)
    answer = call(capsys, "poses", tmp_path / "room", "--out", tmp_path / "out", "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["poses"]["registered"] == 6
    assert len(read_json(tmp_path / "out" / "exports" / "cameras" / "transforms.json")["frames"]) == 6
    assert not (tmp_path / "out" / "views.safetensors").exists()


def test_tsdf_alone_then_the_rest_in_the_same_folder(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10, depth=True)
    out = tmp_path / "out"
    answer = call(capsys, "tsdf", tmp_path / "room", "--out", out, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert data["evaluation"]["tsdf"]["psnr"] > 10 and data["evaluation"]["field"] is None
    options = ["--budget", 1, "--threads", 1, "--set", "init=classical", "--set", "field.resolution=32", "--set", "export.formats=[points]"]
    answer = call(capsys, "finetune", out, *options, "--quiet", "--json")
    assert answer.code == 0, answer.err
    both = json.loads(answer.out)
    assert both["evaluation"]["tsdf"] == data["evaluation"]["tsdf"] and both["evaluation"]["field"]["psnr"] > 10
    assert stages(both)["tsdf"] and not stages(both)["field"]
    answer = call(capsys, "export", out, "--formats", "ply", "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert stages(json.loads(answer.out))["field"]
    answer = call(capsys, "export", out, "--formats", "cameras", "--quiet", "--json")
    assert answer.code == 0, answer.err
    # One format after the other: what was there of this field stays, in the report, too.
    told = json.loads(answer.out)
    for name in ("points.ply", "mesh.ply", "cameras/transforms.json"):
        assert (out / "exports" / name).is_file() and f"exports/{name}" in [entry["path"] for entry in told["exports"]]
    assert told["export_facts"]["mesh"]["triangles"] > 0
    page = tmp_path / "page.md"
    page.write_text("# Results\n")
    answer = bench(capsys, "table", out / "report.json", "--into", page, "--data", tmp_path)
    assert answer.code == 0, answer.err
    assert "| room | 8 / 2 |" in page.read_text() and "its TSDF" in page.read_text()


def test_a_changed_budget_redoes_the_field_and_what_follows(out: Path, capsys: Capsys) -> None:
    again = ["run", out.parent / "room", "--out", out, *FAST, "--quiet"]
    answer = call(capsys, *again, "--budget", 0.1, "--json")
    assert answer.code == 0, answer.err
    cached = stages(json.loads(answer.out))
    assert {name for name, reused in cached.items() if not reused} == {"field", "render", "export", "evaluate"}
    answer = call(capsys, *again, "--budget", 0.2, "--set", "export.formats=[cameras]")
    assert answer.code == 0, answer.err
    assert not (out / "exports" / "points.ply").exists()  # of another field


def test_a_surface_made_later_leaves_the_field_as_it_is(out: Path, capsys: Capsys) -> None:
    """`tsdf` matches pictures, which a fit would have used had they been matched before; no other fit is made."""
    first = report(out)
    field = (out / "field.safetensors").read_bytes()
    answer = call(capsys, "tsdf", out, "--threads", 1, "--quiet", "--json")
    assert answer.code == 0, answer.err
    both = json.loads(answer.out)
    assert (out / "field.safetensors").read_bytes() == field and stages(both)["field"] and stages(both)["export"]
    assert both["evaluation"]["field"]["psnr"] == first["evaluation"]["field"]["psnr"] and both["evaluation"]["tsdf"]["psnr"] > 5
    assert {"exports/points.ply", "tsdf/mesh.ply"} <= {entry["path"] for entry in both["exports"]}
    # Whatever a run writes is known to belong to one, so that a folder with such files and no run is left alone.
    assert {path.name for path in out.iterdir()} <= {*SUBFOLDERS, *FILES, "run.json", ".lock"}


def test_a_folder_keeps_its_capture(tmp_path: Path, capsys: Capsys) -> None:
    for name in ("room", "other"):
        make_room(tmp_path / name, 6)
    assert call(capsys, "poses", tmp_path / "room", "--out", tmp_path / "out", "--quiet").code == 0
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    answer = call(capsys, "run", tmp_path / "other", "--out", tmp_path / "out", *FAST, "--quiet")
    assert answer.code == 2 and "holds the run of" in answer.err and answer.err.count("\n") == 1
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == before
    (tmp_path / "link").symlink_to(tmp_path / "room")  # the same capture by another name
    assert call(capsys, "poses", tmp_path / "link", "--out", tmp_path / "out", "--quiet").code == 0


def test_a_field_without_surface_is_exported_as_far_as_it_goes(out: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing_opaque(*_: object, **__: object) -> None:
        raise InputError("no rendered view shows a surface")

    monkeypatch.setattr("fieldfuse.export.surface.field_volume", nothing_opaque)
    wish = ["--set", "export.formats=[ply,cameras]"]
    answer = call(capsys, "run", out.parent / "room", "--out", out, *FAST, *wish, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert stages(data)["field"] and any("meshes were left out" in warning for warning in data["warnings"])
    assert (out / "exports" / "cameras" / "transforms.json").is_file() and not (out / "exports" / "mesh.ply").exists()


def test_without_held_out_pictures_there_are_no_scores(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    options = [*FAST, "--budget", 0.3, "--holdout", 0, "--set", "export.formats=[cameras]"]
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", *options, "--quiet", "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert data["evaluation"]["field"]["psnr"] is None and data["timeline"] == []
    assert any("no image was held out" in warning for warning in data["warnings"])
    assert "no held-out views" in call(capsys, "render", tmp_path / "out", "--views", "test", "--quiet").sentence()


def test_a_tampered_field_is_refused(out: Path, capsys: Capsys) -> None:
    path = out / "field.safetensors"
    whole = path.read_bytes()
    damages = whole[:8] + b"{" * 40 + whole[48:], (2**62).to_bytes(8, "little") + whole[8:], bytes(len(whole))
    for spoilt, commands in zip(damages, (("render", "evaluate", "export"), ("export",), ("render",)), strict=True):
        path.write_bytes(spoilt)
        for command in commands:
            answer = call(capsys, command, out, "--quiet")
            assert answer.code == 2, answer
            assert "field.safetensors" in answer.sentence()


@pytest.mark.parametrize(
    ("given", "policy", "spins"),
    [({}, "PASSIVE", "1000"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE", None), ({"GOMP_SPINCOUNT": "7"}, "PASSIVE", "7")],
)
def test_waiting_threads_sleep_soon_unless_told_otherwise(
    given: dict[str, str], policy: str, spins: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (*THREAD_VARIABLES, "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.setenv(name, "")  # put back as it was when the test ends
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    bound_threads({"flags": {"threads": 3}})
    assert os.environ["OMP_WAIT_POLICY"] == policy and os.environ.get("GOMP_SPINCOUNT") == spins
    assert {os.environ[name] for name in THREAD_VARIABLES} == {"3"}


def test_threads_are_bounded_before_numpy_is_loaded() -> None:
    """NumPy's BLAS reads the count when it is loaded; later it is too late."""
    code = "import sys; from fieldfuse.pipelines import cli, options, run; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
