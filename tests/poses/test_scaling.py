"""Metres by markers, measured distances and GPS, on a simulated capture whose poses are given in another frame, as structure from motion
finds them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Similarity, project, unproject
from fieldfuse.capture import open_capture
from fieldfuse.capture.types import Capture
from fieldfuse.config import PosesSettings
from fieldfuse.errors import InputError
from fieldfuse.georeference import Georeference
from fieldfuse.poses.gps import Placed, fit_gps, similarity
from fieldfuse.poses.result import PoseResult, given_poses
from fieldfuse.poses.scaling import Scaling, find_scaling, wanted
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate

FOUND = Similarity(0.37, Rotation.from_euler("xyz", [20, 50, -70], degrees=True).as_matrix(), np.array([3.0, -2.0, 1.0]))
SCENE = {
    "scene": "table",
    "seed": 3,
    "camera": {"width": 480, "height": 360, "fov": 42},
    "path": {"kind": "orbit", "frames": 12, "fps": 5, "speed": 0.7},
    "markers": [
        {"at": [0.25, 0.1, -0.118], "side": 0.12, "number": 3},
        {"at": [-0.25, -0.1, -0.118], "side": 0.12, "number": 7, "turn": 30},
    ],
    "gps": {"noise": 0.002, "noise_up": 0.002},
}


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Capture, PoseResult]]:
    """The capture, without its poses, and these in another frame."""
    root = tmp_path_factory.mktemp("survey") / "capture"
    simulate(scene_file(SCENE, "the test"), root)
    capture = open_capture(root)
    given = given_poses(capture)
    poses = replace(given, source="sfm", metric=False, world_from_camera=FOUND.poses(given.world_from_camera))
    yield root, replace(capture, metric=False, frames=tuple(replace(f, world_from_camera=None) for f in capture.frames)), poses


def off(found: Scaling) -> float:
    """Relative error of the scale."""
    return abs(found.move.scale * FOUND.scale - 1)


def test_by_markers_within_half_a_percent(filmed: tuple[Path, Capture, PoseResult]) -> None:
    _, capture, poses = filmed
    found = find_scaling(capture, poses, PosesSettings(marker="DICT_4X4_50:0.12", gps="off"))
    assert off(found) < 0.005 and found.metric and found.facts is not None
    assert off(found) < 4 * found.facts["error"] < 0.03
    with pytest.raises(InputError, match=r"none of the 12 images .* shows a marker of DICT_5X5_50"):
        find_scaling(capture, poses, PosesSettings(marker="DICT_5X5_50:0.12", gps="off"))


def truth(root: Path, poses: PoseResult, index: int, pixel: Array) -> Array:
    """Where a pixel's surface is, metres."""
    depth = load_file(root / f"ground_truth/frames/{index:06d}.safetensors")["depth"]
    pose = FOUND.inverse().poses(poses.world_from_camera[index])
    return unproject(poses.intrinsics[index], pose, pixel[None], np.array([depth[int(pixel[1]), int(pixel[0])]]))[0]


