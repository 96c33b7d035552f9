"""A guard on what work costs: operation counts and ratios within one run, never seconds."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fieldfuse.evaluation import speed, speed_cases, speed_growth
from fieldfuse.evaluation.speed import Case, Timed
from fieldfuse.evaluation.speed_state import CHANNELS, around, lens, sphere_field, sphere_pixels
from fieldfuse.pipelines import bench
from fieldfuse.render.bake import bake
from fieldfuse.render.bake_image import BakedRenderer
from fieldfuse.training.numba_engine import NumbaOptimiser


def test_the_compiled_step_is_at_least_twice_as_fast_as_torch() -> None:
    """By processor time, best of fifteen in turns: other work slows both, and a process's first steps find no memory yet."""
    (case,) = speed_cases.step_cases((128,), repetitions=15)
    assert case.ratio > 2, case.to_dict()


def test_a_ray_looks_up_and_touches_a_bounded_number_of_rows() -> None:
    """A wall of eight voxels with an optical thickness of about ½ each, crossed at most twice, is left after few samples."""
    counts = {}
    for size in (32, 64):
        engine = NumbaOptimiser(sphere_field(size), sphere_pixels(48), threads=1)
        counts[size] = speed_cases.step_counts(engine)
        assert 3 < counts[size]["looked_up_a_ray"] < 24
        # A first step touches the corners beside what it saw, each once: never more than eight a sample, and far fewer when rays meet.
        assert counts[size]["touched_corners"] < 4 * counts[size]["looked_up_a_ray"] * speed_cases.BATCH
        assert counts[size]["touched_corners"] <= len(engine.field.density_rows)
    assert counts[64]["looked_up_a_ray"] < 1.4 * counts[32]["looked_up_a_ray"]  # not with the lattice, but with the wall


def test_empty_space_is_skipped_and_light_that_is_spent_ends_a_ray() -> None:
    field = bake(sphere_field(128))
    work = BakedRenderer(field, 1).render_counted(lens(48, 48), around()[1])[1]
    assert work.walked / work.rays < 60  # of about 150 fine steps through the lattice
    assert 2 < work.coloured / work.rays <= work.looked_up / work.rays < 20
    everything = BakedRenderer(field, 1, stop=0.0, threshold=0.0).render_counted(lens(48, 48), around()[1])[1]
    assert everything.looked_up > 1.1 * work.looked_up and everything.coloured == everything.looked_up


def test_memory_a_voxel() -> None:
    field = sphere_field(64)
    baked = bake(field)
    assert field.bytes / field.voxels < 4 * (CHANNELS + 1) * 4
    assert baked.bytes / baked.voxels < 70
    engine = NumbaOptimiser(field, sphere_pixels(16), threads=1)
    rows = len(field.density_rows)
    assert engine.index.nbytes == rows * 8 and engine.marks.nbytes == len(field.occupied) * 2
    assert engine.records.shape == (rows, CHANNELS + 2) and engine.records.itemsize == 2


def test_ratios_are_of_the_clock_that_is_asked_for() -> None:
    case = Case("a", "1", "ray", 10, Timed(2.0, 1.0), Timed(3.0, 4.0), "b")
    assert case.ratio == 4 and Case("a", "1", "ray", 10, Timed(2.0, 1.0), Timed(3.0, 4.0), "b", clock="wall").ratio == 1.5
    assert json.loads(json.dumps(case.to_dict()))["wall_microseconds_a_ray"] == pytest.approx(2e5)


def test_growth_is_fitted() -> None:
    sizes = np.array([10.0, 20.0, 40.0])
    assert speed.exponent(list(sizes), list(3 * sizes**1.7)) == pytest.approx(1.7)


def test_growth_is_measured_over_rays_and_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, sizes in (("RAYS", (64, 256)), ("SIDES", (16, 32)), ("VIEWS", (4, 8)), ("LATTICE", 32)):
        monkeypatch.setattr(speed_growth, name, sizes)
    cases = list(speed_growth.growth_cases(1))
    assert [case.size for case in cases] == ["64 rays", "256 rays", "16 pixels", "32 pixels", "4 pictures", "8 pictures"]
    assert set(bench.growth(cases)) == {case.name for case in cases}
    assert [case.units for case in cases[:2]] == [256, 1024]


def test_pieces_of_work_are_timed_in_turns() -> None:
    order: list[str] = []
    ours, reference = speed.compare(lambda: order.append("a"), lambda: order.append("b"), 2)
    assert order == ["a", "b", "a", "b", "b", "a"]
    assert 0 <= ours.wall < 1 and 0 <= reference.processor < 1
