"""The demo: colours and light land where they belong, the video shows its truth, and its path gives parallax as a hand would."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.video import read_video
from fieldfuse.config import CaptureSettings, PosesSettings
from fieldfuse.errors import Interrupted, OutputError
from fieldfuse.poses.sfm import find_poses
from fieldfuse.simulate import demo
from fieldfuse.simulate.demo import BakedScene, Filmed, Light, demo_scene, hand_held, write_demo_video
from fieldfuse.simulate.solids import BALL, BOX, upright
from tests.poses.textured import aligned_error
from tests.stereo.made import Stopping

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)
FRONT = np.array([[1, 0, 0, 0], [0, 0, 1, -3], [0, -1, 0, 0.5], [0, 0, 0, 1]], dtype=float)  # at y = −3, looking along y; z is up
FRONT_ONLY = (-1, -1, -1, 0, -1, -1)  # a texture on the face at −y
WALL = upright(BOX, [0, 0.1, 0.5], [2, 0.1, 1.5], FRONT_ONLY)
EVEN = Light(lamp=(0.0, -6.0, 0.5), radius=0.01, lamp_strength=0.0, sky_strength=1.0)


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    """A third of the texels a metre: a pixel of these small pictures covers as much."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "TEXELS", demo.TEXELS // 3)
        patch.setattr(demo, "BOX_TEXELS", demo.BOX_TEXELS // 3)
        yield


@pytest.fixture(scope="module")
def filmed(coarse: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Filmed, list[Array]]:
    path = tmp_path_factory.mktemp("film") / "short.mp4"
    film = write_demo_video(path, frames=5, size=(240, 180), seed=2)
    reader = cv2.VideoCapture(str(path))
    pictures = []
    while (answer := reader.read())[0]:
        pictures.append(cv2.cvtColor(answer[1], cv2.COLOR_BGR2RGB))
    return film, pictures


def test_video_holds_the_frames_of_the_truth(filmed: tuple[Filmed, list[Array]]) -> None:
    film, pictures = filmed
    assert len(pictures) == len(film.world_from_camera) == 5
    for picture, pose in zip(pictures, film.world_from_camera, strict=True):
        exact = film.scene.picture(film.intrinsics, pose).astype(float)
        assert 10 * np.log10(255**2 / np.mean((picture - exact) ** 2)) > 24  # the codec halves the resolution of colour
        assert picture.std() > 30


def test_every_pixel_shows_something(filmed: tuple[Filmed, list[Array]]) -> None:
    film, _ = filmed
    for pose in hand_held(12):
        assert (film.scene.depth(film.intrinsics.scaled(60, 45), pose) > 0.5).all()


def test_path_is_rigid_smooth_and_has_parallax() -> None:
    poses = hand_held(48)
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), (48, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    assert (rotation[:, 2, 1] < 0).all()  # the camera's y axis points down: pictures are upright
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.25 and steps.min() > 0.02
    assert np.ptp(poses[:, 2, 3]) > 0.5
    assert not np.allclose(hand_held(48, seed=1), poses)


def test_same_seed_same_picture(filmed: tuple[Filmed, list[Array]]) -> None:
    film, _ = filmed
    pose = film.world_from_camera[3]
    assert np.array_equal(demo_scene(2).picture(film.intrinsics, pose), film.scene.picture(film.intrinsics, pose))
    assert np.array_equal(hand_held(5, 2), film.world_from_camera)


def test_stopping_leaves_no_file(filmed: tuple[Filmed, list[Array]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "demo_scene", lambda seed: filmed[0].scene)  # made once

    with pytest.raises(Interrupted):
        write_demo_video(tmp_path / "out.mp4", frames=3, size=(64, 48), progress=Stopping())
    assert list(tmp_path.iterdir()) == []


def test_unwritable_place_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_demo_video(tmp_path / "file" / "demo.mp4", frames=1, size=(64, 48))


def quadrants() -> Array:
    image = np.zeros((64, 64, 3), dtype=np.float32)
    image[:32, :32], image[:32, 32:], image[32:, :32], image[32:, 32:] = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)
    return image


def test_textures_are_upright_and_not_mirrored() -> None:
    """A wall seen from its front shows its texture as one looks at a picture: the first row up, the first column left."""
    scene = BakedScene([WALL], [quadrants()], [], EVEN)
    picture = scene.picture(CAMERA, FRONT)
    middle, _ = project(CAMERA, FRONT, np.array([[0.0, 0.0, 0.5]]))
    u, v = middle[0].astype(int)
    assert picture[v - 10, u - 10].argmax() == 0
    assert picture[v - 10, u + 10].argmax() == 1
    assert picture[v + 10, u - 10].argmax() == 2
    assert picture[v + 10, u + 10].min() > 200


def test_depth_lies_on_the_shapes_and_nothing_is_zero() -> None:
    ball, wall = upright(BALL, [0.3, -1.0, 0.6], [0.5] * 3, 1), upright(BOX, [0, 0.1, 0.4], [1, 0.1, 1], FRONT_ONLY)
    scene = BakedScene([ball, wall], [quadrants(), quadrants()], [0.0], EVEN)
    depth = scene.depth(CAMERA, FRONT)
    v, u = np.nonzero(depth)
    points = unproject(CAMERA, FRONT, np.stack([u + 0.5, v + 0.5], axis=1), depth[v, u])
    on_wall = np.abs(points[:, 1]) < 1e-4
    on_ball = np.abs(np.linalg.norm(points - ball.centre, axis=1) - 0.5) < 1e-4
    assert (on_wall | on_ball).all() and on_wall.sum() > 200 and on_ball.sum() > 200
    assert (depth == 0).any()
    assert (scene.picture(CAMERA, FRONT, samples=1)[depth == 0] == 0).all()


def test_a_ball_throws_a_shadow() -> None:
    """Behind the ball, as seen from the side, the wall is darker than without it; away from it nothing changes."""
    lamp = Light(lamp=(0.0, -4.0, 0.5), radius=0.05, lamp_strength=0.6, sky_strength=0.1)
    white = np.ones((600, 600, 3), dtype=np.float32)
    ball = upright(BALL, [0.0, -1.0, 0.5], [0.3] * 3, 1)
    aside = FRONT.copy()
    turn = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    aside[:3, :3] = turn @ FRONT[:3, :3]
    aside[0, 3] = 2.0
    alone = BakedScene([WALL], [white], [], lamp).picture(CAMERA, aside).astype(float)
    beside = BakedScene([WALL, ball], [white, white], [0.0], lamp).picture(CAMERA, aside).astype(float)
    (behind, far), _ = project(CAMERA, aside, np.array([[0.0, 0.0, 0.5], [-0.2, 0.0, -0.6]]))
    shadow, lit = (beside[int(v), int(u)].mean() / alone[int(v), int(u)].mean() for u, v in (behind, far))
    assert shadow < 0.65
    assert 0.95 < lit < 1.01


def test_gloss_moves_with_the_view() -> None:
    grey = np.full((64, 128, 3), 0.3, dtype=np.float32)
    lamp = Light(lamp=(0.0, -4.0, 3.0), lamp_strength=0.5, sky_strength=0.4)
    ball = upright(BALL, [0.0, 0.0, 0.5], [0.6] * 3, 0)
    point = np.array([[0.0, -0.6 * np.cos(0.3), 0.5 + 0.6 * np.sin(0.3)]])

    def seen(gloss: float, right: float) -> float:
        pose = FRONT.copy()
        pose[0, 3] = right
        (u, v), _ = project(CAMERA, pose, point)[0][0], None
        return float(BakedScene([ball], [grey], [gloss], lamp).picture(CAMERA, pose, samples=3)[int(v), int(u)].mean())

    assert abs(seen(0.0, 0.0) - seen(0.0, 1.0)) < 4
    assert seen(0.4, 0.0) - seen(0.4, 1.0) > 15


@pytest.mark.slow
def test_every_chosen_frame_is_registered_where_it_was_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "TEXELS", 150)  # as fine as pictures of this size show them
    monkeypatch.setattr(demo, "BOX_TEXELS", 350)
    film = demo.write_demo_video(tmp_path / "demo.mp4", frames=13, size=(384, 288))
    chosen = select_frames(read_video(tmp_path / "demo.mp4"), tmp_path, CaptureSettings())
    found = find_poses(chosen, tmp_path, PosesSettings(max_features=1024), seed=0, threads=1)
    assert len(chosen.frames) >= 11
    assert found.registered == found.total == len(chosen.frames)
    truth = np.stack([film.world_from_camera[int(name.rpartition("_")[2])] for name in found.names])  # frame_000012
    centres = found.world_from_camera[:, :3, 3]
    assert aligned_error(centres, truth[:, :3, 3]) < 0.007
    turns = np.einsum("nij,nkj->nik", truth[:, :3, :3], found.world_from_camera[:, :3, :3])  # from the one frame to the other: all the same
    apart = np.einsum("ij,nij->n", turns[len(turns) // 2], turns)
    assert np.rad2deg(np.arccos(np.clip((apart - 1) / 2, -1, 1))).max() < 0.5
    assert np.mean([camera.fx for camera in found.intrinsics]) == pytest.approx(film.intrinsics.fx, rel=0.02)
