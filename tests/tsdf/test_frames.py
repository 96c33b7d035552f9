"""What a capture yields for fusion: units, lenses, masks, fields of view; and the sizes chosen from its depth."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import FISHEYE, OPENCV, Intrinsics, Similarity, distort
from fieldfuse.capture import open_capture
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import TsdfSettings
from fieldfuse.errors import InputError
from fieldfuse.tone import Tone
from fieldfuse.tsdf.fuse import automatic_depth_max, automatic_voxel_size, capture_depth_frames, fuse_capture
from tests.conftest import shared_data
from tests.tsdf.scenes import CAMERA, directions, ring, sphere_colour, sphere_depth

CENTRE = np.array([5.0, 3.0, -2.0])
RADIUS = 0.5
SIMILARITY = Similarity(0.1, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2.0, 3.0]))


def sphere_picture(camera: Intrinsics, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and RGB of the sphere through the camera's lens: each pixel's bent ray is found by search on a fine ideal picture."""
    wide = Intrinsics(camera.width * 6, camera.height * 6, camera.fx * 3, camera.fy * 3, camera.width * 3.0, camera.height * 3.0)
    v, u = np.mgrid[0 : wide.height, 0 : wide.width]
    ideal = np.stack([(u + 0.5 - wide.cx) / wide.fx, (v + 0.5 - wide.cy) / wide.fy], axis=-1).reshape(-1, 2)
    bent = distort(camera, ideal) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    fine = sphere_depth(wide, pose, CENTRE, RADIUS).reshape(-1)
    points = pose[:3, 3] + directions(wide, pose).reshape(-1, 3) * fine[:, None]
    colour = np.where(fine[:, None] > 0, sphere_colour(points, CENTRE), 0)
    column, row = np.floor(bent).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    # Of all fine rays in a pixel the one nearest to its centre counts, so the far ones are written first.
    order = np.argsort(-((bent - np.floor(bent) - 0.5) ** 2).sum(axis=1))
    order = order[inside[order]]
    depth, rgb = np.zeros((camera.height, camera.width), np.float32), np.zeros((camera.height, camera.width, 3), np.uint8)
    depth[row[order], column[order]] = fine[order]
    rgb[row[order], column[order]] = colour[order]
    return depth, rgb


def written(
    folder: Path,
    camera: Intrinsics,
    depth_camera: Intrinsics | None = None,
    count: int = 6,
    alpha: bool = False,
    mask: np.ndarray | None = None,
) -> Capture:
    """A capture of the sphere in the input's frame, on disk."""
    frames = []
    for number, pose in enumerate(ring(CENTRE, 1.6, count)):
        depth, rgb = sphere_picture(camera, pose)
        if depth_camera is not None:
            depth, _ = sphere_picture(depth_camera, pose)
        picture = rgb[:, :, ::-1]
        if alpha:
            picture = np.dstack([picture, np.where(picture.any(axis=2), 255, 0).astype(np.uint8)])
        names = [folder / f"{number}.{kind}.png" for kind in ("colour", "depth", "mask")]
        cv2.imwrite(str(names[0]), picture)
        cv2.imwrite(str(names[1]), np.round(depth * 5000).astype(np.uint16))
        if mask is not None:
            cv2.imwrite(str(names[2]), mask.astype(np.uint8) * 255)
        frames.append(Frame(str(number), names[0], camera, pose, names[1], depth_camera, names[2] if mask is not None else None))
    return Capture("made", folder, tuple(frames), depth_scale=5000.0)


LENSES = {
    "pinhole": Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0),
    "opencv": Intrinsics(160, 120, 150.0, 150.0, 83.0, 58.0, OPENCV, (-0.25, 0.1, 0.002, -0.001)),
    "fisheye": Intrinsics(160, 120, 110.0, 110.0, 80.0, 60.0, FISHEYE, (0.05, -0.01, 0.0, 0.0)),
}


@pytest.mark.parametrize("lens", list(LENSES))
def test_fused_in_working_units_through_any_lens(tmp_path: Path, lens: str) -> None:
    capture = written(tmp_path, LENSES[lens])
    frames = list(capture_depth_frames(capture, SIMILARITY))
    assert len(frames) == 6
    assert not any(camera.distorted for frame in frames for camera in (frame.depth_intrinsics, frame.colour_intrinsics))
    volume = fuse_capture(capture, SIMILARITY, settings=TsdfSettings(voxel_size=0.002))
    mesh = volume.mesh().cleaned(min_area_share=0.05).transformed(SIMILARITY.inverse())
    offset = mesh.vertices - CENTRE
    seen = np.abs(offset[:, 2]) < 0.3
    assert abs(np.median(np.linalg.norm(offset[seen], axis=1)) - RADIUS) < 0.3 * 0.02
    clear = seen & (np.abs(offset[:, 2]) > 0.02)
    assert ((mesh.colours[clear, 0] > mesh.colours[clear, 1]) == (offset[clear, 2] > 0)).mean() > 0.97


def test_colours_are_those_of_the_scene_where_pictures_have_a_tone(tmp_path: Path) -> None:
    """A picture that was exposed less, and darker towards its corners, gives the surface the colours that the others give it."""
    capture = written(tmp_path, CAMERA, count=2)
    plain, other = capture_depth_frames(capture, SIMILARITY)
    tone = Tone((0.7, 0.8, 0.6), 0.5)
    path = capture.frames[1].image
    photo = tone.applied(other.colour / 255, CAMERA) * 255
    cv2.imwrite(str(path), np.rint(photo)[..., ::-1].astype(np.uint8))
    corrected = list(capture_depth_frames(capture, SIMILARITY, tones={capture.frames[1].name: tone}))
    np.testing.assert_array_equal(corrected[0].colour, plain.colour)
    bright = other.colour > 40
    assert np.abs(corrected[1].colour.astype(int) - other.colour)[bright].max() <= 4
    raw = next(capture_depth_frames(capture, SIMILARITY, [1]))
    assert np.abs(raw.colour.astype(int) - other.colour)[bright].mean() > 15


