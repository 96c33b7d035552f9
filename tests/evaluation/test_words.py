"""Numbers as people read them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.evaluation import words

SHOWN: dict[Callable[..., str], dict[Any, str]] = {
    words.duration: {0: "0 ms", 0.012: "12 ms", 0.0996: "0.1 s", 4.24: "4.2 s", 9.96: "10 s", 59.7: "1 min", 372: "6 min 12 s"}
    | {3599.8: "1 h", 7322: "2 h 2 min"},
    words.size: {0: "0 bytes", 999: "999 bytes", 999.6: "1.0 kB", 3456789: "3.5 MB", 99.7e6: "100 MB", 999.7e6: "1.0 GB", 5e12: "5000 GB"},
    lambda count: words.counted(count, "key frame"): {0: "0 key frames", 1: "1 key frame", 1234: "1,234 key frames"},
    words.memory: {1840.5: "1.8 GB", 210: "210 MB"},
    words.share: {0.8512: "85.1%"},
    words.significant: {0.0: "0", 0.00781: "0.00781", 0.0000123: "1.23e-05", 12.345: "12.3", 1234.5: "1,234", -0.5: "-0.5"},
}


@pytest.mark.parametrize(("show", "values"), SHOWN.items())
def test_numbers(show: Callable[..., str], values: dict[Any, str]) -> None:
    assert {value: show(value) for value in values} == values


def test_none_is_a_dash() -> None:
    for function in (words.decimal, words.significant, words.whole, words.size, words.memory, words.duration, words.share):
        assert function(None) == words.NONE


@given(st.floats(0, 1e7))
def test_durations_never_say_sixty(seconds: float) -> None:
    shown = words.duration(seconds)
    assert "60 s" not in shown and "60 min" not in shown


def test_unit() -> None:
    assert words.unit_of({"scene": {"metric": True}}) == "m"
    assert words.unit_of({"scene": {"metric": False}}) == words.unit_of({"scene": None}) == words.unit_of({}) == "units"
