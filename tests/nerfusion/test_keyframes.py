"""Key frames: how many, which, and with which neighbours."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Similarity
from fieldfuse.config import KeyframesSettings
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.keyframes import UNIFORM, KeyFrames, select_keyframes
from fieldfuse.poses.overlap import convergence, guessed_depth, overlap, parallax
from tests.poses.textured import CAMERA, arc, look_at


def choose(poses, depth=3.0, **options):
    wanted = KeyframesSettings(**{name: options.pop(name) for name in ("method", "every", "most") if name in options})
    return select_keyframes(poses, [CAMERA] * len(poses), depth, wanted, **options)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 60), st.floats(5, 180), st.integers(2, 5))
def test_neighbours_are_other_frames_and_distinct(count, degrees, views):
    keys = choose(arc(count, degrees), views=views)
    assert keys.indices[0] == 0 and np.all(np.diff(keys.indices) > 0) and keys.indices[-1] < count
    assert keys.neighbours.shape == (len(keys.indices), min(views - 1, count - 1))
    for index, row in zip(keys.indices, keys.neighbours, strict=True):
        assert index not in row and len(set(row)) == len(row) and all(0 <= n < count for n in row)


def test_a_standing_camera_needs_one_key_frame_and_a_fast_one_all():
    assert len(choose(np.repeat(arc(1), 30, axis=0)).indices) == 1
    assert len(choose(arc(8, 160.0)).indices) == 8


def test_density_follows_motion_not_frame_rate():
    slow, fast = choose(arc(300, 100.0)), choose(arc(100, 100.0))
    assert abs(len(slow.indices) - len(fast.indices)) <= 0.2 * len(fast.indices)
    assert 100 / len(fast.indices) > 3


def test_turning_alone_makes_key_frames_too():
    poses = np.array([look_at(np.zeros(3), np.array([np.sin(a), 0, np.cos(a)])) for a in np.radians(np.arange(0, 90, 1.0))])
    keys = choose(poses)
    assert 5 < len(keys.indices) < 30


def test_unit_of_length_does_not_matter():
    poses = arc(60, 90.0)
    scaled = Similarity(250.0, np.eye(3), np.array([1e4, 0, 0])).poses(poses)
    ours, theirs = choose(poses), choose(scaled, depth=750.0)
    np.testing.assert_array_equal(ours.indices, theirs.indices)
    np.testing.assert_array_equal(ours.neighbours, theirs.neighbours)


def test_neighbours_see_the_same_under_useful_parallax_and_from_both_sides():
    poses = arc(60, 90.0)
    angles = parallax(poses, 3.0)
    shares = overlap(poses, [CAMERA] * 60, 3.0)
    keys = choose(poses)
    inner = [(i, row) for i, row in zip(keys.indices, keys.neighbours, strict=True) if 10 < i < 50]
    assert inner
    for i, row in inner:
        assert all(3 < angles[i, n] < 16 and shares[i, n] > 0.5 for n in row)
    sides = [np.sign(int(row[0]) - int(i)) != np.sign(int(row[1]) - int(i)) for i, row in inner]
    assert np.mean(sides) > 0.7


def test_uniform_is_the_paper_s_option_and_most_bounds_both():
    poses = arc(95, 150.0)
    assert choose(poses, method=UNIFORM, every=10).indices.tolist() == list(range(0, 95, 10))
    assert len(choose(poses, method=UNIFORM, every=5, most=4).indices) == 4
    few = choose(poses, most=5)
    assert len(few.indices) == 5 and np.diff(few.indices).min() > 8  # spread out, not the first five


def test_round_trip():
    keys = choose(arc(20, 90.0))
    back = KeyFrames.from_dict(json.loads(json.dumps(keys.to_dict())))
    np.testing.assert_array_equal(back.indices, keys.indices)
    np.testing.assert_array_equal(back.neighbours, keys.neighbours)


@pytest.mark.parametrize("options", [{"depth": 0.0}, {"depth": float("nan")}, {"method": "best"}, {"views": 1}, {"most": 0}, {"every": 0}])
def test_bad_arguments_are_refused(options):
    with pytest.raises(InputError, match="key frames"):
        choose(arc(5), **options)
    with pytest.raises(InputError, match="key frames"):
        select_keyframes(np.zeros((0, 4, 4)), [], 1.0)


def test_convergence_and_guessed_depth():
    point, depth, miss = convergence(arc(20, 120.0))
    np.testing.assert_allclose(point, [-0.1, -0.7, 2.0], atol=1e-3)
    assert (depth > 0).all() and miss.max() < 1e-3
    assert guessed_depth(arc(20, 120.0)) == pytest.approx(np.median(depth), rel=0.6)
    ahead = np.array([look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 9.0])) for x in np.linspace(-1, 1, 9)])
    assert guessed_depth(ahead) > 0


def test_a_blurred_key_frame_gives_way_to_a_sharp_frame_beside_it():
    poses = arc(100, 90.0)
    plain = choose(poses)
    clear = np.ones(len(poses))
    assert choose(poses, sharpness=clear).indices.tolist() == plain.indices.tolist()
    blurred = int(plain.indices[3])
    clear[blurred] = 0.3
    keys = choose(poses, sharpness=clear)
    assert blurred not in keys.indices and len(keys.indices) == len(plain.indices)
    (other,) = set(keys.indices.tolist()) - set(plain.indices.tolist())
    angles = parallax(poses, 3.0)
    assert angles[blurred, other] <= 2.5
    np.testing.assert_array_equal(keys.neighbours[keys.indices.tolist().index(other)], best_neighbours_of(poses)[other])


def best_neighbours_of(poses):
    from fieldfuse.poses.overlap import best_neighbours

    return best_neighbours(poses, overlap(poses, [CAMERA] * len(poses), 3.0), parallax(poses, 3.0), 2)
