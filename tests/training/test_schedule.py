"""When a fit goes to a finer lattice: by its share of the budget, on a plateau of the validation views, and never for too few rays."""

from __future__ import annotations

import math

import pytest

from toolkit.config import FitSettings
from toolkit.training.schedule import COARSE_GAIN, LEAST_RAYS, LEVEL_STEPS, RUNGS, WINDOW, Schedule, most_rays


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


def test_few_views_bound_the_rays_and_many_do_not() -> None:
    assert most_rays(400_000, False, 50) == 2e7 and most_rays(1000, False, 50) == LEAST_RAYS
    assert most_rays(400_000, True, 50) == math.inf and most_rays(400_000, False, None) == math.inf


def test_a_fit_ends_with_its_seconds_or_its_rays_whichever_are_spent_first() -> None:
    free, bound = plan(), plan()
    bound.most_rays = 1000
    assert free.position(4.0, 10**9) == bound.position(4.0, 100) == 0.4
    assert bound.position(4.0, 700) == 0.7 and bound.position(4.0, 1000) == 1
    assert free.rays_left(4.0, 800) == pytest.approx(1200) and bound.rays_left(4.0, 800) == 200


@pytest.mark.parametrize(("ladder", "rays"), [([32, 64], 256), ([64, 128], 512), ([480], 3840), ([1024], 4096), ([16], 256)])
def test_rays_of_a_step_follow_from_the_lattice_wherever_a_fit_begins(ladder: list[int], rays: int) -> None:
    assert Schedule(ladder, 10.0, FitSettings(), True).rays == rays
