"""Camera paths stay near the cameras, close, are smooth, and keep the horizon level."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.render.paths import look_at, orbit

UP = np.array([0.0, 0.0, 1.0])
CENTRE = np.array([0.4, -0.3, 0.6])


def rigid(poses: Array) -> bool:
    rotation = poses[:, :3, :3]
    return bool(
        np.allclose(rotation @ np.swapaxes(rotation, 1, 2), np.eye(3), atol=1e-9)
        and np.allclose(np.linalg.det(rotation), 1)
        and np.array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (len(poses), 1)))
    )


def turns(poses: Array) -> Array:
    """Angles between following poses of a closed path, radians."""
    relative = np.einsum("nij,nik->njk", poses[:, :3, :3], np.roll(poses, -1, axis=0)[:, :3, :3])
    return np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))


def closed_and_smooth(poses: Array) -> None:
    assert rigid(poses)
    steps = np.linalg.norm(np.roll(poses[:, :3, 3], -1, axis=0) - poses[:, :3, 3], axis=1)
    extent = np.ptp(poses[:, :3, 3], axis=0).max()
    assert steps.max() < 0.12 * extent  # the step from last to first included
    bends = np.diff(np.append(poses[:, :3, 3], poses[:2, :3, 3], axis=0), n=2, axis=0)
    assert np.linalg.norm(bends, axis=1).max() < 0.03 * extent
    assert turns(poses).max() < 0.25


def level(poses: Array) -> bool:
    """The picture's x axis is horizontal and its upper side is up."""
    return bool(np.abs(poses[:, 2, 0]).max() < 1e-9 and (poses[:, 2, 1] < 0).all())


def ring(count: int, radius: float, height: float, start: float = 0.0, stop: float = 2 * np.pi, jitter: float = 0.0) -> Array:
    rng = np.random.default_rng(0)
    angle = np.linspace(start, stop, count, endpoint=False)
    at = CENTRE + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    return look_at(at + rng.normal(size=at.shape) * jitter, CENTRE, UP)


def nearest(path: Array, cameras: Array) -> Array:
    return np.linalg.norm(path[:, None, :3, 3] - cameras[None, :, :3, 3], axis=2).min(axis=1)


def test_a_ring_of_cameras_gives_the_ring() -> None:
    cameras = ring(60, 3.0, 1.2, jitter=0.08)
    path = orbit(cameras, CENTRE, 90)
    assert path.shape == (90, 4, 4)
    closed_and_smooth(path)
    assert level(path)
    offset = path[:, :3, 3] - CENTRE
    assert np.abs(np.hypot(offset[:, 0], offset[:, 1]) - 3).max() < 0.15
    assert np.abs(offset[:, 2] - 1.2).max() < 0.15
    to_centre = -offset / np.linalg.norm(offset, axis=1, keepdims=True)
    assert (path[:, :3, 2] * to_centre).sum(axis=1).min() > 0.999


def test_an_off_centre_tilted_ellipse_is_followed() -> None:
    angle = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    at = CENTRE + np.stack([0.5 + 3 * np.cos(angle), 2.4 * np.sin(angle), 1 + 0.5 * np.cos(angle)], axis=1)
    path = orbit(look_at(at, CENTRE, UP), CENTRE, 80)
    closed_and_smooth(path)
    assert nearest(path, look_at(at, CENTRE, UP)).max() < 0.45


def test_a_hemisphere_of_cameras() -> None:
    rng = np.random.default_rng(1)
    at = rng.normal(size=(100, 3))
    at[:, 2] = np.abs(at[:, 2])
    cameras = look_at(CENTRE + 4 * at / np.linalg.norm(at, axis=1, keepdims=True), CENTRE, UP)
    path = orbit(cameras, CENTRE, 90)
    closed_and_smooth(path)
    assert level(path)
    assert nearest(path, cameras).max() < 1.6
    assert path[:, 2, 3].min() > CENTRE[2]


@pytest.mark.parametrize("wraps", [0.0, np.pi])
def test_an_arc_is_walked_to_and_fro_and_not_left(wraps: float) -> None:
    cameras = ring(40, 3.0, 0.5, start=wraps - 1.2, stop=wraps + 1.2)  # 137°, for one case across ±180°
    path = orbit(cameras, CENTRE, 90)
    closed_and_smooth(path)
    assert nearest(path, cameras).max() < 0.25
    angle = np.unwrap(np.arctan2(*(path[:, :3, 3] - CENTRE)[:, 1::-1].T))
    assert np.ptp(angle) > 2.0


