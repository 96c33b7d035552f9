"""Depth maps carried to another place, against surfaces whose depth from there is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import FISHEYE, OPENCV, Array, Intrinsics, invert
from fieldfuse.capture.depth_reprojection import _rays, reprojected
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.types import Capture, Frame

CAMERA = Intrinsics(96, 72, 80.0, 82.0, 47.0, 37.5)
LENSES = {
    "pinhole": CAMERA,
    "opencv": replace(CAMERA, lens=OPENCV, distortion=(-0.15, 0.04, 0.002, -0.001)),
    "fisheye": replace(CAMERA, lens=FISHEYE, distortion=(0.05, -0.02, 0.0, 0.0)),
}


def pose(turn: tuple[float, float, float], move: tuple[float, float, float]) -> Array:
    out = np.eye(4)
    out[:3, :3] = cv2.Rodrigues(np.array(turn, dtype=np.float64))[0]
    out[:3, 3] = move
    return out


ASIDE = pose((0.02, -0.03, 0.015), (0.05, -0.01, 0.02))


def plane(camera: Intrinsics, normal: Array, offset: float) -> Array:
    """(H, W) depth at which the pixels of a camera at the origin see the plane normal · x = offset."""
    x, y = _rays(camera)
    return (offset / (normal[0] * x + normal[1] * y + normal[2])).astype(np.float32)


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_a_map_stays_as_it_is_where_nothing_moves(lens: str) -> None:
    depth = plane(LENSES[lens], np.array([0.2, -0.1, 1.0]), 2.0)
    depth[10:20, 30:50] = 0
    np.testing.assert_allclose(reprojected(depth, LENSES[lens], np.eye(4)), depth, rtol=1e-6)


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_a_plane_is_where_it_is_from_the_other_place(lens: str) -> None:
    camera, normal = LENSES[lens], np.array([0.2, -0.1, 1.0])
    got = reprojected(plane(camera, normal, 2.0), camera, ASIDE)
    moved = ASIDE[:3, :3] @ normal  # n · x = o with x = Rᵀ (y − t)
    want = plane(camera, moved, 2.0 + moved @ ASIDE[:3, 3])
    inner = (slice(8, -8), slice(8, -8))
    assert (got[inner] > 0).all()
    # A point goes to the pixel that it falls into, at most half a pixel from its middle, where the plane is up to 0.3% nearer or farther.
    np.testing.assert_allclose(got[inner], want[inner], rtol=0.004)


def test_what_is_near_hides_what_is_behind_and_what_it_hid_is_not_known() -> None:
    depth = np.full((72, 96), 4.0, np.float32)
    depth[:, 40:56] = 1.0
    got = reprojected(depth, CAMERA, pose((0, 0, 0), (0.1, 0, 0)))  # 8 pixels to the right at 1, 2 at 4
    assert (got[:, 48:64] == 1).all()
    assert (got[:, :42] == np.where(np.arange(42) >= 2, 4, 0)).all()
    assert (got[:, 42:48] == 0).all(), "what the near surface hid"
    assert (got[:, 64:95] == 4).all()


def test_no_cracks_where_pixels_move_apart() -> None:
    depth = plane(CAMERA, np.array([0.0, 0.0, 1.0]), 2.0)
    depth[:, 48:] = 1.0  # two surfaces, and the camera comes nearer to both, turned about its axis
    got = reprojected(depth, CAMERA, pose((0, 0, 0.03), (0, 0, -0.04)))
    left, right = got[10:-10, 10:38], got[10:-10, 62:-10]
    np.testing.assert_allclose(left, 1.96, rtol=1e-5)
    np.testing.assert_allclose(right, 0.96, rtol=1e-5)


def test_there_and_back() -> None:
    depth = plane(CAMERA, np.array([0.1, 0.15, 1.0]), 2.0)
    again = reprojected(reprojected(depth, CAMERA, ASIDE), CAMERA, invert(ASIDE))
    both = again > 0
    assert both.mean() > 0.9
    np.testing.assert_allclose(again[both], depth[both], rtol=0.006)


def test_a_frame_tells_where_its_depth_was_measured_and_its_file_too(tmp_path: Path) -> None:
    depth = np.full((72, 96), 2000, np.uint16)
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    frame = Frame("a", tmp_path / "a.png", CAMERA, np.eye(4), depth=tmp_path / "depth.png", depth_pose=pose((0, 0, 0), (0, 0, 0.5)))
    capture = Capture("7scenes", tmp_path, (frame,))
    assert set(np.unique(load_depth(replace(frame, depth_pose=None), capture))) == {2.0}
    assert set(np.unique(load_depth(frame, capture))) == {0.0, 2.5}  # seen from half a unit behind: smaller, so its rim is open
    again = capture_from_dict(capture_to_dict(capture)).frames[0]
    np.testing.assert_array_equal(again.depth_pose, frame.depth_pose)
    older = capture_to_dict(capture)
    del older["frames"][0]["depth_pose"]
    assert capture_from_dict(older).frames[0].depth_pose is None
