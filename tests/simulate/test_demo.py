"""The demo's video: what it shows is what the truth says, and its path gives parallax as a hand would."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, project, unproject
from fieldfuse.errors import Interrupted, OutputError
from fieldfuse.progress import Progress
from fieldfuse.simulate import demo
from fieldfuse.simulate.demo import Filmed, demo_scene, hand_held, write_demo_video


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


def test_points_look_alike_from_two_views(filmed: tuple[Filmed, list[Array]]) -> None:
    """Points carried from one view to the next by true depth and poses show the same colour."""
    film, _ = filmed
    first, second = film.world_from_camera[1], film.world_from_camera[2]
    a, b = (film.scene.picture(film.intrinsics, pose).astype(float) for pose in (first, second))
    depth = film.scene.depth(film.intrinsics, first)
    v, u = np.mgrid[4:180:5, 4:240:5].reshape(2, -1)
    points = unproject(film.intrinsics, first, np.stack([u + 0.5, v + 0.5], axis=1), depth[v, u])
    pixels, away = project(film.intrinsics, second, points)
    x, y = np.floor(pixels).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < 240) & (y < 180)
    other = film.scene.depth(film.intrinsics, second)
    visible = inside.copy()
    visible[inside] = np.abs(other[y[inside], x[inside]] - away[inside]) < 0.02
    assert visible.sum() > 300
    difference = np.abs(a[v, u] - b[y.clip(0, 179), x.clip(0, 239)]).mean(1)
    assert np.median(difference[visible]) < 0.5 * np.median(np.abs(a[v, u] - np.roll(b, 20, axis=1)[v, u]).mean(1))


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

    class Stopped(Progress):
        def stopping(self) -> bool:
            return True

    with pytest.raises(Interrupted):
        write_demo_video(tmp_path / "out.mp4", frames=3, size=(64, 48), progress=Stopped())
    assert list(tmp_path.iterdir()) == []


def test_unwritable_place_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_demo_video(tmp_path / "file" / "demo.mp4", frames=1, size=(64, 48))
