"""Depth maps of a corner, with the faults that fields have, polished and made to agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.stereo.depth_refinement import FieldDepths, Polisher, settled
from fieldfuse.stereo.plane_completion import Unsure
from tests.stereo import made as exact
from tests.stereo.made import CAMERA, FAR, MEDIAN, NEAR, filmed

FLOOR_OR_WALL = slice(70, 100), slice(20, 70)  # rows, columns


@pytest.fixture(scope="module")
def corner() -> tuple[Views, list[Array]]:
    views, truth = filmed({1: (129, 100), 2: (130, 100)})
    return views, [depth.astype(np.float32) for depth in truth]


def made(
    views: Views,
    depths: list[Array],
    guesses: list[Array] | None = None,
    told: list[Array] | None = None,
    measured: Sequence[Array | None] = (),
) -> list[Array]:
    told = [np.ones(depth.shape, bool) for depth in depths] if told is None else told
    return settled(FieldDepths(depths, depths if guesses is None else guesses, told), views, [CAMERA] * len(views), MEDIAN, measured)


def off(depth: Array, truth: Array, where: Array) -> Array:
    """Relative errors where there is a depth."""
    kept = where & (depth > 0) & (truth > 0)
    return np.asarray(np.abs(depth - truth)[kept] / truth[kept])


def guessed(views: Views, truth: list[Array]) -> tuple[list[Array], list[Array]]:
    """What is bare is off in every second view, in each by so much that no two agree; and where that is."""
    shares = np.array([0, -0.04, 0, 0.03, 0, 0.045, 0])
    bare = [np.abs(picture[..., 0].astype(int) - 129) <= 2 for picture in views.images]
    depths = [np.where(grey, depth * (1 + share), depth).astype(np.float32) for depth, share, grey in zip(truth, shares, bare, strict=True)]
    return depths, [grey & (depth > 0) & (share != 0) for depth, share, grey in zip(truth, shares, bare, strict=True)]


@pytest.mark.parametrize(("planar", "share"), [(2.0, 0.98), (0.6, 0.97)])
def test_exact_depth_stays(corner: tuple[Views, list[Array]], monkeypatch: pytest.MonkeyPatch, planar: float, share: float) -> None:
    """Where pictures are asked, a plane may be taken at their borders for what stands before it: few others see what they show."""
    monkeypatch.setattr("fieldfuse.stereo.depth_refinement.PLANAR", planar)
    views, truth = corner
    for depth, true in zip(made(views, truth), truth, strict=True):
        assert (depth > 0)[true > 0].mean() > 0.97 and depth.dtype == np.float32
        assert not depth[true <= 0].any()
        assert np.quantile(off(depth, true, true > 0), share) < 0.005


def test_a_guess_becomes_the_plane_that_goes_on_there(corner: tuple[Views, list[Array]]) -> None:
    views, truth = corner
    depths, wrong = guessed(views, truth)
    better = made(views, depths)
    before = np.concatenate([off(*case) for case in zip(depths, truth, wrong, strict=True)])
    after = np.concatenate([off(*case) for case in zip(better, truth, wrong, strict=True)])
    assert np.median(before) > 0.01
    assert np.median(after) < 0.2 * np.median(before)
    assert np.mean([(depth > 0)[patch].mean() for depth, patch in zip(better, wrong, strict=True) if patch.any()]) > 0.7


def test_what_pictures_do_not_tell_becomes_the_plane_even_if_all_views_agree(corner: tuple[Views, list[Array]]) -> None:
    """A field is one thing: where its bare wall is wavy, it is so from everywhere."""
    views, truth = corner
    bare = [np.abs(picture[..., 0].astype(int) - 129) <= 2 for picture in views.images]
    nearer = [np.where(grey, 0.985 * depth, depth).astype(np.float32) for depth, grey in zip(truth, bare, strict=True)]
    blind, seeing = made(views, nearer), made(views, nearer, told=[~grey for grey in bare])
    patches = [grey & (true > 0) for grey, true in zip(bare, truth, strict=True)]
    before, after = (np.concatenate([off(*case) for case in zip(maps, truth, patches, strict=True)]) for maps in (blind, seeing))
    assert np.median(before) > 0.01 and np.median(after) < 0.003
    assert np.mean([(depth > 0)[patch].mean() for depth, patch in zip(seeing, patches, strict=True)]) > 0.9


def test_no_plane_goes_where_nothing_was(corner: tuple[Views, list[Array]]) -> None:
    views, truth = corner
    hole = np.zeros(truth[0].shape, bool)
    hole[FLOOR_OR_WALL] = True
    missing = [np.where(hole, 0, depth).astype(np.float32) for depth in truth]
    assert not any(depth[hole].any() for depth in made(views, missing))


def test_beside_what_is_sure_no_plane_goes_far_from_what_was(corner: tuple[Views, list[Array]], monkeypatch: pytest.MonkeyPatch) -> None:
    """In scenes that are not of planes, where pictures are not asked."""
    monkeypatch.setattr("fieldfuse.stereo.depth_refinement.PLANAR", 2.0)
    views, truth = corner
    hole = np.zeros(truth[0].shape, bool)
    hole[FLOOR_OR_WALL] = True
    missing = [np.where(hole, 0, depth).astype(np.float32) for depth in truth]
    near = [np.where(hole, 0.4 * depth, 0).astype(np.float32) for depth in truth]  # many pixels of parallax before the wall
    for depth, true in zip(made(views, missing, [a + b for a, b in zip(missing, near, strict=True)]), truth, strict=True):
        assert not depth[hole & (true > 0)].any()


def test_a_guess_far_from_the_plane_gives_way_where_pictures_show_the_plane() -> None:
    """Many pixels of parallax before it; all walls have texture."""
    views, truth = filmed({})
    hole = np.zeros(truth[0].shape, bool)
    hole[FLOOR_OR_WALL] = True
    exact = [depth.astype(np.float32) for depth in truth]
    missing = [np.where(hole, 0, depth).astype(np.float32) for depth in exact]
    wild = [np.where(hole, (0.4 + 0.03 * index) * depth, depth).astype(np.float32) for index, depth in enumerate(exact)]
    got = made(views, missing, wild)
    errors = np.concatenate([off(depth, true, hole) for depth, true in zip(got, exact, strict=True)])
    assert np.mean([(depth > 0)[hole & (true > 0)].mean() for depth, true in zip(got, exact, strict=True)]) > 0.95
    assert np.median(errors) < 0.002 and (errors < 0.01).mean() > 0.9


def test_of_what_is_round_planes_go_no_farther_than_beside_what_is_sure(
    corner: tuple[Views, list[Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures are asked which plane they show in a scene of planes, and there alone."""
    views, truth = corner
    asked: list[int] = []
    def none_shown(index: int, maps: list[Unsure], *_: object) -> Array:
        asked.append(index)
        return np.full(maps[0].sure.shape, -1, np.int32)

    monkeypatch.setattr("fieldfuse.stereo.depth_refinement.shown_planes", none_shown)
    v, u = np.mgrid[: truth[0].shape[0], : truth[0].shape[1]]
    bent = [(depth * (1 + 0.05 * np.sin(u / 9) * np.cos(v / 9))).astype(np.float32) for depth in truth]
    round_ = made(views, bent)
    assert not asked and all((depth > 0).mean() > 0.5 for depth in round_)
    made(views, truth)
    assert sorted(asked) == list(range(len(views)))


