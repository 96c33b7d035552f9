"""A guard on what work costs: operation counts and ratios within one run, never seconds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import speed_cases
from benchmarks.speed import fit_curves, table, tsdf_frames
from benchmarks.timing import Case, Timed, exponent
from fieldfuse.camera import pixel_grid, rays
from fieldfuse.evaluation.sphere import CHANNELS, around, lens, sphere_field, sphere_pixels
from fieldfuse.render.bake import bake
from fieldfuse.render.march import march
from fieldfuse.training.numba_engine import NumbaEngine
from tests.pipelines.made import bench


def test_the_compiled_step_is_at_least_twice_as_fast_as_torch() -> None:
    """By processor time, best of fifteen in turns: other work slows both, and a process's first steps find no memory yet."""
    (case,) = speed_cases.step_cases((128,), repetitions=15)
    assert case.ratio > 2, case.to_dict()


def test_a_ray_looks_up_and_touches_a_bounded_number_of_rows() -> None:
    """A wall of eight voxels with an optical thickness of about ½ each, crossed at most twice, is left after few samples."""
    counts = {}
    for size in (32, 64):
        engine = NumbaEngine(sphere_field(size), sphere_pixels(48), threads=1)
        counts[size] = speed_cases.step_counts(engine)
        assert 3 < counts[size]["looked_up_a_ray"] < 24
        # A first step touches the corners beside what it saw, each once: never more than eight a sample, and far fewer when rays meet.
        assert counts[size]["touched_corners"] < 4 * counts[size]["looked_up_a_ray"] * speed_cases.BATCH
        assert counts[size]["touched_corners"] <= len(engine.field.density_rows)
    assert counts[64]["looked_up_a_ray"] < 1.4 * counts[32]["looked_up_a_ray"]  # not with the lattice, but with the wall


def test_empty_space_is_skipped_and_light_that_is_spent_ends_a_ray() -> None:
    field = sphere_field(64)
    origins, directions, _ = rays(lens(32, 32), around()[1], pixel_grid(32, 32))
    samples = march(field.grid, origins, directions, field.near, field.fine)
    assert len(samples) / len(origins) < 30  # of about 150 fine steps through the lattice: the rest is empty
    engine = NumbaEngine(field, sphere_pixels(48), threads=1)
    assert speed_cases.step_counts(engine)["looked_up_a_ray"] < 0.8 * len(samples) / len(origins)


def test_memory_a_voxel() -> None:
    field = sphere_field(64)
    baked = bake(field)
    assert field.bytes / field.voxels < 4 * (CHANNELS + 1) * 4
    assert baked.bytes / baked.voxels < 70
    engine = NumbaEngine(field, sphere_pixels(16), threads=1)
    rows = len(field.density_rows)
    assert engine.rows.index.nbytes == rows * 8 and engine.marks.nbytes == len(field.occupied) * 2
    assert engine.rows.records.shape == (rows, CHANNELS + 2) and engine.rows.records.itemsize == 2


def test_ratios_are_of_the_clock_that_is_asked_for() -> None:
    case = Case("a", "1", "ray", 10, Timed(2.0, 1.0), Timed(3.0, 4.0), "b")
    assert case.ratio == 4 and Case("a", "1", "ray", 10, Timed(2.0, 1.0), Timed(3.0, 4.0), "b", clock="wall").ratio == 1.5
    assert json.loads(json.dumps(case.to_dict()))["wall_microseconds_a_ray"] == pytest.approx(2e5)


def test_growth_is_fitted() -> None:
    sizes = np.array([10.0, 20.0, 40.0])
    assert exponent(list(sizes), list(3 * sizes**1.7)) == pytest.approx(1.7)


def test_some_parts_are_measured_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["speed", "--out", tmp_path, "--parts", "lookup,convolution", "--repetitions", "1", "--threads", "1"]
    done = bench(capsys, *command)
    assert done.code == 0, done.err
    data = json.loads((tmp_path / "speed.json").read_text())
    cases = [case for row in data["rows"] for case in row["cases"]]
    assert [case["unit"] for case in cases] == ["point", "voxel"]
    assert all(case["ratio"] > 0 and case["ours"]["processor"] > 0 for case in cases)
    assert data["machine"]["threads"] == 1 and data["machine"]["versions"]["torch"]
    assert "times faster" in done.out and "block convolution" in done.out
    answer = bench(capsys, "speed", "--parts", "step,lunch")
    assert answer.code == 2 and "there is no 'lunch'" in answer.sentence()


def test_whole_jobs_and_tsdf_frames_are_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.speed.WIDTHS", (24,))
    jobs = fit_curves(0.5, 1)
    assert [(job["engine"], job["width"]) for job in jobs] == [("numba", 24), ("torch", 24)]
    assert all(job["steps"] > 0 and job["timeline"] for job in jobs)
    text = table({"rows": [{"part": "tsdf", "tsdf": tsdf_frames(frames=2, rounds=1)}, {"part": "jobs", "jobs": jobs}]})
    assert "| TSDF frame | 0.02 |" in text and "- fit of 14 views 24 wide, numba, 0.5 s: " in text
