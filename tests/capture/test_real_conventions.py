"""Conventions on real captures: epipolar residuals of feature matches, and depth reprojected between frames."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import cv2
import numpy as np
import pytest

from fieldfuse.camera import OPENCV, Array, Intrinsics, invert
from fieldfuse.capture import open_capture
from fieldfuse.capture.types import Capture, Frame
from tests.capture.made import colour_difference, reprojection
from tests.conftest import shared_data

FLIPS = {"OpenGL axes": np.diag([1.0, -1, -1, 1]), "half turn": np.diag([-1.0, -1, 1, 1]), "quarter turn": np.array(
    [[0, 1.0, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])}  # fmt: skip


def matches(first: Frame, second: Frame) -> tuple[Array, Array]:
    """(M, 2) pixels, centres at +0.5, of SIFT features that pass the ratio test both ways."""
    sift = cv2.SIFT.create(nfeatures=1500)
    found = []
    for frame in (first, second):
        picture = cv2.imread(str(frame.image), cv2.IMREAD_UNCHANGED)
        if picture.shape[2] == 4:
            picture = (picture[..., :3] * (picture[..., 3:] / 255.0) + 255.0 - picture[..., 3:]).astype(np.uint8)
        points, descriptors = sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), None)
        # OpenCV's first pixel has its middle at 0.
        found.append((np.array([point.pt for point in points]) + 0.5, descriptors))
    (here, a), (there, b) = found
    pairs = []
    for left, right in ((a, b), (b, a)):
        best = cv2.BFMatcher().knnMatch(left, right, k=2)
        pairs.append({(m.queryIdx, m.trainIdx) for m, n in best if m.distance < 0.75 * n.distance})
    mutual = sorted(pairs[0] & {(i, j) for j, i in pairs[1]})
    assert len(mutual) >= 40
    return here[[i for i, _ in mutual]], there[[j for _, j in mutual]]


def ideal(camera: Intrinsics, pixels: Array) -> Array:
    """(M, 3) rays with z = 1, the lens removed."""
    k = camera.matrix()
    lens = np.array(camera.distortion) if camera.lens == OPENCV else None
    plane = cv2.undistortPoints(pixels[:, None], k, lens).reshape(-1, 2)
    return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)


def epipolar_distance(first: Frame, second: Frame, found: tuple[Array, Array], turn: Array) -> float:
    """Median Sampson distance in pixels, with both cameras turned by `turn` about their own centre."""
    assert first.intrinsics is not None
    assert second.intrinsics is not None
    a, b = ideal(first.intrinsics, found[0]), ideal(second.intrinsics, found[1])
    second_from_first = invert(second.world_from_camera @ turn) @ first.world_from_camera @ turn
    x, y, z = second_from_first[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ second_from_first[:3, :3]
    lines, back = a @ essential.T, b @ essential
    residual = np.abs((b * lines).sum(1)) / np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    return float(np.median(residual) * first.intrinsics.fx)


@pytest.mark.parametrize(
    ("name", "pairs"),
    [
        ("fox_540x960", ((0, 4), (20, 22), (40, 42))),
        ("gum_360x640", ((0, 3), (80, 83))),
        ("lego_400", ((0, 36), (52, 86), (60, 119))),
        ("llff_fern_8", ((0, 3), (8, 12))),
        ("dtu_scan24_384", ((20, 21), (30, 31), (40, 42))),
    ],
)
def test_matched_features_lie_on_their_epipolar_lines(name: str, pairs: tuple[tuple[int, int], ...]) -> None:
    capture = open_capture(shared_data(name))
    for i, j in pairs:
        first, second = capture.frames[i], capture.frames[j]
        found = matches(first, second)
        right = epipolar_distance(first, second, found, np.eye(4))
        assert right < 0.5, (i, j)
        for what, turn in FLIPS.items():
            assert epipolar_distance(first, second, found, turn) > 5 * right, (i, j, what)


def test_the_crop_of_the_small_dtu_pictures_is_the_right_one() -> None:
    capture = open_capture(shared_data("dtu_scan24_384"))
    first, second = capture.frames[20], capture.frames[21]
    found = matches(first, second)

    def distance(shift: float) -> float:
        moved = [replace(frame, intrinsics=replace(frame.intrinsics, cx=frame.intrinsics.cx + shift)) for frame in (first, second)]
        return epipolar_distance(*moved, found, np.eye(4))

    assert distance(0) < 0.15
    assert min(distance(-4), distance(4)) > 2 * distance(0)
    assert distance(200 * 0.32) > 20 * distance(0), "the principal point of the uncropped image"


def stored_depth(capture: Capture, frame: Frame) -> Array:
    depth = cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED).astype(np.float64)
    depth[depth == 65535] = 0
    return depth / capture.depth_scale


def depth_error(capture: Capture, indices: tuple[int, ...], camera: Intrinsics | None = None, turn: Array | None = None) -> float:
    """Mean relative difference (each at most 0.1) between depth seen from one frame and stored in another, over all pairs."""
    errors = []
    frames = [capture.frames[index] for index in indices]
    views = [
        (
            camera or frame.depth_intrinsics or frame.intrinsics,
            frame.world_from_camera @ (np.eye(4) if turn is None else turn),
            stored_depth(capture, frame),
        )
        for frame in frames
    ]
    for i, j in permutations(range(len(views)), 2):
        _, relative = reprojection(views[i], views[j], step=6)
        errors.append(np.minimum(np.abs(relative), 0.1))
    return float(np.concatenate(errors).mean())


def colour_error(capture: Capture, indices: tuple[int, ...], focal: float | None = None) -> float:
    """Mean over pairs of the difference in colour at points taken from the depth."""
    frames = [capture.frames[index] for index in indices]
    views = [(frame.depth_intrinsics or frame.intrinsics, frame.world_from_camera, stored_depth(capture, frame)) for frame in frames]
    pictures = []
    for frame in frames:
        grey = cv2.cvtColor(cv2.imread(str(frame.image)), cv2.COLOR_BGR2GRAY)
        camera = frame.intrinsics if focal is None else replace(frame.intrinsics, fx=focal, fy=focal)
        pictures.append((camera, frame.world_from_camera, cv2.GaussianBlur(grey, (0, 0), 1.5)[..., None]))
    differences = []
    for i, j in permutations(range(len(views)), 2):
        points, relative = reprojection(views[i], views[j], step=6)
        differences.append(colour_difference(points[np.abs(relative) < 0.03], [pictures[i], pictures[j]]))
    return float(np.mean(differences))


DEPTH_SETS = {"redkitchen": (0, 4, 10, 20), "redwood_livingroom1": (0, 12, 24, 60), "scannet_sample_11": (0, 3, 6, 9)}


@pytest.mark.parametrize("name", DEPTH_SETS)
def test_depth_agrees_between_frames_and_not_with_another_convention(name: str) -> None:
    capture = open_capture(shared_data(name))
    indices = DEPTH_SETS[name]
    right = depth_error(capture, indices)
    assert right < 0.015
    for what, turn in FLIPS.items():
        assert depth_error(capture, indices, turn=turn) > 2.5 * right, what
    metres_as_millimetres = replace(capture, depth_scale=1.0)
    assert depth_error(metres_as_millimetres, indices) > 2 * right


def test_the_two_cameras_of_seven_scenes_have_their_own_focal_length() -> None:
    capture = open_capture(shared_data("redkitchen"))
    indices = DEPTH_SETS["redkitchen"]
    depth_camera, colour_camera = capture.frames[0].depth_intrinsics, capture.frames[0].intrinsics
    assert depth_camera is not None
    assert colour_camera is not None
    assert depth_error(capture, indices) < 0.75 * depth_error(capture, indices, camera=colour_camera)
    assert colour_error(capture, indices) < 0.85 * colour_error(capture, indices, focal=depth_camera.fx)


def test_the_usual_cameras_of_scannet_fit_a_sample_without_any() -> None:
    capture = open_capture(shared_data("scannet_sample_11"))
    assert capture.kind == "scannet"
    assert len(capture.warnings) == 2
    indices = DEPTH_SETS["scannet_sample_11"]
    colour, depth = capture.frames[0].intrinsics, capture.frames[0].depth_intrinsics
    assert colour is not None
    assert depth is not None
    for factor in (0.92, 1.08):
        other = replace(depth, fx=depth.fx * factor, fy=depth.fy * factor)
        assert depth_error(capture, indices) < 0.95 * depth_error(capture, indices, camera=other)
        assert colour_error(capture, indices) < 0.9 * colour_error(capture, indices, focal=colour.fx * factor)
