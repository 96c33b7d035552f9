"""Metres for poses that were found from pictures, when there are depth maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Similarity, pixel_grid, unproject
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.poses.result import SFM, PoseResult
from fieldfuse.poses.sensor import scale_to_depth
from tests.poses.textured import CAMERA, arc, render


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> tuple[Capture, PoseResult]:
    """Five views with depth in metres, and poses and points of them in a frame a seventh as large."""
    folder: Path = tmp_path_factory.mktemp("depth")
    frames, points, poses = [], [], arc(5)
    for n, pose in enumerate(poses):
        _, depth = render(pose)
        cv2.imwrite(str(folder / f"{n}.png"), np.round(depth * 1000).astype(np.uint16))
        frames.append(Frame(str(n), folder / f"{n}.png", depth=folder / f"{n}.png", depth_intrinsics=CAMERA))
        pick = np.random.default_rng(n).choice(320 * 240, 60, replace=False)
        z = depth.ravel()[pick].astype(np.float64)
        points.append(unproject(CAMERA, pose, pixel_grid(320, 240)[pick][z > 0], z[z > 0]))
    small = Similarity(1 / 7, np.eye(3), np.zeros(3))
    result = PoseResult(
        SFM, 5, 5, [str(n) for n in range(5)], [CAMERA] * 5, small.poses(poses), models=[5], points=small.points(np.concatenate(points))
    )
    return Capture("tum", folder, tuple(frames), metric=True), result


def test_scale_comes_from_the_depth_maps(measured):
    capture, result = measured
    scaled = scale_to_depth(result, capture)
    np.testing.assert_allclose(scaled.world_from_camera[:, :3, 3], arc(5)[:, :3, 3], rtol=0.01)
    np.testing.assert_allclose(scaled.points, 7 * result.points, rtol=0.01)
    assert scaled.metric and not scaled.warnings


def test_depth_that_disagrees_is_told_and_not_used(measured):
    capture, result = measured
    # As if the depth maps belonged to other pictures.
    shuffled = capture.with_frames([replace(f, depth=capture.frames[(n * 2 + 1) % 5].depth) for n, f in enumerate(capture.frames)])
    torn = replace(result, points=result.points * np.random.default_rng(0).uniform(0.3, 3, (len(result.points), 1)))
    told = scale_to_depth(torn, shuffled)
    assert "disagree on scale" in told.warnings[0] and not told.metric
    np.testing.assert_array_equal(told.world_from_camera, result.world_from_camera)


def test_too_few_points_are_told(measured):
    capture, result = measured
    told = scale_to_depth(replace(result, points=result.points[:5]), capture)
    assert "too few points" in told.warnings[0] and not told.metric