def test_frames_come_one_at_a_time(tmp_path: Path) -> None:
    capture = written(tmp_path, CAMERA, count=3)
    frames = capture_depth_frames(capture, SIMILARITY, [2, 0])
    assert isinstance(frames, Iterator)
    first = next(frames)
    assert np.allclose(first.world_from_camera, SIMILARITY.poses(capture.frames[2].world_from_camera))
    assert first.depth.dtype == np.float32
    assert first.depth[60, 80] == pytest.approx(0.11, abs=1e-3)  # 1.1 in the input's units
    capture.frames[0].image.unlink()
    with pytest.raises(InputError, match=r"0\.colour\.png"):
        next(frames)


def test_masks_and_alpha_take_depth_away(tmp_path: Path) -> None:
    mask = np.ones((60, 80), bool)  # at half the picture's size
    mask[:, :40] = False
    (frame, *_) = capture_depth_frames(written(tmp_path, CAMERA, count=1, mask=mask), Similarity.identity())
    assert not frame.depth[:, :80].any()
    assert frame.depth[60, 85] > 0
    capture = written(tmp_path, CAMERA, count=1, alpha=True)
    wall = np.full((120, 160), 9000, np.uint16)
    cv2.imwrite(str(capture.frames[0].depth), wall)
    (frame, *_) = capture_depth_frames(capture, Similarity.identity())
    true = sphere_depth(CAMERA, capture.frames[0].world_from_camera, CENTRE, RADIUS) > 0
    assert ((frame.depth > 0) == true).mean() > 0.995
    assert frame.colour.shape == (120, 160, 3)


def test_colour_covers_the_depth_cameras_view_without_darkening(tmp_path: Path) -> None:
    narrow = Intrinsics(160, 120, 330.0, 330.0, 80.0, 60.0)  # sees about half of the sphere's width
    capture = written(tmp_path, narrow, CAMERA, count=8)
    volume = fuse_capture(capture, Similarity.identity(), settings=TsdfSettings(voxel_size=0.02))
    volume.min_weight = 0.5
    mesh = volume.mesh()
    # Red and green add up to about 240 wherever they mix; the black that Open3D would average in makes it less.
    assert (mesh.colours[:, 0].astype(int) + mesh.colours[:, 1]).min() > 200
    frame = next(capture_depth_frames(capture, Similarity.identity()))
    assert frame.colour.shape[1] > 160
    assert frame.colour_intrinsics.width == frame.colour.shape[1]


def test_sizes_follow_the_depth() -> None:
    rng = np.random.default_rng(0)
    room = [rng.uniform(1.0, 3.0, (48, 64)).astype(np.float32) for _ in range(3)]
    desk = [depth * 0.2 for depth in room]
    assert 0.005 <= automatic_voxel_size(room) <= 0.02
    assert automatic_voxel_size(desk) == pytest.approx(0.2 * automatic_voxel_size(room), rel=0.06)
    assert automatic_voxel_size(room, focal=60.0) == pytest.approx(0.05, rel=0.05)  # pixels of 3.3 cm at 2 m
    assert 2.9 < automatic_depth_max(room) < 3.2
    spoilt = [np.where(rng.random(depth.shape) < 0.3, np.nan, depth) for depth in room]
    spoilt[0][:20] = 0
    assert automatic_voxel_size(spoilt) == pytest.approx(automatic_voxel_size(room), rel=0.1)
    outliers = [np.where(rng.random(depth.shape) < 0.02, 500, depth) for depth in room]
    assert automatic_depth_max(outliers) <= 10.5


@pytest.mark.parametrize("value", [0.0, np.nan, -1.0])
def test_no_valid_depth_is_said_so(value: float) -> None:
    with pytest.raises(InputError, match="no frame holds a valid depth value"):
        automatic_voxel_size([np.full((4, 4), value, np.float32)])


def test_what_cannot_be_fused_is_refused(tmp_path: Path) -> None:
    capture = written(tmp_path, CAMERA, count=2)
    bare = capture.with_frames([Frame(frame.name, frame.image, frame.intrinsics, frame.world_from_camera) for frame in capture.frames])
    with pytest.raises(InputError, match="holds no depth maps"):
        fuse_capture(bare, Similarity.identity())
    unposed = capture.with_frames([Frame(frame.name, frame.image, frame.intrinsics, None, frame.depth) for frame in capture.frames])
    with pytest.raises(InputError, match="has no pose"):
        fuse_capture(unposed, Similarity.identity())


def test_a_real_kitchen() -> None:
    capture = open_capture(shared_data("redkitchen"))
    test = list(range(0, 24, 8))
    train = [i for i in range(24) if i not in test]
    volume = fuse_capture(capture, Similarity.identity(), train, TsdfSettings(voxel_size=0.02))
    assert volume.depth_max < 4.5
    for frame in capture_depth_frames(capture, Similarity.identity(), test):
        view = volume.render(frame.depth_intrinsics, frame.world_from_camera)
        both = view.mask & (frame.depth > 0) & (frame.depth < volume.depth_max)
        assert both.sum() > 0.85 * ((frame.depth > 0) & (frame.depth < volume.depth_max)).sum()
        assert np.median(np.abs(view.depth - frame.depth)[both]) < 0.012
        seen = volume.render(frame.colour_intrinsics, frame.world_from_camera)
        target = frame.colour.astype(np.float32) / 255
        assert -10 * np.log10(((seen.rgb - target)[seen.mask] ** 2).mean()) > 17.5  # decibels
