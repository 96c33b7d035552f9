"""A distant background told by patches: what stands still where infinity would be, and nothing that only stands behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.effects.far_background import THRESHOLD, find_far_background
from tests.effects.walls import AWAY, FRAMES, problem_of, wall


@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_endlessly_far_is_found_and_held_out_pictures_agree(seed: int) -> None:
    seen = wall(top=-0.1, away=1e6, seed=seed)
    found = find_far_background(seen, problem_of(seen), AWAY)
    assert found.there and found.number > 20 * THRESHOLD, found.reason
    assert found.before is not None and found.after is not None and found.after < 0.5 * found.before


@pytest.mark.parametrize("away", [AWAY, 2 * AWAY, 5 * AWAY])
def test_what_is_near_or_only_behind_is_not(away: float) -> None:
    seen = wall(top=-0.1, away=away)
    assert not find_far_background(seen, problem_of(seen), AWAY).there


def test_exposure_does_not_matter() -> None:
    seen = wall(top=-0.1, away=1e6, gain=np.exp2(0.4 * np.sin(np.arange(FRAMES))))
    assert find_far_background(seen, problem_of(seen), AWAY).there


def test_from_one_place_nothing_is_told() -> None:
    seen = replace(wall(top=-0.1, away=1e6), poses=np.tile(np.eye(4), (FRAMES, 1, 1)))
    found = find_far_background(seen, problem_of(seen), AWAY)
    assert not found.there and found.number == 0 and found.before is None
