"""`fieldfuse tradeoff` from end to end: made, interrupted, gone on with, and refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.evaluation.tradeoff import MEASURES, checked_row, points_of, series
from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines import tradeoff_point
from fieldfuse.pipelines.direct_field import direct_field
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.tradeoff_sweep import chosen_axes, chosen_times, plan, run_child, unbounded
from fieldfuse.progress import SILENT
from tests.pipelines.made import call
from tests.pipelines.test_matched import make_corner
from tests.training.test_network_start import scene, wall_views

Capsys = pytest.CaptureFixture[str]
SMALL = ["--holdout", "4", "--threads", "1", "--quiet", "--json", "--set", "field.resolution=32"]


def test_one_step_at_a_time_around_the_default() -> None:
    found = plan(["iterations", "voxel_size", "views", "samples", "decoder", "precision"], [3, 10, 30, 60, 120], 2, "tsdf")
    assert found[0].id == "field-30s" and len(found[0].variants) == 4 and found[1].id == "tsdf"
    assert len({one.name for one in found}) == len(found)
    first = [one for one in found if one.seed == 0]
    assert sum(one.is_surface for one in first) == 6 and not any(one.is_surface for one in found if one.seed)
    for one in first:
        default = {"iterations": 30, "voxel_size": 1.0, "views": 1.0, "decoder": "deferred"}
        differs = [axis for axis, value in default.items() if one.wanted.get(axis, value) != value]
        assert len(differs) <= 1 or (one.method == "field_per_sample" and set(differs) <= {"iterations", "decoder"})
    assert {one.wanted["iterations"] for one in first if one.method == "field_per_sample"} == {10, 30, 60}


def test_only_what_is_asked_for() -> None:
    assert [one.id for one in plan(["views"], [5.0, 900.0], 1, "tsdf_stereo")] == [
        "field-5s",
        "tsdf_stereo",
        "field-5s-views0.25",
        "field-5s-views0.5",
    ]
    assert [one.id for one in plan(["iterations"], [3.0, 10.0], 1, None)] == ["field-10s", "field-3s"]
    assert plan(["views"], [60.0, 120.0], 1, None)[0].id == "field-60s" and plan(["views"], [10.0, 29.0], 1, None)[0].id == "field-29s"


def test_direct_inference_is_a_curve_over_key_frames_and_one_over_voxels() -> None:
    direct = [one for one in plan(["voxel_size", "keyframes"], [30.0], 3, "tsdf") if one.method == "direct"]
    assert [one.id for one in direct[:4]] == ["direct", "direct-keyframes0.1", "direct-keyframes0.25", "direct-keyframes0.5"]
    assert direct[0].axes == ("voxel_size", "keyframes") and len(direct) == 6  # once for all seeds: it draws no random numbers
    rows = [
        checked_row(
            {"id": one.id, "method": "direct", "axes": list(one.axes), "error": None, "psnr": 15.0, "seconds": 1.0}
            | {"setting": {"keyframes": round(12 * one.wanted["keyframes"]), "voxel_size": one.wanted["voxel_size"], "wanted": one.wanted}}
        )
        for one in direct
    ]
    lines = {axis: [point.id for point in line] for axis, line in series(points_of(rows))}
    assert lines["keyframes"] == ["direct-keyframes0.1", "direct-keyframes0.25", "direct-keyframes0.5", "direct"]
    assert lines["voxel_size"] == ["direct-voxel2.0", "direct-voxel1.4", "direct"]
    only = [one.id for one in plan(["keyframes"], [30.0], 1, None) if one.method == "direct"]
    assert only == ["direct", "direct-keyframes0.1", "direct-keyframes0.25", "direct-keyframes0.5"]


def test_axes_and_times_are_checked() -> None:
    assert chosen_axes("voxel-size, views,views", ["views", "voxel_size"], {}) == ["voxel_size", "views"]
    assert chosen_times("10,3, 3") == [3, 10]
    for text in ("", "3,ten", "-1", "nan", "1e9"):
        with pytest.raises(InputError, match="--times is"):
            chosen_times(text)
    with pytest.raises(InputError, match="there is no axis 'colour'; here views can be varied"):
        chosen_axes("colour", ["views"], {})
    with pytest.raises(InputError, match="the axis keyframes cannot be varied, because there are none; here views can be varied"):
        chosen_axes("keyframes", ["views"], {"keyframes": "there are none"})


@pytest.mark.parametrize(
    ("typed", "whole"),
    [
        ("fieldfuse tradeoff 'my fox' --budget 60 --threads 1", "fieldfuse tradeoff 'my fox' --threads 1"),
        ("fieldfuse tradeoff fox --out runs/fox --budget=60", "fieldfuse tradeoff fox --out runs/fox"),
        ("fieldfuse tradeoff fox --set fit.budget=3", "fieldfuse tradeoff fox --set fit.budget=3"),
    ],
)
def test_the_command_of_a_whole_sweep_makes_it_in_one_call(typed: str, whole: str) -> None:
    assert unbounded(typed) == whole


def here(_: object, ask: Path, *__: object) -> int:
    """What a point's process does, in this one."""
    return tradeoff_point.main(str(ask))