def test_a_walk_round_an_object_that_does_not_close_is_walked_back() -> None:
    """60° were not walked, and three stray cameras stand in the quarter before them: fog would hang between them and the object."""
    walk = ring(100, 3.0, 0.5, stop=np.deg2rad(210))
    cameras = np.concatenate([walk, ring(3, 3.0, 0.5, start=np.deg2rad(215), stop=np.deg2rad(300))])
    path = orbit(cameras, CENTRE, 90)
    closed_and_smooth(path)
    assert nearest(path, walk).max() < 0.25
    angle = np.arctan2(*(path[:, :3, 3] - CENTRE)[:, 1::-1].T) % (2 * np.pi)
    assert np.ptp(angle) > np.deg2rad(180) and angle.max() < np.deg2rad(215)


def test_cameras_before_a_scene_give_a_small_ellipse() -> None:
    rng = np.random.default_rng(2)
    at = np.stack([rng.uniform(-1, 1, 20), np.full(20, -5.0), rng.uniform(-0.5, 0.5, 20) + 1], axis=1)
    cameras = look_at(at, at + np.array([0, 1, 0]), UP)  # parallel axes
    path = orbit(cameras, np.array([0.0, 0.0, 1.0]), 60)
    closed_and_smooth(path)
    assert np.abs(path[:, 0, 3]).max() < 1
    assert np.ptp(path[:, 0, 3]) > 0.5
    assert np.abs(path[:, 1, 3] + 5).max() < 0.05
    assert (path[:, 1, 2] > 0.8).all()


def test_a_sweep_of_a_room_from_inside() -> None:
    angle = np.linspace(0, 1.7 * np.pi, 80)
    at = np.stack([0.4 * np.cos(angle), 0.4 * np.sin(angle), 1.5 + 0.05 * np.sin(5 * angle)], axis=1)
    out = at + np.stack([np.cos(angle), np.sin(angle), np.full(80, -0.1)], axis=1)
    cameras = look_at(at, out, UP)
    path = orbit(cameras, np.array([0.0, 0.0, 1.5]), 120)
    closed_and_smooth(path)
    assert nearest(path, cameras).max() < 0.1
    assert (path[:, :3, 2] * (path[:, :3, 3] * [1, 1, 0] / 0.4)).sum(axis=1).min() > 0.9  # looks out all the way
    heading = np.unwrap(np.arctan2(path[:, 1, 2], path[:, 0, 2]))
    assert np.ptp(heading) > 1.5 * np.pi
    # The same photos in no order: the walk is found again.
    shuffled = cameras[np.concatenate([[0], 1 + np.random.default_rng(3).permutation(79)])]
    closed_and_smooth(orbit(shuffled, np.array([0.0, 0.0, 1.5]), 120))


def test_who_turns_in_a_room_is_not_sent_round_its_middle() -> None:
    """Such cameras look past the middle by 38° in the median; from where they stood, looking at it shows what hardly anybody filmed."""
    angle = np.deg2rad(np.linspace(-75, 75, 80))
    at = np.stack([0.4 * np.sin(3 * angle), np.linspace(-0.6, 0.6, 80), np.full(80, 1.5)], axis=1)
    cameras = look_at(at, at + np.stack([np.cos(angle), np.sin(angle), np.full(80, -0.1)], axis=1), UP)
    path = orbit(cameras, np.array([2.5, 0.0, 1.0]), 90)
    assert rigid(path)
    apart = np.linalg.norm(path[:, None, :3, 3] - cameras[None, :, :3, 3], axis=2)
    turned = np.arccos(np.clip(path[:, :3, 2] @ cameras[:, :3, 2].T, -1, 1))
    assert (apart + turned).min(axis=1).max() < 0.2


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 12), st.integers(1, 40), st.integers(0, 2**31))
def test_any_cameras_give_rigid_finite_paths(count: int, frames: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    poses[:, :3, 2] *= np.sign(np.linalg.det(poses[:, :3, :3]))[:, None]
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-3, 4)
    if count > 2:
        poses[1] = poses[0]  # a camera that stood still
    for path in (orbit(poses, poses[:, :3, 3].mean(axis=0), frames), orbit(poses, np.zeros(3), frames)):
        assert path.shape == (frames, 4, 4)
        assert np.isfinite(path).all()
        assert rigid(path)


def test_looking_straight_down_is_possible() -> None:
    poses = look_at(np.array([[0.0, 0, 5], [1, 0, 5]]), np.array([0.0, 0, 0]), UP)
    assert rigid(poses)
    assert np.allclose(poses[0, :3, 2], [0, 0, -1])


def test_impossible_paths_are_refused() -> None:
    with pytest.raises(InputError, match="at least one camera"):
        orbit(np.zeros((0, 4, 4)), CENTRE)
    with pytest.raises(InputError, match="at least one frame"):
        orbit(ring(3, 1.0, 0.0), CENTRE, 0)
