"""The hard cases' own measures: what is never within a bound, and that a missed one fails."""

from __future__ import annotations

import math

import pytest

from tests.stability.hard.errors import absolute, by_size, not_finite, refused, relative
from tests.stability.hard.within import Measure, Within
from tests.stability.page import case_lines


def test_nan_is_never_within_a_bound() -> None:
    assert not Measure("x", math.nan, math.inf).good
    assert absolute([math.nan], [1.0]) == math.inf == absolute([1.0], [math.nan]) == absolute([math.inf], [-math.inf])
    assert relative([math.nan], [1.0]) == math.inf and by_size([1.0, 2.0], [1.0]) == math.inf
    assert absolute([math.inf], [math.inf]) == 0 and not_finite([1.0, math.nan], [math.inf]) == 2
    assert relative([1.0], [0.0]) == math.inf and relative([0.0], [0.0]) == 0


def test_a_refusal_has_one_line_of_the_right_kind() -> None:
    def fail(error: Exception) -> None:
        raise error

    assert refused(lambda: fail(ValueError("a sentence that tells")), ValueError, "tells") == 0
    assert refused(lambda: fail(ValueError("two\nlines of text")), ValueError) == 1
    assert refused(lambda: fail(ValueError("a sentence")), ValueError, "other words") == 1
    assert refused(lambda: None, ValueError) == 1


def test_one_missed_bound_fails_and_is_named_with_its_numbers() -> None:
    within = Within("group: case")
    within.each({"one": 0.5, "two": 3.0}, 1.0, {"two": 2.0}, "of {}")
    assert within.missed == ["of two"] and not within.good
    with pytest.raises(AssertionError, match="of two: 3 > 2"):
        within.check()
    assert case_lines([within])[-1] == "| group: case | 2 | of two | 3 | 2 |"
    with pytest.raises(AssertionError, match="nothing was measured"):
        Within().check()
