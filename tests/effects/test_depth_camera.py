"""Depth cameras beside the pictures', found in filmed captures and from made-up observations, and not found where there are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file

from fieldfuse.camera import OPENCV, Array, Intrinsics, invert, pixel_grid
from fieldfuse.capture import open_capture
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.prepare import held_out
from fieldfuse.config import EffectsSettings
from fieldfuse.effects.correct import Corrections
from fieldfuse.effects.decide import Decided, decide
from fieldfuse.effects.depth_camera import DEPTH_OFFSET, FEWEST, DepthMaps, Observations, register
from fieldfuse.effects.effect_specs import preset
from fieldfuse.simulate import procedural
from fieldfuse.simulate.materials import texture_bank
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate

CAMERA = Intrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)


def walls(pixels: Array, from_world: Array) -> Array:
    """(…,) depth of a corner of three walls at (…, 2) pixels of a camera."""
    rays = np.concatenate([(pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones((*pixels.shape[:-1], 1))], axis=-1)
    place = invert(from_world)
    rays = rays @ place[:3, :3].T
    depths = []
    for normal in np.array([[1.0, 0.2, 0.6], [-0.8, 0.1, 0.7], [0.0, 0.9, 0.5]]):
        slope = rays @ normal
        depths.append(np.where(slope > 1e-6, (2 - normal @ place[:3, 3]) / np.maximum(slope, 1e-6), np.inf))
    return np.minimum.reduce(depths)


def observations(depth_from_image: Array, noise: float = 0.005, count: int = 1500, seed: int = 0, maps: int = 4) -> Observations:
    """Points on the walls, and depth maps of a camera that stands beside that of the pictures."""
    rng = np.random.default_rng(seed)
    places, point, owner, values = [], [], [], []
    for number in range(maps):
        world = np.eye(4)
        world[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.15, 3))[0]
        world[:3, 3] = rng.normal(0, 0.2, 3)
        at = rng.uniform(3, [CAMERA.width - 3, CAMERA.height - 3], (count, 2))
        z = walls(at, world) * (1 + rng.normal(0, noise, count))
        places.append(np.concatenate([(at - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones((count, 1))], axis=1) * z[:, None])
        point.append(number * count + np.arange(count))
        owner.append(np.full(count, number))
        sensed = walls(pixel_grid(CAMERA.width, CAMERA.height), depth_from_image @ world)
        values.append((sensed * (1 + rng.normal(0, noise, sensed.shape))).astype(np.float32).ravel())
    start = np.arange(maps) * CAMERA.width * CAMERA.height
    size = np.tile([CAMERA.width, CAMERA.height], (maps, 1))
    parts = np.concatenate(places), np.concatenate(point), np.concatenate(owner), np.concatenate(values)
    return Observations(*parts[:3], DepthMaps(parts[3], start, size, np.ones(maps), (CAMERA,) * maps))


def with_values(some: Observations, values: Array) -> Observations:
    return replace(some, maps=replace(some.maps, values=values))


def apart(one: Array, other: Array) -> tuple[float, float]:
    """Degrees and units between two poses."""
    off = one @ np.linalg.inv(other)
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(off[:3, :3])[0]))), float(np.linalg.norm(off[:3, 3]))


@pytest.mark.parametrize("strength", ["weak", "medium", "strong"])
@pytest.mark.parametrize("seed", [0, 1])
def test_an_offset_is_recovered(strength: str, seed: int) -> None:
    true = preset("depth_offset", strength).forward()
    found = register(observations(true, seed=seed))
    assert found is not None and found.there and found.after < 0.01
    turn, move = apart(found.depth_from_image, true)
    assert turn < 0.15 and move < 0.006


def test_nothing_is_found_where_nothing_is_nor_a_scale_taken_for_it() -> None:
    found = register(observations(np.eye(4)))
    assert found is not None and not found.there and abs(found.gain) < 0.02
    larger = observations(np.eye(4))
    found = register(replace(larger, places=1.03 * larger.places))  # poses that are three percent too large
    assert found is not None and not found.there


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(unit: float) -> None:
    true = preset("depth_offset", "medium").forward()
    some = observations(true)
    one, other = register(some), register(with_values(replace(some, places=unit * some.places), np.float32(unit) * some.maps.values))
    assert one is not None and other is not None
    np.testing.assert_allclose(other.depth_from_image[:3, :3], one.depth_from_image[:3, :3], atol=1e-3)
    np.testing.assert_allclose(other.depth_from_image[:3, 3] / unit, one.depth_from_image[:3, 3], atol=2e-3)
    assert other.gain == pytest.approx(one.gain, abs=0.01)


def test_each_frame_may_have_its_own_camera_and_a_lens() -> None:
    true = preset("depth_offset", "medium").forward()
    some = observations(true)
    one = register(some)
    cameras = tuple(replace(CAMERA, fx=140.0 + 1e-9 * number) for number in range(4))
    other = register(replace(some, maps=replace(some.maps, cameras=cameras)))
    bent = (replace(CAMERA, lens=OPENCV, distortion=(1e-9, 0.0, 0.0, 0.0)),) * 4
    lens = register(replace(some, maps=replace(some.maps, cameras=bent)))
    assert one is not None and other is not None and lens is not None
    for found in (other, lens):
        np.testing.assert_allclose(found.depth_from_image, one.depth_from_image, atol=1e-3)


def test_a_wall_straight_ahead_without_noise_moves_nothing() -> None:
    some = observations(np.eye(4), noise=0)
    flat = with_values(replace(some, places=2 * some.places / some.places[:, 2:]), np.full_like(some.maps.values, 2))
    found = register(flat)
    assert found is not None and not found.there
    np.testing.assert_allclose(found.depth_from_image, np.eye(4), atol=1e-6)


def test_a_third_of_wrong_points_does_no_harm() -> None:
    true = preset("depth_offset", "medium").forward()
    some = observations(true)
    wrong = np.random.default_rng(5).random(len(some.places)) < 0.3
    found = register(replace(some, places=np.where(wrong[:, None], 1.3 * some.places, some.places)))
    assert found is not None
    turn, move = apart(found.depth_from_image, true)
    assert turn < 0.2 and move < 0.01


def test_too_little_tells_nothing() -> None:
    some = observations(np.eye(4))
    assert register(some.some(np.arange(FEWEST - 1))) is None
    assert register(with_values(some, np.zeros_like(some.maps.values))) is None


def filmed(tmp_path: Path, *effects: str) -> Path:
    # Depth costs hardly anything, texture tells the points, and a walk sees them from several places.
    scene = {
        "scene": "room",
        "depth": True,
        "seed": 21,
        "camera": {"width": 240, "height": 180},
        "path": {"kind": "walk", "frames": 18, "fps": 4, "speed": 0.5, "shake": 3},
        "side": 1,
        "effects": list(effects),
    }
    simulate(scene_file(scene, "test"), tmp_path / "capture")
    return tmp_path / "capture"


def decided(folder: Path, **settings: list[str]) -> Decided:
    capture = open_capture(folder)
    return decide(capture, held_out(capture, 8), EffectsSettings(**settings))


def of_depth(found: Decided) -> tuple[bool, bool]:
    decision = next(one for one in found.decisions if one.finding.effect == DEPTH_OFFSET)
    return decision.finding.there, decision.on


def test_a_filmed_offset_is_found_and_its_depth_carried_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedural, "texture_bank", lambda: texture_bank(size=256))
    folder = filmed(tmp_path, "depth_offset:strong", "depth_noise:weak")
    found = decided(folder)
    assert of_depth(found) == (True, True)
    turn, move = apart(np.linalg.inv(found.corrections.depth), preset("depth_offset", "strong").forward())
    assert turn < 0.5 and move < 0.03
    again = Corrections.from_dict(found.corrections.to_dict())
    np.testing.assert_allclose(again.depth, found.corrections.depth)
    # What is used then is what a camera where the pictures were taken would have measured.
    capture, moved = open_capture(folder), again.on_capture(open_capture(folder))
    off: dict[str, list[Array]] = {"as it came": [], "carried": []}
    for index, frame in enumerate(capture.frames):
        true = load_file(folder / "ground_truth" / "frames" / f"{index:06d}.safetensors")["depth"]
        for key, depth in (("as it came", load_depth(frame, capture)), ("carried", load_depth(moved.frames[index], moved))):
            both = (true > 0) & (depth > 0)
            off[key].append(np.abs(depth[both] / true[both] - 1))
    shares = {key: float(np.mean(np.concatenate(values) > 0.03)) for key, values in off.items()}
    assert shares["carried"] < 0.4 * shares["as it came"]
    # Switched off, it is told and left alone.
    left = decided(folder, off=[DEPTH_OFFSET])
    assert of_depth(left) == (True, False) and left.corrections.depth is None


def test_a_capture_whose_depth_is_registered_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedural, "texture_bank", lambda: texture_bank(size=256))
    found = decided(filmed(tmp_path, "depth_noise:weak"))
    assert of_depth(found) == (False, False) and found.corrections.depth is None
    capture = open_capture(tmp_path / "capture")
    assert found.corrections.on_capture(capture) is capture or all(frame.depth_pose is None for frame in capture.frames)