def test_what_a_sensor_measured_is_sure(corner: tuple[Views, list[Array]]) -> None:
    """Also where pictures tell nothing: a wall that all views hold, and the sensor with them, is no guess; without the sensor it is."""
    views, truth = corner
    blind = [np.zeros(depth.shape, bool) for depth in truth]
    bent = [(depth * (1 + 0.006 * np.sin(np.arange(depth.shape[1]) / 7))).astype(np.float32) for depth in truth]
    small = [depth[::2, ::2].copy() for depth in bent]
    got = made(views, bent, told=blind, measured=small)
    kept = [np.abs(depth / there - 1)[depth > 0] < 1e-6 for depth, there in zip(got, bent, strict=True)]
    assert np.mean([one.mean() for one in kept]) > 0.9
    assert made(views, bent, told=blind, measured=[None] * len(views))[3].shape == truth[3].shape


def test_a_floater_is_dropped_and_what_one_view_alone_sees_stays(corner: tuple[Views, list[Array]]) -> None:
    views, truth = corner
    floating = [depth.copy() for depth in truth]
    floating[3][50:62, 60:76] *= 0.6  # others see through it
    depth = made(views, floating)[3][50:62, 60:76]
    assert not (np.abs(depth - floating[3][50:62, 60:76]) < 0.05).any()
    alone = [np.zeros_like(depth) for depth in truth]
    alone[3] = truth[3]
    kept = made(views, alone)[3]
    assert np.array_equal(kept, truth[3])


def test_a_view_alone_is_left_as_it_was(corner: tuple[Views, list[Array]]) -> None:
    views, truth = corner
    assert np.array_equal(made(views.subset(np.array([0])), truth[:1])[0], truth[0])


def test_depth_that_is_nearly_right_is_polished() -> None:
    """Smooth errors of about 1% shrink; what is missing stays missing, and a view without neighbours keeps what it has."""
    views, truth = exact.corner()
    polisher = Polisher(views, views.intrinsics, NEAR, FAR, MEDIAN)
    waves = 1 + 0.012 * np.sin(np.arange(160) / 9)
    before, after = [], []
    for index, true in enumerate(truth):
        given = np.where(np.arange(120)[:, None] < 6, 0, true * waves).astype(np.float32)
        got, told = polisher.polished(index, given)
        assert got.dtype == np.float32 and ((got > 0) == (given > 0)).all()
        assert told.mean() > 0.5 and not told[given == 0].any()
        known = given > 0
        before.append(np.abs(given - true)[known] / true[known])
        after.append(np.abs(got - true)[known] / true[known])
    assert np.median(np.concatenate(after)) < 0.4 * np.median(np.concatenate(before))
    # Where a sensor, of half the size, measured the same place nothing moves; where it measured another, or nothing, pictures decide.
    free, told = polisher.polished(0, given := (truth[0] * waves).astype(np.float32))
    sensor = truth[0][::2, ::2].copy()
    sensor[:20], sensor[20:40] = 0, 2 * sensor[20:40]
    held, still = polisher.polished(0, given, measured=sensor)
    assert (held[:80] == free[:80]).mean() > 0.999 and (still[:80] == told[:80]).mean() > 0.999
    assert (held[80:] == given[80:]).mean() > 0.99 and (free[80:] == given[80:]).mean() < 0.5  # but for edges
    assert told[80:].mean() > 0.5 and still[80:].mean() < 0.01
    alone = Polisher(views.subset([0]), views.intrinsics[:1], NEAR, FAR, MEDIAN)
    got, told = alone.polished(0, truth[0])
    np.testing.assert_array_equal(got, np.where(truth[0] > 0, truth[0], 0).astype(np.float32))
    assert not told.any()
