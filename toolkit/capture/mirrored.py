"""Poses that all mirror space: one camera axis, all of them, or one of the world's points the wrong way.

The matrices do not show which. Matches between images do: only for the right axes they lie on their epipolar lines.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, unproject
from fieldfuse.capture.images import read_image, spread
from fieldfuse.errors import InputError

IMAGES, SIDE, FEATURES = 10, 640, 3000
NEAR = 0.005  # of the focal length, from the epipolar line: about three pixels
RATIO = 0.8  # of the distances of the nearest and the second descriptor
MIN_MATCHES, CLEAR = 40, 2.5  # matches on their lines, and how many times as many as for any other axes
AXES = {
    "all camera axes": np.diag([-1.0, -1.0, -1.0, 1.0]),
    "the cameras' x axis": np.diag([-1.0, 1.0, 1.0, 1.0]),
    "the cameras' y axis": np.diag([1.0, -1.0, 1.0, 1.0]),
    "the cameras' z axis": np.diag([1.0, 1.0, -1.0, 1.0]),
}
WORLD, OPPOSITE = np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, -1.0, 1.0])


def mirrors(pose: Array) -> bool:
    """Whether a (4, 4) matrix of finite numbers turns right-handed axes into left-handed ones."""
    return bool(np.isfinite(pose).all()) and np.abs(pose).max() < 1e12 and bool(np.linalg.det(pose[:3, :3]) < 0)


def unmirrored(poses: Sequence[Array], images: Sequence[Path], cameras: Sequence[Intrinsics]) -> tuple[list[Array], str] | None:
    """world_from_camera (4, 4) each, without the mirror, and a remark on what was turned; None where the images do not decide it.

    Args:
        poses: world_from_camera in OpenCV axes, all of them mirrored.
    """
    seen = [(poses[index], *_features(images[index], cameras[index])) for index in spread(range(len(poses)), IMAGES)]
    votes, in_front = Counter(dict.fromkeys(AXES, 0)), Counter[str]()
    for (one, rays, some), (two, other_rays, others) in itertools.combinations(seen, 2):
        matches = [] if min(len(some), len(others)) < 2 else cv2.BFMatcher().knnMatch(some, others, k=2)
        pairs = [near for near, second in matches if near.distance < RATIO * second.distance]
        matched = rays[[pair.queryIdx for pair in pairs]], other_rays[[pair.trainIdx for pair in pairs]]
        for name, turn in AXES.items():
            on_line, before = _agreement(one @ turn, two @ turn, *matched)
            votes[name] += int(on_line.sum())
            in_front[name] += int((on_line & before).sum())
    (best, most), (_, second) = votes.most_common(2)
    if most < MIN_MATCHES or most < CLEAR * second:
        return None
    if 2 * in_front[best] >= most:
        remark = f"all poses mirror space; {best} were turned round, as matches between the images show"
        return [pose @ AXES[best] for pose in poses], remark
    remark = "all poses mirror space; the world's z axis was turned round, as matches between the images show: results are in that frame"
    return [WORLD @ pose @ AXES[best] @ OPPOSITE for pose in poses], remark


def _features(path: Path, camera: Intrinsics) -> tuple[Array, Array]:
    """Rays (N, 3) in camera axes with z = 1, and descriptors (N, 128); none of an image that cannot be read."""
    try:
        grey = cv2.cvtColor(np.ascontiguousarray(read_image(path)[0][..., :3]), cv2.COLOR_RGB2GRAY)
    except InputError:
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    factor = min(1.0, SIDE / max(grey.shape))
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(small, None)
    if descriptors is None:
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    pixels = np.array([point.pt for point in points]) + 0.5
    return unproject(camera.scaled(small.shape[1], small.shape[0]), np.eye(4), pixels, np.ones(len(pixels))), np.asarray(descriptors)


def _agreement(one: Array, two: Array, rays: Array, others: Array) -> tuple[Array, Array]:
    """(N,) bool whether rays (N, 3) of two cameras (4, 4) meet within NEAR, and whether they do so in front of both."""
    first, second = rays @ one[:3, :3].T, others @ two[:3, :3].T
    between = two[:3, 3] - one[:3, 3]
    length = float(np.linalg.norm(between))
    if not len(rays) or length == 0:
        return np.zeros(len(rays), bool), np.zeros(len(rays), bool)
    line = np.cross(first, between / length) @ two[:3, :3]  # of the plane through both cameras and the first ray, in the second image
    off = np.abs((line * others).sum(axis=1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
    # The nearest points of the rays: depth along either.
    a, b, c = (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)
    d, e = first @ between, second @ between
    apart = np.maximum(a * c - b * b, 1e-12)
    return off < NEAR, ((c * d - b * e) / apart > 0) & ((b * d - a * e) / apart > 0)
