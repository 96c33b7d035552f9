"""A ChArUco board and corners of markers, in drawn images whose cameras are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError
from fieldfuse.measures import parse_marker
from fieldfuse.poses.markers import Detector, refined, scale_by_markers
from tests.poses.textured import CAMERA, arc, render, texture, write_capture

LARGE = CAMERA.scaled(640, 480)


def before(image: np.ndarray, width: float = 1.2) -> list:
    """Planes with a square image of that width upright in the middle of the corner that the cameras look into."""
    wall = ((-4, -5, 4), (8, 0, 0), (0, 5, 0), texture(3))
    return [wall, ((-0.7, -1.3, 1.4), (width, 0, 0), (0, width, 0), image)]


def filmed(folder: Path, image: np.ndarray) -> Capture:
    poses = arc(6)
    capture = write_capture(folder, [render(pose, LARGE, before(image))[0] for pose in poses])
    frames = [replace(frame, intrinsics=LARGE, world_from_camera=pose) for frame, pose in zip(capture.frames, poses, strict=True)]
    return replace(capture, kind="transforms", frames=tuple(frames))


def test_a_board_gives_the_unit(tmp_path: Path) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((5, 5), 0.04, 0.03, dictionary).generateImage((800, 800), marginSize=0)
    found = scale_by_markers(filmed(tmp_path / "a", board), parse_marker("charuco:DICT_5X5_100:5x5:0.04:0.03"))
    assert found.metres == pytest.approx(0.2 / 1.2, rel=0.003) and 0 < found.error < 0.01 and "the board" in found.text
    with pytest.raises(InputError, match="has too few markers for a board"):
        Detector(parse_marker("charuco:DICT_4X4_50:40x40:0.04:0.03"))


def test_a_marker_that_is_there_twice_is_not_used(tmp_path: Path) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    one = np.pad(cv2.aruco.generateImageMarker(dictionary, 5, 300), 50, constant_values=255)
    capture = filmed(tmp_path / "a", np.block([[one, one], [one, one]]))
    with pytest.raises(InputError, match="none of the 6 images"):
        scale_by_markers(capture, parse_marker("DICT_4X4_50:0.05"))


@pytest.mark.parametrize("degrees", [0.0, 17.0, 40.0])
def test_corners_lie_where_light_is_half_way(degrees: float) -> None:
    """A square that is drawn large in linear light and made small, then written as sRGB."""
    fine, small, half = 16, 100, 20.3
    middle = np.array([50.2, 49.7])
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ turn.T  # pixel centres at +0.5
    v, u = (np.mgrid[0 : small * fine, 0 : small * fine] + 0.5) / fine
    inside = (np.abs((np.stack([u, v], axis=-1) - middle) @ turn) < half).all(axis=-1)
    light = cv2.resize(np.where(inside, 0.02, 0.8), (small, small), interpolation=cv2.INTER_AREA)
    grey = np.round(255 * (1.055 * light ** (1 / 2.4) - 0.055)).astype(np.uint8)
    found = refined(grey, corners - 0.5 + [[0.8, 0.5], [-0.6, 0.4], [-0.5, -0.8], [0.7, -0.3]])
    assert found is not None
    assert np.abs(found + 0.5 - corners).max() < 0.1
    assert np.linalg.norm(found - found.mean(axis=0), axis=1).mean() == pytest.approx(half * np.sqrt(2), rel=0.002)


def test_where_something_lies_on_an_edge_a_marker_takes_no_part(tmp_path: Path) -> None:
    """Unless no other images show it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = np.pad(cv2.aruco.generateImageMarker(dictionary, 5, 300), 50, constant_values=255)
    covered = image.copy()
    cv2.circle(covered, (200, 440), 110, 150, -1)  # over the lower edge, and part of its black border
    poses = arc(6)
    shots = [render(pose, LARGE, before(picture))[0] for pose, picture in zip(poses, [covered] * 4 + [image] * 2, strict=True)]
    grey = cv2.cvtColor(shots[0], cv2.COLOR_RGB2GRAY)
    assert not Detector(parse_marker("DICT_4X4_50:0.05")).corners(grey)[5][2]
    true = 0.05 / (1.2 * 300 / 400)
    for chosen, most in ((range(6), 0.005), (range(4), 0.1)):
        capture = write_capture(tmp_path / str(len(chosen)), [shots[number] for number in chosen])
        frames = [replace(frame, intrinsics=LARGE, world_from_camera=poses[n]) for frame, n in zip(capture.frames, chosen, strict=True)]
        found = scale_by_markers(replace(capture, kind="transforms", frames=tuple(frames)), parse_marker("DICT_4X4_50:0.05"))
        assert found.metres == pytest.approx(true, rel=most)
        assert f"in {2 if len(chosen) == 6 else 4} images" in found.text
