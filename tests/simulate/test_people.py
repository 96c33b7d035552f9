"""People who pass: they are where the mask says and nowhere else, a depth camera measures them, and the truth is that without them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from fieldfuse.camera import Array, Intrinsics, project
from fieldfuse.capture.types import Views
from fieldfuse.effects.effect_specs import STRENGTHS, parse, preset
from fieldfuse.effects.scenery import EYES, Pedestrians, Walk
from fieldfuse.simulate.eye import eye_of, take
from fieldfuse.simulate.film import Film, FilmCamera
from fieldfuse.simulate.materials import TextureBank
from fieldfuse.simulate.mesh_scene import load_mesh_scene
from fieldfuse.simulate.paths import PathSettings, plan
from fieldfuse.simulate.people import Peopled, peopled
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.stereo import transients
from tests.simulate.test_film import CAMERA
from tests.simulate.test_mesh_scene import wall
from tests.simulate.test_simulate import made

PATH = PathSettings("walk", frames=24, fps=3.0, speed=0.5)


def filmed(bank: TextureBank, *listing: object, camera: Intrinsics = CAMERA) -> Film:
    scene = random_scene("room", np.random.default_rng(4), bank)
    motion = plan(scene, PATH, np.random.default_rng(4))
    return Film(scene, FilmCamera(camera, depth=True), motion, PATH.times(), parse(list(listing), "test"), 4)


def around(mask: Array, pixels: int = 1) -> Array:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)) > 0)


def test_people_are_where_the_mask_says(bank: TextureBank) -> None:
    clean, passed = filmed(bank), filmed(bank, "passers")
    shares = []
    for index in range(0, len(clean), 2):
        alone, shot = clean.shot(index), passed.shot(index)
        assert alone.passed is None and shot.passed is not None and alone.sensor_depth is not None and shot.sensor_depth is not None
        shares.append(float(shot.passed.mean()))
        assert np.array_equal(alone.depth, shot.depth) and np.array_equal(alone.normals, shot.normals)
        away = ~around(shot.passed)  # a pixel at his edge is partly his
        assert (alone.rgb != shot.rgb).any(axis=2)[away].mean() < 1e-3  # a finger's tip may miss every pixel's centre
        assert np.array_equal(alone.sensor_depth[~shot.passed], shot.sensor_depth[~shot.passed])
        if shot.passed.any():
            assert (shot.sensor_depth[shot.passed] < alone.depth[shot.passed]).all() and (shot.sensor_depth[shot.passed] > 0.2).all()
            assert (alone.rgb != shot.rgb).any(axis=2)[shot.passed].mean() > 0.9
            assert shot.facts["passers"]["share"] == shares[-1]
        else:
            assert np.array_equal(alone.rgb, shot.rgb)
    assert 0.1 < np.mean(np.array(shares) > 0.01) < 0.9 and 0.05 < max(shares) < 0.7


@pytest.mark.parametrize("strength", STRENGTHS)
def test_so_much_of_the_time_somebody_is_in_the_picture(strength: str) -> None:
    effect, times = preset("passers", strength), np.arange(0, 120, 0.5)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # ahead is +y, z is up
    poses[:, 2, 3] = EYES
    focus, wide = np.array([0.0, 4.0, 1.0]), 1.2
    walks = effect.walks(times, poses, focus, wide, 0.0, np.random.default_rng(0))
    in_view = np.zeros(len(times), bool)
    for walk in walks:
        assert effect.near * 3.9 < walk.foot[1] < effect.far * 4.2 and walk.foot[2] == 0 and abs(walk.foot[0]) < 1e-9
        assert 0.7 * effect.speed <= np.linalg.norm(walk.velocity) <= 1.3 * effect.speed and walk.velocity[2] == 0
        for number, seconds in enumerate(times):
            foot = walk.foot_at(float(seconds))
            inside = abs(foot[0]) < 0.5 * wide * max(foot[1], 0)
            in_view[number] |= inside
            assert walk.near(float(seconds)) or not inside  # who is not near is never seen
    assert 0.4 * effect.share < in_view.mean() < 1.2 * effect.share
    assert not Pedestrians(share=0).walks(times, poses, focus, wide, 0.0, np.random.default_rng(0))


def test_they_cross_the_optical_axis_at_their_moment() -> None:
    times, pose = np.arange(4.0), np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0, 0], [0, 0.2, 0.98], [0, -0.98, 0.2]])
    pose[:3, 3] = 1, 2, 1.5
    poses, focus = np.tile(pose, (4, 1, 1)), np.array([1.0, 6.0, 1.0])
    walks = preset("passers", "strong").walks(times, poses, focus, 1.2, None, np.random.default_rng(1))
    for walk in walks:
        assert walk.foot[2] == pytest.approx(1.5 - EYES)
        beside = walk.foot_at(walk.moment) + np.array([0, 0, walk.height / 2])
        assert project(CAMERA, pose, beside[None])[0][0, 0] == pytest.approx(CAMERA.cx, abs=1e-6)


def test_nobody_near_is_no_other_scene(bank: TextureBank) -> None:
    scene = random_scene("room", np.random.default_rng(4), bank)
    walk = Walk(5.0, np.zeros(3), np.array([1.0, 0, 0]), 1.7, 2.0, 3)
    assert peopled(scene, [walk], 1.0) is scene and peopled(scene, [], 5.0) is scene
    there = peopled(scene, [walk], 5.5)
    assert isinstance(there, Peopled) and there.device == scene.device
    points = torch.tensor([[0.5, 0.0, 0.9], [1.0, 1.0, 1.2]])
    assert torch.equal(there.clearance(points), scene.clearance(points))  # the truth is that of the scene
    assert len(there.mesh().triangles) == len(scene.mesh().triangles)


def test_people_walk_through_meshes_too(tmp_path: Path) -> None:
    wall().export(tmp_path / "wall.glb")
    scene = load_mesh_scene(tmp_path / "wall.glb", "z", 1.0)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[:3, 3] = scene.focus - [0, 3.0, 0]
    walk = Walk(0.0, np.array([pose[0, 3], pose[1, 3] + 1.5, pose[2, 3] - 1.0]), np.array([1.0, 0, 0]), 1.7, 2.0, 3)
    with_him = take(peopled(scene, [walk], 0.0), eye_of(CAMERA, 1, scene.device), pose[None])
    without = take(scene, eye_of(CAMERA, 1, scene.device), pose[None])
    nearer = (with_him.depth > 0) & ((without.depth == 0) | (with_him.depth < without.depth))
    assert 0.05 < float(nearer.float().mean()) < 0.7 and float(with_him.depth[nearer].mean()) == pytest.approx(1.5, abs=0.25)
    assert torch.equal(with_him.linear[~nearer], without.linear[~nearer])


def test_they_stand_in_the_captures_truth(tmp_path: Path) -> None:
    listed = ["passers:strong", "motion_blur", "rolling_shutter", "depth_noise"]
    folder = made(tmp_path / "capture", listed, depth=True, path={"frames": 4, "fps": 1})
    frames = json.loads((folder / "ground_truth" / "effects.json").read_text())["frames"]
    masks = [load_file(str(folder / f"ground_truth/frames/{index:06d}.safetensors"))["passers"] for index in range(4)]
    assert all(mask.shape == (48, 64) and mask.dtype == np.uint8 for mask in masks) and any(mask.any() for mask in masks)
    for frame, mask in zip(frames, masks, strict=True):
        assert frame.get("passers", {"share": 0.0})["share"] == pytest.approx(mask.mean())


def test_what_passes_in_a_film_is_found_as_moving(bank: TextureBank) -> None:
    """By what a depth camera measures; the film's own mask is the truth."""
    camera = Intrinsics(96, 72, 72.0, 72.0, 48.0, 36.0)
    film = filmed(bank, "passers:strong", camera=camera)
    shots = [film.shot(index) for index in range(len(film))]
    names, poses = [f"{shot.index:03d}" for shot in shots], np.array([shot.world_from_camera for shot in shots])
    views = Views(names, [shot.rgb for shot in shots], [camera] * len(shots), poses, np.zeros(len(shots), bool))
    median = float(np.median([np.median(shot.depth[shot.depth > 0]) for shot in shots]))
    found = transients.moving(views, [shot.sensor_depth for shot in shots], [camera] * len(shots), median, measured=True)
    truth = [shot.passed for shot in shots if shot.passed is not None]
    assert np.mean([mask.mean() for mask in truth]) > 0.05
    hit = sum(int((one & mask).sum()) for one, mask in zip(found, truth, strict=True)) / sum(int(mask.sum()) for mask in truth)
    false = np.mean([(one & ~around(mask, 3)).mean() for one, mask in zip(found, truth, strict=True)])
    assert hit > 0.85 and false < 0.01
