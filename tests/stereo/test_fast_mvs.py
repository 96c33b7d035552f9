"""Quick matching for a fit: what is chosen, that it finds depth, and that it looks at nothing that it must not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.capture.types import Views
from fieldfuse.stereo import fast_mvs
from fieldfuse.stereo.match import LONG_SIDE
from tests.stereo.made import FAR, MEDIAN, NEAR, corner


@given(st.integers(2, 2000), st.floats(1, 2000), st.floats(0.3, 1))
def test_size_and_number_follow_from_counts(views: int, budget: float, aspect: float) -> None:
    chosen, least = fast_mvs.plan(views, budget, aspect), fast_mvs.view_seconds(fast_mvs.LEAST_SIDE, aspect)
    if chosen is None:
        assert views * least > fast_mvs.MOST_SHARE * budget
        return
    side, every = chosen
    matched = -(-views // every)
    assert fast_mvs.LEAST_SIDE <= side <= LONG_SIDE and every >= 1
    assert every == 1 or (side == fast_mvs.LEAST_SIDE and views // every >= fast_mvs.FEWEST and every <= fast_mvs.SPARSEST)
    assert matched * fast_mvs.view_seconds(side, aspect) <= fast_mvs.MOST_SHARE * budget + least
    longer = fast_mvs.plan(views, 2 * budget, aspect)
    assert longer is not None and longer[0] >= side and longer[1] <= every


def test_what_is_chosen_for_usual_captures() -> None:
    assert fast_mvs.plan(1, 60) is None
    assert fast_mvs.plan(8, 60) == (LONG_SIDE, 1)
    assert fast_mvs.plan(50, 30) == (184, 1) and fast_mvs.plan(50, 30, 9 / 16) == (208, 1)
    assert fast_mvs.plan(300, 20) == (fast_mvs.LEAST_SIDE, 3)
    assert fast_mvs.plan(300, 10) is None


def with_held_out() -> Views:
    views, _ = corner()
    return replace(views, test=np.arange(len(views)) == 3)


def test_depth_is_found_and_held_out_pictures_are_not_looked_at() -> None:
    views, truth = with_held_out(), corner()[1]
    known, matched = fast_mvs.guided(views, NEAR, FAR, MEDIAN, 2.0)
    assert matched is not None and matched.views == 6 and fast_mvs.LEAST_SIDE <= matched.pixels < 160
    assert known.rough and not views.rough and known.subset([0, 1]).rough
    assert known.depths[3] is None and 0.3 < matched.share < 1
    errors = [
        np.abs(depth - truth[i])[depth > 0] / truth[i][depth > 0]
        for i, depth in enumerate(known.depths)
        if depth is not None and depth.shape == (120, 160)
    ]
    assert len(errors) == 6 and np.median(np.concatenate(errors)) < 0.01
    other = replace(views, images=[np.zeros_like(image) if i == 3 else image for i, image in enumerate(views.images)])
    again, _ = fast_mvs.guided(other, NEAR, FAR, MEDIAN, 2.0)
    for one, two in zip(known.depths, again.depths, strict=True):
        assert (one is None and two is None) or np.array_equal(one, two)  # type: ignore[arg-type]


def test_some_pictures_are_left_out_of_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fast_mvs, "FEWEST", 3)
    known, matched = fast_mvs.guided(with_held_out(), NEAR, FAR, MEDIAN, 0.5)
    assert matched is not None and matched.views == 3
    assert [depth is not None for depth in known.depths] == [True, False, True, False, False, True, False]
    views, matched = fast_mvs.guided(with_held_out(), NEAR, FAR, MEDIAN, 0.2)
    assert matched is None and not any(depth is not None for depth in views.depths)