def textured(root: Path, index: int) -> list[Array]:
    """Pixels that show corners, on surfaces without an edge beside them."""
    image = cv2.imread(str(root / f"images/{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
    depth = load_file(root / f"ground_truth/frames/{index:06d}.safetensors")["depth"]
    places = cv2.goodFeaturesToTrack(image[60:-60, 60:-60], 60, 0.05, 30).reshape(-1, 2) + 60.5
    even = [np.ptp(depth[int(y) - 12 : int(y) + 13, int(x) - 12 : int(x) + 13]) < 0.1 * depth[int(y), int(x)] for x, y in places]
    return [place for place, good in zip(places, even, strict=True) if good]


def test_by_two_clicked_points_within_a_percent(filmed: tuple[Path, Capture, PoseResult]) -> None:
    """A point in each of two images, found in others by what they show there."""
    root, capture, poses = filmed
    a, b = textured(root, 4)[0], textured(root, 8)[-1]
    metres = float(np.linalg.norm(truth(root, poses, 4, a) - truth(root, poses, 8, b)))
    found = find_scaling(capture, poses, PosesSettings(scale=f"000004:{a[0]},{a[1]} 000008.png:{b[0]},{b[1]} = {metres}", gps="off"))
    assert metres > 0.2 and off(found) < 0.01
    assert found.facts is not None and 0 < found.facts["error"] < 0.03


def test_by_points_marked_in_several_images(filmed: tuple[Path, Capture, PoseResult]) -> None:
    root, capture, poses = filmed
    back = FOUND.inverse()
    ends = [truth(root, poses, 4, textured(root, 4)[at]) for at in (0, -1)]
    marks = [
        " ".join(
            f"{name}:{pixel[0]:.1f},{pixel[1]:.1f}"
            for name, camera, pose in list(zip(poses.names, poses.intrinsics, poses.world_from_camera, strict=True))[2:8:2]
            for pixel in project(camera, back.poses(pose), end[None])[0]
        )
        for end in ends
    ]
    metres = float(np.linalg.norm(ends[0] - ends[1]))
    found = find_scaling(capture, poses, PosesSettings(scale=f"{marks[0]} to {marks[1]} = {100 * metres} cm", gps="off"))
    assert off(found) < 0.005
    wrong = f"{marks[0].split()[0]} {marks[1].split()[1]} to {marks[1]} = 1"
    with pytest.raises(InputError, match="do not meet in one place"):
        find_scaling(capture, poses, PosesSettings(scale=wrong, gps="off"))


@pytest.mark.parametrize(
    ("scale", "why"),
    [
        ("nowhere:1,2 000001:3,4 = 1", "no image 'nowhere'"),
        ("000001:900,2 000001:3,4 = 1", "lies outside of 000001"),
        ("000001:1,2 000001:3,4 = 1", "not found in other images"),
    ],
)
def test_marks_that_cannot_be_used(filmed: tuple[Path, Capture, PoseResult], scale: str, why: str) -> None:
    _, capture, poses = filmed
    with pytest.raises(InputError, match=why):
        find_scaling(capture, poses, PosesSettings(scale=scale, gps="off"))


def test_by_gps_within_a_percent_and_on_earth(filmed: tuple[Path, Capture, PoseResult]) -> None:
    _, capture, poses = filmed
    assert wanted(capture, PosesSettings(), estimated=True) and not wanted(capture, PosesSettings(gps="off"), estimated=True)
    assert not wanted(capture, PosesSettings(), estimated=False)
    found = find_scaling(capture, poses, PosesSettings())
    assert off(found) < 0.01 and found.georeference is not None and found.facts is not None and found.facts["source"] == "gps"
    _, placed = found.apply(capture, poses)
    assert placed.metric and placed.up == (0.0, 0.0, 1.0) and placed.georeference is not None
    here = placed.georeference
    expected = FOUND.inverse().points(poses.world_from_camera[:, :3, 3])  # metres east, north, up of 47° N, 8° E
    places = here.to_geographic(placed.world_from_camera[:, :3, 3])
    metres = ((places - [47.0, 8.0, 400.0]) * [111_170, 76_060, 1])[:, [1, 0, 2]]
    assert np.abs(metres - expected).max() < 0.02
    first = placed.apply(capture).frames[0].world_from_camera
    assert first is not None and np.allclose(first[:3, :3], FOUND.rotation.T @ poses.world_from_camera[0, :3, :3], atol=0.02)
    assert Scaling.from_dict(found.to_dict()).to_dict() == found.to_dict()


def test_a_marker_gives_lengths_and_gps_the_place(filmed: tuple[Path, Capture, PoseResult]) -> None:
    _, capture, poses = filmed
    found = find_scaling(capture, poses, PosesSettings(marker="DICT_4X4_50:0.12"))
    assert off(found) < 0.005 and found.georeference is not None and found.warnings == ()
    twice = find_scaling(capture, poses, PosesSettings(marker="DICT_4X4_50:0.24"))
    assert abs(twice.move.scale * FOUND.scale - 2) < 0.01 and "times those by GPS" in twice.warnings[0]


def test_given_poses_are_scaled_with_their_depth(filmed: tuple[Path, Capture, PoseResult]) -> None:
    _, capture, poses = filmed
    frames = tuple(replace(frame, world_from_camera=pose) for frame, pose in zip(capture.frames, poses.world_from_camera, strict=True))
    given, result = replace(capture, frames=frames, depth_scale=1000.0), replace(poses, source="given")
    found = find_scaling(given, result, PosesSettings(marker="DICT_4X4_50:0.12"))
    assert "all lengths were multiplied by 2.7" in found.warnings[0] and found.georeference is None
    scaled, placed = found.apply(given, result)
    factor = found.move.scale
    assert scaled.metric and placed.metric and scaled.depth_scale == pytest.approx(1000 / factor)
    assert np.allclose(placed.world_from_camera[:, :3, 3], factor * poses.world_from_camera[:, :3, 3])
    assert np.allclose(scaled.frames[0].world_from_camera, placed.world_from_camera[0])


def test_a_source_with_a_place_keeps_it(filmed: tuple[Path, Capture, PoseResult]) -> None:
    _, capture, poses = filmed
    result = replace(poses, source="given", metric=True)
    for value in ([47.0, 8.0, 400.0], {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}):
        found = find_scaling(replace(capture, extra={"reference_lla": value}), result, PosesSettings())
        assert found.georeference is not None and found.georeference.origin.tolist() == [47.0, 8.0, 400.0] and found.move.scale == 1.0
        assert found.apply(replace(capture, up=None), result)[0].up == (0.0, 0.0, 1.0)
    broken = find_scaling(replace(capture, extra={"reference_lla": ["a", None]}), result, PosesSettings())
    assert broken.georeference is None


# --------------------------------------------------------------------------------------------------- GPS alone


def flight(noise: float, extent: float = 60.0, line: bool = False, count: int = 20) -> tuple[Array, Array]:
    """Camera centres of a drone in a frame of their own, and their GPS with noise, some of it far off."""
    rng = np.random.default_rng(5)
    x = np.linspace(-0.5, 0.5, count) * extent
    y = 0 * x if line else np.tile([-0.3, 0.3, 0.1, -0.1], -(-count // 4))[:count] * extent
    true = np.stack([x, y, 50 + rng.normal(0, 0.3, count)], axis=1)
    seen = true + rng.normal(0, noise, (count, 3))
    seen[3] += [200, 0, 0]
    places = Georeference(46.8, -92.0, 200.0).to_geographic(seen)
    places[5] = np.nan
    return FOUND.points(true), places


def test_gps_of_a_flight() -> None:
    centres, places = flight(0.5)
    found = fit_gps(centres, places)
    assert isinstance(found, Placed) and found.used == 18
    assert abs(found.enu_from_centres.scale * FOUND.scale - 1) < 0.01 and found.scale_error < 0.01 and 0.4 < found.error < 1.6


@pytest.mark.parametrize(
    ("noise", "extent", "line", "why"),
    [(3.0, 2.0, False, "within"), (0.5, 60.0, True, "in a line"), (1e-3, 0.0, False, "the places are|off by|do not fit")],
)
def test_gps_that_is_of_no_use(noise: float, extent: float, line: bool, why: str) -> None:
    centres, places = flight(noise, extent, line)
    found = fit_gps(centres, places)
    assert isinstance(found, str) and re.search(why, found)


def test_gps_of_too_few_images() -> None:
    centres, places = flight(0.5)
    places[4:] = np.nan
    assert fit_gps(centres, places) == "4 images have a place with altitude"
    centres, places = flight(0.5)
    places[:, 2] = np.nan
    assert fit_gps(centres, places) == "0 images have a place with altitude (19 one without)"


def test_similarities_are_exact_and_never_mirror() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10, 3))
    made = similarity(points, FOUND.points(points))
    assert made.scale == pytest.approx(FOUND.scale) and np.allclose(made.rotation, FOUND.rotation)
    assert np.allclose(made.translation, FOUND.translation)
    assert np.linalg.det(similarity(points, points * [1, 1, -1]).rotation) == pytest.approx(1)
