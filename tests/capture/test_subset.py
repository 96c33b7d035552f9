"""Fewer training images: evenly spread, and the held-out ones stay the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.capture.prepare import evenly, held_out, limited
from fieldfuse.capture.select import sharpness
from fieldfuse.capture.types import Capture, Frame


def capture(count: int, split: bool = False) -> Capture:
    frames = [Frame(f"{i}.png", Path(f"/{i}.png"), split=("test" if i % 5 == 1 else "train") if split else None) for i in range(count)]
    return Capture("photos", Path("/"), tuple(frames))


def names(of: Capture, holdout: int, test: bool) -> list[str]:
    mask = held_out(of, holdout)
    return [frame.name for frame, held in zip(of.frames, mask, strict=True) if held == test]


@given(st.integers(1, 60), st.sampled_from([0, 2, 8]), st.integers(1, 70), st.booleans())
def test_held_out_pictures_stay_and_training_ones_are_at_most_so_many(count: int, holdout: int, limit: int, split: bool) -> None:
    whole = capture(count, split)
    some = limited(whole, holdout, limit)
    assert names(some, holdout, True) == names(whole, holdout, True)
    train = names(whole, holdout, False)
    assert len(names(some, holdout, False)) == min(limit, len(train))
    assert set(names(some, holdout, False)) <= set(train)
    assert limited(whole, holdout, None) is whole


@given(st.integers(1, 200), st.integers(1, 200))
def test_places_are_spread_evenly(count: int, some: int) -> None:
    places = evenly(count, some)
    assert len(places) == min(some, count) and places == sorted(set(places)) and 0 <= places[0] <= places[-1] < count
    if len(places) > 1:
        assert (places[0], places[-1]) == (0, count - 1)
        assert np.ptp(np.diff(places)) <= 1


def test_a_blurred_picture_is_less_sharp() -> None:
    import cv2

    picture = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    assert sharpness(cv2.GaussianBlur(picture, (0, 0), 2)) < 0.2 * sharpness(picture)
