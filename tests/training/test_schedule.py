"""When a fit goes to a finer lattice: by its share of the budget, on a plateau of the validation views, and never for too few rays."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.config import FitSettings, load_settings
from fieldfuse.training.schedule import (
    COARSE_GAIN,
    FINE_MOST,
    FINE_WORTH,
    GUESSED,
    LEAST_RAYS,
    LEVEL_STEPS,
    PARTLY,
    RUNGS,
    WINDOW,
    Schedule,
    most_rays,
)
from fieldfuse.training.start import FINER, FINEST, PIXELS, USUAL, finest_resolution, space_of, worth_a_level
from tests.training.test_fit import scene, sphere_views


def plan() -> Schedule:
    return Schedule([32, 64, 128], 10.0, FitSettings(), True)


def test_a_level_ends_at_its_share_and_not_before_it_had_time_to_grow() -> None:
    schedule = plan()
    for level in range(2):
        assert not schedule.wants_finer(RUNGS[level] + 0.01)
        schedule.steps_here = LEVEL_STEPS
        assert not schedule.wants_finer(RUNGS[level] - 0.01) and schedule.wants_finer(RUNGS[level] + 0.01)
        schedule.climb()
    schedule.steps_here = LEVEL_STEPS
    assert schedule.finest and not schedule.wants_finer(0.7)


@pytest.mark.parametrize(("gain", "climbs"), [(0.5 * COARSE_GAIN, True), (2 * COARSE_GAIN, False)])
def test_a_plateau_ends_a_level(gain: float, climbs: bool) -> None:
    schedule = plan()
    schedule.steps_here = LEVEL_STEPS
    for look in range(2 * WINDOW):
        assert not schedule.wants_finer(0.05)
        schedule.look(20.0 + gain * look / WINDOW, 0.05)
    assert schedule.wants_finer(0.05) == climbs


def test_a_level_that_would_see_too_few_rays_is_not_entered() -> None:
    schedule = plan()
    assert schedule.worth(1000, 1000) and schedule.ladder == [32, 64, 128]
    assert not schedule.worth(1000, 100) and schedule.ladder == [32] and schedule.finest


def test_the_last_level_waits_where_others_fit_it() -> None:
    schedule, usual = replace(plan(), hold=0.4, level=1, steps_here=200), replace(plan(), level=1, steps_here=200)
    assert usual.wants_finer(0.35) and not schedule.wants_finer(0.35) and schedule.wants_finer(0.41)
    assert replace(schedule, level=0).wants_finer(0.35)


def test_a_lattice_finer_than_usual_wants_more_rays_a_voxel_and_is_not_made_too_large() -> None:
    def asked(voxels: float, rays_left: float) -> tuple[bool, list[int]]:
        schedule = Schedule([512, 1024], 10.0, FitSettings(), True)
        return schedule.worth(voxels, rays_left), schedule.ladder

    for asked_for in (512, FINER - 32):  # what a user asks for is entered as ever
        assert Schedule([256, asked_for], 10.0, FitSettings(), True).worth(1e6, 0.5e6)
    surface = 0.5e6  # of a million voxels when it is twice as fine
    assert asked(1e6, FINE_WORTH * surface) == (True, [512, 1024])
    assert asked(1e6, 0.9 * FINE_WORTH * surface) == (False, [512])
    assert asked(2 * FINE_MOST, 1e9)[0] and not asked(2.1 * FINE_MOST, 1e9)[0]
    assert Schedule([512, 1024], 10.0, FitSettings(), True).worth(2.1 * FINE_MOST, 1e9, bounded=False)


@pytest.mark.parametrize("rungs", [RUNGS, PARTLY, GUESSED])
@pytest.mark.parametrize("ladder", [[32, 64, 128, 256, 512], [64, 128, 256, 512], [32, 64, 128, 256], [64, 512], [512]])
@pytest.mark.parametrize("more", [[1024], [768], [800, 1024]])
def test_a_finer_ladder_has_more_steps_in_the_same_share(rungs: tuple[float, ...], ladder: list[int], more: list[int]) -> None:
    def deadlines(resolutions: list[int]) -> list[float]:
        schedule = Schedule(resolutions, 10.0, FitSettings(), True, rungs=rungs)
        out = []
        for _ in resolutions[1:]:
            out.append(schedule.deadline())
            schedule.climb()
        return out

    usual, finer = deadlines(ladder), deadlines(ladder + more)
    assert deadlines([*ladder, FINER - 32]) == list(rungs[: len(ladder)])
    assert usual == list(rungs[: len(usual)])
    assert finer == sorted(finer) and finer[0] == rungs[0]
    assert finer[-1] == pytest.approx(usual[-1] if len(ladder) > 2 else finer[0])


def test_few_views_bound_the_rays_and_many_do_not() -> None:
    assert most_rays(400_000, False, 50) == 2e7 and most_rays(1000, False, 50) == LEAST_RAYS
    assert most_rays(400_000, True, 50) == math.inf and most_rays(400_000, False, None) == math.inf


@pytest.mark.parametrize(("ladder", "rays"), [([32, 64], 256), ([64, 128], 512), ([480], 3840), ([1024], 4096), ([16], 256)])
def test_rays_of_a_step_follow_from_the_lattice_wherever_a_fit_begins(ladder: list[int], rays: int) -> None:
    assert Schedule(ladder, 10.0, FitSettings(), True).rays == rays


def test_the_paper_prunes_and_splits_by_iterations() -> None:
    """`--preset paper`: at 10,000 and 20,000 of 25,000, whatever the seconds."""
    settings = load_settings("paper").fit
    schedule = Schedule([128, 256, 512, 1024], settings.budget or 0, settings, True)
    splits, prunings = [], []
    while (done := schedule.position(1.0)) < 1:
        if schedule.wants_finer(done):
            splits.append(schedule.steps)
            schedule.climb()
        elif schedule.wants_pruning(done):
            prunings.append(schedule.steps)
        schedule.steps += 1
        schedule.steps_here += 1
    assert splits == [10_000, 20_000] and not prunings and schedule.steps == 25_000 and schedule.resolution == 512


@pytest.mark.parametrize(
    ("asked", "given"), [(40, 64), (300, 288), (USUAL, USUAL), (1.3 * USUAL, USUAL), (1.6 * USUAL, 832), (FINEST, FINEST), (4000, FINEST)]
)
def test_a_lattice_is_as_fine_as_the_pictures_ask_for_within_bounds(asked: float, given: int) -> None:
    views, around = replace(sphere_views(4), background=None), scene()
    space = space_of(views, around)
    focal = asked * PIXELS * around.median_depth / (2 * space.extent * space.half)
    longer = replace(views, intrinsics=[replace(camera, fx=focal, fy=focal) for camera in views.intrinsics])
    assert finest_resolution(space, longer, around) == given


def test_what_is_little_finer_than_usual_is_no_level_of_its_own() -> None:
    assert worth_a_level(USUAL) == worth_a_level(USUAL + 32) == worth_a_level(FINER - 1) == USUAL
    assert worth_a_level(FINER) == FINER and worth_a_level(64) == 64
    assert np.all(np.diff([worth_a_level(resolution) for resolution in range(64, 2 * FINEST, 32)]) >= 0)


def test_a_fit_ends_with_its_seconds_or_its_rays_whichever_are_spent_first() -> None:
    free, bound = plan(), plan()
    bound.most_rays = 1000
    assert free.position(4.0, 10**9) == bound.position(4.0, 100) == 0.4
    assert bound.position(4.0, 700) == 0.7 and bound.position(4.0, 1000) == 1
    assert free.rays_left(4.0, 800) == pytest.approx(1200) and bound.rays_left(4.0, 800) == 200


def test_the_papers_preset_has_none_of_the_extras() -> None:
    settings = load_settings("paper")
    network, fit = settings.network, settings.fit
    assert (network.levels, network.gamma, network.agreement, network.recolour, network.depth_from) == (1, 0.6, False, False, "off")
    assert (settings.keyframes.method, settings.field.decoder, settings.field.init) == ("uniform", "per_sample", "network")
    assert not any((fit.distortion, fit.opacity, fit.slow_within, fit.depth, fit.soften)) and fit.depth_from == fit.moving == "off"
    assert settings.effects.mode == "off"
