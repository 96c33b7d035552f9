"""When a fit goes to a finer lattice: by its share of the budget, on a plateau of the validation views, and never for too few rays."""

from __future__ import annotations

import pytest

from toolkit.config import FitSettings
from toolkit.training.schedule import COARSE_GAIN, LEVEL_STEPS, RUNGS, WINDOW, Schedule


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