def surfaces_here(job: Job, ask: Path, log: Path, expected: float) -> int:
    """A field is made by a process of its own, a surface by this one."""
    return here(job, ask) if "tsdf" in ask.name else run_child(job, ask, log, expected)


def test_a_sweep_goes_on_where_it_stopped(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    make_corner(tmp_path / "corner", depth=True)
    out = tmp_path / "out"
    command = ["tradeoff", tmp_path / "corner", "--out", out, *SMALL, "--times", "1", "--axes", "iterations,precision"]
    short = json.loads(call(capsys, *command, "--budget", "1").out)
    assert short["rows"] == [] and short["left_out"] == ["field-1s-seed0", "tsdf-seed0"]  # nothing fits into a second
    monkeypatch.setattr("fieldfuse.pipelines.tradeoff_sweep.run_child", surfaces_here)
    monkeypatch.setattr("fieldfuse.poses.child.die_with_parent", lambda: None)
    monkeypatch.setattr("fieldfuse.evaluation.tradeoff_page.MEASURES", {"psnr": MEASURES["psnr"]})  # all plots: tests/evaluation
    answer = call(capsys, *command)
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    found = {row["id"]: row for row in data["rows"]}
    assert list(found) == ["field-1s", "field-1s-precisionuint8", "field-1s-precisionfloat32", "tsdf"]
    for row in found.values():
        assert row["error"] is None and row["psnr"] > 8 and row["seconds"] > 0 and row["disk_bytes"] > 1000 and row["memory_mb"] > 1
        assert row["depth_error"] is not None and len(row["load"]) == 2
    assert found["field-1s"]["seconds"] > 1 and set(found["tsdf"]["stages"]) == {"fuse", "mesh"}
    assert found["field-1s"]["disk_bytes"] < found["field-1s-precisionfloat32"]["disk_bytes"]
    assert abs(found["field-1s"]["psnr"] - found["field-1s-precisionuint8"]["psnr"]) < 1
    assert data["unit"] == "units" and (out / "tradeoff.csv").read_text().count("\n") == 5

    # The rest of a crash is made again, what is finished is reused.
    path = out / "tradeoff" / "points" / "tsdf-seed0.json"
    write_json(path, {**read_json(path), "crashed": True, "rows": []})
    kept = {row["id"]: row for row in json.loads(call(capsys, *command).out)["rows"]}
    assert kept["field-1s"] == found["field-1s"] and kept["tsdf"]["psnr"] == pytest.approx(found["tsdf"]["psnr"], abs=0.01)
    # A point that cannot be made is told, and the others stay.
    again = call(capsys, *command, "--set", "tsdf.voxel_size=0.000001")
    kept = {row["id"]: row for row in json.loads(again.out)["rows"]}
    assert kept["field-1s"] == found["field-1s"]
    assert "finer than the pixels" in kept["tsdf"]["error"] and kept["tsdf"]["psnr"] is None
    assert "finer than the pixels" in (out / "tradeoff.html").read_text()


def test_what_cannot_be_measured_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    make_corner(tmp_path / "corner", 5)
    for arguments, words in (
        (
            ["--axes", "colour"],
            "no axis 'colour'; here iterations, voxel_size, keyframes, views, samples, decoder, precision can be varied",
        ),
        (["--decoder", "per_sample", "--axes", "precision"], "one precision only"),
        (["--holdout", "0", "--times", "1"], "--holdout 8"),
        (["--times", "soon"], "--times is 'soon'"),
    ):
        answer = call(capsys, "tradeoff", tmp_path / "corner", "--out", tmp_path / "out", "--quiet", *arguments)
        assert answer.code == 2 and words in answer.sentence(), answer.err


def test_the_voxels_of_direct_inference_are_those_of_the_networks() -> None:
    """Its field's are finer, and the same whatever the networks' are."""
    settings = Settings()
    settings.device, settings.network.voxels = "cpu", 48.0
    made = [direct_field(settings, wall_views(), scene(), SILENT, voxel_factor=factor) for factor in (1.0, 2.0)]
    assert made[1].voxel_size > 1.4 * made[0].voxel_size  # a lattice is so many whole blocks
    assert all(one.field.voxel_size <= one.voxel_size for one in made) and made[0].key_frames >= 1
