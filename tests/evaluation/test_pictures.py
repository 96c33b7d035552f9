"""Pictures: fixed scales, one depth range, grey where something is missing, files that other readers open."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.evaluation.pictures import (
    DEPTH_COLOURS,
    ERROR_TOP,
    MISSING,
    TINT,
    coloured,
    depth_picture,
    depth_range,
    error_picture,
    method_pictures,
    moving_pictures,
)
from fieldfuse.export.surface import spread
from fieldfuse.stereo.transients import LeftOut
from tests.evaluation.samples import draw, make_views


def test_error_scale_is_fixed() -> None:
    truth = np.full((4, 4, 3), 0.5)
    none, top, beyond = (error_picture(truth + difference, truth) for difference in (0.0, ERROR_TOP, 2 * ERROR_TOP))
    assert none.max() < 8  # the dark end
    assert (top == beyond).all() and top.min() > 100
    half = error_picture(truth + ERROR_TOP / 2, truth)
    assert none.mean() < half.mean() < top.mean()
    valid = np.ones((4, 4), dtype=bool)
    valid[0] = False
    masked = error_picture(truth, truth, valid)
    assert (masked[0] == MISSING).all() and (masked[1:] != MISSING).any(axis=-1).all()


def test_depth_range_is_shared_and_robust() -> None:
    near, far = np.full((10, 10), 1.0), np.full((10, 10), 3.0)
    far[0, 0] = 1e6  # one stray pixel
    far[0, 1] = np.nan
    assert depth_range([near, far]) == (1.0, 3.0)
    assert depth_range([np.zeros((3, 3))]) is None
    assert depth_range([]) is None
    low, high = depth_range([near])  # type: ignore[misc]
    assert high > low


def test_depth_colours() -> None:
    depth = np.array([[1.0, 3.0, 0.0, np.nan, 5.0]])
    shown = depth_picture(depth, (1.0, 3.0))
    ends = coloured(np.array([[0.0, 1.0]]), DEPTH_COLOURS)
    assert (shown[0, 0] == ends[0, 0]).all() and (shown[0, 1] == ends[0, 1]).all()
    assert (shown[0, 2:4] == MISSING).all()
    assert (shown[0, 4] == ends[0, 1]).all()
    assert (depth_picture(np.zeros((2, 2)), None) == MISSING).all()


@given(count=st.integers(0, 300), most=st.integers(2, 40))
def test_spread(count: int, most: int) -> None:
    found = spread(count, most)
    assert len(found) == min(count, most) and found == sorted(set(found))
    if count:
        assert found[0] == 0 and found[-1] == count - 1


def test_pictures_of_both_methods() -> None:
    views = make_views()
    indices = np.flatnonzero(views.test)
    found = method_pictures(views, indices, {name: [draw(views, i, name == "tsdf") for i in indices] for name in ("field", "tsdf")}, "m")
    assert [view.name for view in found.views] == ["0000.jpg", "0003.jpg"] and found.left_out == 0
    view = found.views[0]
    assert set(view.methods) == {"field", "tsdf"} and view.measured is not None
    assert view.truth is views.images[0]
    assert (view.methods["tsdf"].depth[:, 0] == MISSING).all()
    assert found.depth_range is not None and 1 <= found.depth_range[0] < found.depth_range[1] <= 3.3
    shape = view.truth.shape
    assert all(
        tile.shape == shape and tile.dtype == np.uint8 for one in view.methods.values() for tile in (one.render, one.error, one.depth)
    )


def test_only_some_of_many_views() -> None:
    views = make_views(count=30, every=2)
    indices = np.flatnonzero(views.test)
    found = method_pictures(views, indices, {"field": [draw(views, i) for i in indices]}, most=4)
    assert len(found.views) == 4 and found.left_out == 11
    assert found.views[0].name == "0000.jpg" and found.views[-1].name == "0028.jpg"


def test_what_was_left_out_is_tinted() -> None:
    views = make_views()
    small = [np.zeros((3, 4), bool) for _ in views.names]
    small[3][:, 2:], small[1][0] = True, True
    assert moving_pictures(views, None) == [] and moving_pictures(views, LeftOut.of(views.names, [one & False for one in small])) == []
    shown = moving_pictures(views, LeftOut.of(views.names, small))
    assert [name for name, _ in shown] == [views.names[1], views.names[3]]
    picture, half = shown[1][1], views.images[3].shape[1] // 2
    assert np.array_equal(picture[:, :half], views.images[3][:, :half]) and picture.dtype == np.uint8
    assert (np.abs(picture[:, half:].astype(int) - np.array(TINT)) <= 0.4 * 255 + 1).all() and (picture != views.images[3])[:, half:].any()
    assert [name for name, _ in moving_pictures(views, LeftOut.of(views.names, small), most=1)] == [views.names[3]]


def test_no_rendering_at_all() -> None:
    views = make_views(depth=False)
    found = method_pictures(views, [0], {})
    assert found.views[0].methods == {} and found.depth_range is None
