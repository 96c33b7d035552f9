"""Camera paths: rigid, upright, at the speed and with the shake that were set, clear of what stands in the scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fieldfuse.errors import InputError
from fieldfuse.simulate.materials import TextureBank
from fieldfuse.simulate.paths import MAKERS, Motion, PathSettings, Shake, plan
from fieldfuse.simulate.procedural import KINDS, random_scene


def made(bank: TextureBank, scene: str, kind: str, seed: int = 0, **rest: float) -> tuple[Motion, np.ndarray, float]:
    world = random_scene(scene, np.random.default_rng(seed), bank)
    asked = PathSettings(kind, **rest)  # type: ignore[arg-type]
    motion = plan(world, asked, np.random.default_rng(seed))
    poses = motion.poses(asked.times())
    return motion, poses, float(world.clearance(torch.from_numpy(poses[:, :3, 3])).min())


@pytest.mark.parametrize("kind", sorted(MAKERS))
@pytest.mark.parametrize("scene", KINDS)
def test_every_path_fits_into_every_scene(bank: TextureBank, scene: str, kind: str) -> None:
    _, poses, clear = made(bank, scene, kind, speed=0.3)
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-10)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    assert (rotation[:, 2, 1] < -0.3).all()  # y points down: pictures are upright
    assert clear > 0.05


@pytest.mark.parametrize("kind", ["walk", "orbit", "forward", "fly"])
def test_speed_is_metres_a_second(bank: TextureBank, kind: str) -> None:
    _, poses, _ = made(bank, "room", kind, speed=0.4, shake=0.0, fps=20.0, frames=80)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 20
    np.testing.assert_allclose(speed, 0.4, rtol=0.02)


def test_turning_on_the_spot_is_degrees_a_second(bank: TextureBank) -> None:
    _, poses, _ = made(bank, "room", "rotation", turn=30.0, shake=0.0, fps=10.0, frames=30)
    assert np.ptp(poses[:, :3, 3], axis=0).max() == 0
    heading = np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    np.testing.assert_allclose(np.abs(np.diff(heading)) * 10, np.deg2rad(30), rtol=0.01)


@settings(max_examples=8, deadline=None)
@given(st.floats(0.5, 40), st.integers(0, 1000))
def test_shake_has_the_angular_speed_asked_for(degrees: float, seed: int) -> None:
    shake, step = Shake(degrees, np.random.default_rng(seed)), 1e-3
    times = np.arange(0, 6000, 0.05)  # so long that a few slow waves come to their mean: after 600 s it is 7% off with seed 259
    before, after = (Rotation.from_rotvec(shake.vectors(at)).as_matrix() for at in (times, times + step))
    chord = np.linalg.norm(after - before, axis=(1, 2))  # 2 √2 sin(angle / 2)
    speed = np.rad2deg(2 * np.arcsin(chord / np.sqrt(8))) / step
    assert np.sqrt((speed**2).mean()) == pytest.approx(degrees, rel=0.05)


def test_orbits_look_at_the_focus_and_walks_about(bank: TextureBank) -> None:
    world = random_scene("table", np.random.default_rng(0), bank)
    for kind, most in (("orbit", 0.5), ("walk", 40.0)):
        asked = PathSettings(kind, shake=0.0)
        poses = plan(world, asked, np.random.default_rng(0)).poses(asked.times())
        towards = world.focus - poses[:, :3, 3]
        cosine = (towards * poses[:, :3, 2]).sum(1) / np.linalg.norm(towards, axis=1)
        assert np.rad2deg(np.arccos(cosine.min())) < most


def test_what_does_not_fit_is_told(bank: TextureBank) -> None:
    world = random_scene("room", np.random.default_rng(0), bank)
    with pytest.raises(InputError, match="does not fit into the scene"):
        plan(world, PathSettings("forward", speed=50.0), np.random.default_rng(0))
    with pytest.raises(InputError, match="did you mean 'orbit'"):
        plan(world, PathSettings("orbits"), np.random.default_rng(0))
    world.free = np.array([[50.0, 50, 1], [51, 51, 2]])
    with pytest.raises(InputError, match="no room"):
        plan(world, PathSettings("orbit"), np.random.default_rng(0))
