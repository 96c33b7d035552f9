"""Poses that all mirror space: one camera axis, all of them, or one of the world's points the wrong way.

Which of these it is cannot be seen in the matrices. It is measured on matches between images: only for the right axes they lie on their
epipolar lines.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, unproject
from fieldfuse.capture.images import read_picture
from fieldfuse.errors import InputError

IMAGES, SIDE, FEATURES = 10, 640, 3000
NEAR = 0.005  # of the focal length, from the epipolar line: about three pixels
RATIO = 0.8  # of the distances of the nearest and the second descriptor
MIN_MATCHES, CLEAR = 40, 2.5  # matches on their lines, and how many times as many as for any other axes
AXES = {
    "all camera axes": np.diag([-1.0, -1.0, -1.0]),
    "the cameras' x axis": np.diag([-1.0, 1.0, 1.0]),
    "the cameras' y axis": np.diag([1.0, -1.0, 1.0]),
    "the cameras' z axis": np.diag([1.0, 1.0, -1.0]),
}
WORLD = np.diag([1.0, 1.0, -1.0, 1.0])


def mirrors(pose: Array) -> bool:
    """Whether a (4, 4) matrix of finite numbers turns right-handed axes into left-handed ones."""
    return bool(np.isfinite(pose).all()) and np.abs(pose).max() < 1e12 and bool(np.linalg.det(pose[:3, :3]) < 0)


def unmirrored(poses: Sequence[Array], images: Sequence[Path], cameras: Sequence[Intrinsics]) -> tuple[list[Array], str] | None:
    """world_from_camera (4, 4) each, without the mirror, and a remark on what was turned; None where the images do not say it clearly.

    Args:
        poses: world_from_camera in OpenCV axes, all of them mirrored.
    """
    chosen = np.unique(np.linspace(0, len(poses) - 1, IMAGES).round()).astype(int)
    seen = [_features(images[index], cameras[index]) for index in chosen]
    votes = dict.fromkeys(AXES, 0)
    before = dict.fromkeys(AXES, 0)  # votes with the match in front of both cameras
    for (i, one), (j, two) in itertools.combinations(zip(chosen, seen, strict=True), 2):
        rays = _matched(one, two)
        for name, turn in AXES.items():
            rotations = poses[i][:3, :3] @ turn, poses[j][:3, :3] @ turn
            on_line, in_front = _agreement(rotations, poses[j][:3, 3] - poses[i][:3, 3], *rays)
            votes[name] += int(on_line.sum())
            before[name] += int((on_line & in_front).sum())
    best, second = sorted(votes, key=lambda name: -votes[name])[:2]
    if votes[best] < MIN_MATCHES or votes[best] < CLEAR * votes[second]:
        return None
    turned = np.eye(4)
    turned[:3, :3] = AXES[best]
    if 2 * before[best] >= votes[best]:
        return [pose @ turned for pose in poses], f"all poses mirror space; {best} were turned round, as matches between the images want it"
    turned[:3, :3] *= -1
    remark = "all poses mirror space; the world's z axis was turned round, as matches between the images want it: results are in that frame"
    return [WORLD @ pose @ turned for pose in poses], remark


def _features(path: Path, camera: Intrinsics) -> tuple[Array, Array]:
    """Rays (N, 3) in camera axes with z = 1, and descriptors (N, 128); none of an image that cannot be read."""
    try:
        picture = read_picture(path)[0]
    except InputError:
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    grey = cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2GRAY)
    factor = min(1.0, SIDE / max(grey.shape))
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(small, None)
    if descriptors is None:
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    sized = camera.scaled(small.shape[1], small.shape[0])
    pixels = np.array([point.pt for point in points]) + 0.5
    return unproject(sized, np.eye(4), pixels, np.ones(len(pixels))), np.asarray(descriptors)


def _matched(one: tuple[Array, Array], two: tuple[Array, Array]) -> tuple[Array, Array]:
    if len(one[1]) < 2 or len(two[1]) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3))
    pairs = [pair for pair in cv2.BFMatcher().knnMatch(one[1], two[1], k=2) if pair[0].distance < RATIO * pair[1].distance]
    return one[0][[pair[0].queryIdx for pair in pairs]], two[0][[pair[0].trainIdx for pair in pairs]]


def _agreement(rotations: tuple[Array, Array], between: Array, one: Array, two: Array) -> tuple[Array, Array]:
    """(N,) whether rays of two cameras meet within NEAR, and whether they do so in front of both.

    Args:
        rotations: world from camera (3, 3) of either.
        between: (3,) from the first camera to the second, in the world.
    """
    first, second = one @ rotations[0].T, two @ rotations[1].T
    length = float(np.linalg.norm(between))
    if not len(one) or length == 0:
        return np.zeros(len(one), bool), np.zeros(len(one), bool)
    normal = np.cross(first, between / length)  # of the plane through both cameras and the first ray
    in_second = normal @ rotations[1]  # its line in the second image at z = 1
    off = np.abs((in_second * two).sum(axis=1)) / np.maximum(np.linalg.norm(in_second[:, :2], axis=1), 1e-12)
    # The nearest points of the rays: depth along either.
    a, b, c = (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)
    d, e = first @ between, second @ between
    apart = np.maximum(a * c - b * b, 1e-12)
    return off < NEAR, ((c * d - b * e) / apart > 0) & ((b * d - a * e) / apart > 0)
