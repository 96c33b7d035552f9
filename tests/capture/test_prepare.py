"""Views: lens geometry to a tenth of a pixel, resampling once, held-out frames, alpha, masks and depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import FISHEYE, OPENCV, Intrinsics, Similarity, undistort_maps
from fieldfuse.capture.prepare import held_out, images_at, prepare_views, target_size
from fieldfuse.capture.types import Frame, Views
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from tests.capture.board import capture_of, corners, found_corners, photograph, posed, save, texture

PLAIN = Intrinsics(480, 360, 400.0, 396.0, 236.5, 183.25)
BARREL = replace(PLAIN, lens=OPENCV, distortion=(-0.18, 0.04, 0.002, -0.0015))
CUSHION = replace(PLAIN, lens=OPENCV, distortion=(0.12, -0.02, -0.001, 0.001, 0.003))
ROUND = replace(PLAIN, fx=330.0, fy=330.0, lens=FISHEYE, distortion=(0.03, -0.01, 0.002, -0.0005))
SAME = Similarity.identity()


def one_view(tmp_path: Path, camera: Intrinsics, picture: np.ndarray, size: int | None = None, **more: object) -> Views:
    frame = posed(save(tmp_path / "a.png", picture), camera, **more)
    alpha = picture.ndim == 3 and picture.shape[2] == 4
    return prepare_views(capture_of(tmp_path, [frame], alpha=alpha), SAME, CaptureSettings(image_size=size))


# ---------------------------------------------------------------------------------------------------- lens


@pytest.mark.parametrize("size", [480, 300, 160])
@pytest.mark.parametrize("camera", [PLAIN, BARREL, CUSHION, ROUND], ids=["plain", "barrel", "cushion", "fisheye"])
def test_corners_lie_where_a_pinhole_camera_sees_them(tmp_path: Path, camera: Intrinsics, size: int) -> None:
    views = one_view(tmp_path, camera, photograph(camera), size)
    target, picture = views.intrinsics[0], views.images[0]
    assert (target.width, target.height) == (size, size * 3 // 4) == picture.shape[1::-1]
    assert not target.distorted
    expected = corners(target)
    valid = views.valid[0]
    if valid is not None:  # only corners with a margin of real picture around them
        inner = cv2.erode(valid.astype(np.uint8), np.ones((15, 15), np.uint8))
        expected = expected[inner[expected[:, 1].astype(int), expected[:, 0].astype(int)] > 0]
    assert len(expected) >= 20
    away = np.linalg.norm(found_corners(picture, expected, window=5 if size > 200 else 3) - expected, axis=1)
    assert away.max() < 0.1


@pytest.mark.parametrize("size", [480, 300])
def test_pictures_in_another_size_are_those_that_views_of_it_have(tmp_path: Path, size: int) -> None:
    frames = [posed(save(tmp_path / f"{name}.png", photograph(camera)), camera) for name, camera in (("a", PLAIN), ("b", BARREL))]
    capture = capture_of(tmp_path, frames)
    views = prepare_views(capture, SAME, CaptureSettings(image_size=size))
    for index, (camera, picture) in zip((1, 0), images_at(capture, [1, 0], size), strict=True):
        assert camera == views.intrinsics[index]
        np.testing.assert_array_equal(picture, views.images[index])
    with pytest.raises(InputError, match="no intrinsics; find poses first"):
        next(images_at(capture_of(tmp_path, [replace(frames[0], intrinsics=None)]), [0], size))


def test_a_lens_is_removed_exactly_once(tmp_path: Path) -> None:
    once = one_view(tmp_path / "1", CUSHION, photograph(CUSHION))
    # Preparing what is prepared changes nothing: the camera says that no lens is left.
    again = one_view(tmp_path / "2", once.intrinsics[0], once.images[0])
    np.testing.assert_array_equal(again.images[0], once.images[0])
    # Removing it a second time, or not at all, would be seen by the test above: corners move by pixels.
    expected = corners(once.intrinsics[0], margin=30)
    outer = expected[np.linalg.norm(expected - [236.5, 183.25], axis=1) > 150]
    for picture in (photograph(CUSHION), one_view(tmp_path / "3", CUSHION, once.images[0]).images[0]):
        away = np.linalg.norm(found_corners(picture, outer, window=7) - outer, axis=1)
        assert np.median(away) > 1.0


@pytest.mark.parametrize("size", [200, 115, 45])
def test_resampling_is_close_to_dense_sampling(tmp_path: Path, size: int) -> None:
    camera = BARREL.scaled(240, 180)
    picture = texture(180, 240, seed=3, blur=0.7)
    got = one_view(tmp_path, camera, picture, size).images[0].astype(float)
    width, height = target_size(240, 180, size)
    dense = 24 if size < 100 else 8
    _, map_x, map_y, _ = undistort_maps(camera, width * dense, height * dense)
    fine = cv2.remap(picture.astype(np.float32), map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    reference = fine.reshape(height, dense, width, dense, 3).mean(axis=(1, 3))
    error = np.sqrt(np.mean((got - reference)[2:-2, 2:-2] ** 2))
    naive = cv2.remap(picture, *undistort_maps(camera, width, height)[1:3], cv2.INTER_LINEAR)
    plain_error = np.sqrt(np.mean((naive - reference)[2:-2, 2:-2] ** 2))
    assert error < 0.7  # grey levels; rounding to whole levels alone is 0.29
    assert plain_error > (1.5 if size == 200 else 4) * error  # what one sample a pixel would give


def test_pixels_without_source_are_not_valid(tmp_path: Path) -> None:
    views = one_view(tmp_path, CUSHION, photograph(CUSHION), 240)
    valid = views.valid[0]
    assert valid is not None and not valid[0, 0] and valid[90, 120] and 0.8 < valid.mean() < 1
    assert one_view(tmp_path, PLAIN, photograph(PLAIN), 240).valid[0] is None


def test_a_lens_model_that_folds_back_is_cut_off(tmp_path: Path) -> None:
    camera = Intrinsics(400, 400, 180.0, 180.0, 200.0, 200.0, OPENCV, (-0.25, 0.0, 0.0, 0.0))  # turns back at radius 1.155
    valid = one_view(tmp_path, camera, texture(400, 400)).valid[0]
    assert valid is not None
    v, u = np.mgrid[0:400, 0:400]
    radius = np.hypot(u + 0.5 - 200, v + 0.5 - 200) / 180
    assert valid[radius < 1.1].all()
    assert not valid[radius > 1.2].any()


# ---------------------------------------------------------------------------------------------------- size, names, poses


@given(st.integers(1, 5000), st.integers(1, 5000), st.integers(16, 2000))
def test_pictures_are_never_enlarged_and_keep_their_shape(width: int, height: int, long_side: int) -> None:
    w, h = target_size(width, height, long_side)
    assert 1 <= w <= width and 1 <= h <= height
    assert max(w, h) == min(max(width, height), long_side)
    assert abs(w * height - h * width) <= 0.5 * max(width, height) + max(width, height) * (min(w, h) == 1)


def test_a_camera_for_another_size_of_the_same_picture_is_scaled(tmp_path: Path) -> None:
    views = one_view(tmp_path, PLAIN, texture(180, 240))
    assert views.intrinsics[0] == PLAIN.scaled(240, 180)


def test_a_picture_of_another_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.png.*480×480.*480×360"):
        one_view(tmp_path, PLAIN, texture(480, 480))


def test_poses_go_to_the_working_frame(tmp_path: Path) -> None:
    rotation = cv2.Rodrigues(np.array([0.1, -0.7, 0.4]))[0]
    similarity = Similarity(2.5, rotation, np.array([1.0, -2.0, 3.0]))
    path = save(tmp_path / "a.png", texture(36, 48))
    frames = [replace(posed(path, PLAIN, index), name=f"{index}") for index in range(3)]
    views = prepare_views(capture_of(tmp_path, frames), similarity, CaptureSettings())
    for index, frame in enumerate(frames):
        assert frame.world_from_camera is not None
        np.testing.assert_allclose(views.world_from_camera[index, :3, 3], similarity.points(frame.world_from_camera[:3, 3]))
        np.testing.assert_allclose(views.world_from_camera[index, :3, :3], rotation @ frame.world_from_camera[:3, :3], atol=1e-12)


def test_a_frame_without_pose_is_refused(tmp_path: Path) -> None:
    frame = Frame("a", save(tmp_path / "a.png", texture(36, 48)), intrinsics=PLAIN)
    with pytest.raises(InputError, match="no pose"):
        prepare_views(capture_of(tmp_path, [frame]), SAME, CaptureSettings())


def test_photos_are_turned_by_exif_and_other_kinds_are_not(tmp_path: Path) -> None:
    from PIL import Image

    tags = Image.Exif()
    tags[0x0112] = 6
    path = tmp_path / "a.jpg"
    Image.fromarray(texture(36, 48)).save(path, exif=tags)
    upright = prepare_views(capture_of(tmp_path, [posed(path, PLAIN.scaled(36, 48))], kind="photos"), SAME, CaptureSettings())
    stored = prepare_views(capture_of(tmp_path, [posed(path, PLAIN.scaled(48, 36))], kind="transforms"), SAME, CaptureSettings())
    assert upright.images[0].shape == (48, 36, 3) and stored.images[0].shape == (36, 48, 3)
    np.testing.assert_array_equal(upright.images[0], np.rot90(stored.images[0], -1))


# ---------------------------------------------------------------------------------------------------- held out


def frames_named(names: list[str], splits: list[str | None] | None = None) -> list[Frame]:
    return [
        Frame(name, Path(f"/nowhere/{name}.png"), split=split) for name, split in zip(names, splits or [None] * len(names), strict=True)
    ]


def test_every_nth_by_name_is_held_out(tmp_path: Path) -> None:
    names = [f"shot_{number}" for number in (10, 2, 1, 20, 3, 11, 12, 4)]
    test = held_out(capture_of(tmp_path, frames_named(names)), 3)
    # natural order: 1 2 3 4 10 11 12 20, so 1, 4 and 12
    assert [name for name, held in zip(names, test, strict=True) if held] == ["shot_1", "shot_12", "shot_4"]


def test_the_sources_split_wins(tmp_path: Path) -> None:
    frames = frames_named(["a", "b", "c", "d"], ["train", "test", "val", "test"])
    for holdout in (0, 2, 8):
        assert held_out(capture_of(tmp_path, frames), holdout).tolist() == [False, True, False, True]


def test_training_pictures_alone_are_no_split(tmp_path: Path) -> None:
    frames = frames_named(["a", "b", "c", "d"], ["train"] * 4)  # of a folder that has a transforms_train.json and nothing else
    assert held_out(capture_of(tmp_path, frames), 2).tolist() == [True, False, True, False]
    assert not held_out(capture_of(tmp_path, frames), 0).any()


@given(st.integers(0, 60), st.integers(0, 20))
def test_held_out_counts(count: int, holdout: int) -> None:
    test = held_out(capture_of(Path("/nowhere"), frames_named([f"{i}" for i in range(count)])), holdout)
    assert test.dtype == bool and test.shape == (count,)
    assert test.sum() == (0 if holdout == 0 else -(-count // holdout))


# ---------------------------------------------------------------------------------------------------- alpha, masks


@pytest.mark.parametrize("camera", [PLAIN, BARREL], ids=["plain", "barrel"])
def test_alpha_is_composited_on_white_before_resampling(tmp_path: Path, camera: Intrinsics) -> None:
    picture = np.zeros((360, 480, 4), np.uint8)
    picture[..., :3] = (10, 200, 30)  # what lies under alpha 0 must not be seen: black fringes come from mixing before compositing
    picture[:, 240:] = (200, 40, 60, 255)
    picture[:, :100] = (0, 0, 200, 128)
    views = one_view(tmp_path, camera, picture, 120)
    image, alpha = views.images[0].astype(int), views.alpha[0]
    assert views.background == (1.0, 1.0, 1.0) and alpha is not None and alpha.shape == (90, 120)
    assert np.abs(image[45, 30] - 255).max() <= 1 and alpha[45, 30] == 0
    assert np.abs(image[45, 100] - [200, 40, 60]).max() <= 1 and alpha[45, 100] == 255
    assert np.abs(image[45, 5] - [127, 127, 227]).max() <= 2 and abs(int(alpha[45, 5]) - 128) <= 1
    edge = image[45, 55:65]
    assert (edge[:, 0] >= 195).all()  # red only runs between white and the object's own


@pytest.mark.parametrize("mask_size", [(360, 480), (180, 240)])
@pytest.mark.parametrize("camera", [PLAIN, BARREL], ids=["plain", "barrel"])
def test_masked_pixels_go_into_no_valid_pixel(tmp_path: Path, camera: Intrinsics, mask_size: tuple[int, int]) -> None:
    height, width = mask_size
    mask = np.full(mask_size, 255, np.uint8)
    mask[height // 3 : height // 2, width // 4 : width // 2] = 0
    path = save(tmp_path / "mask.png", mask)
    grey = cv2.resize(mask, (480, 360), interpolation=cv2.INTER_NEAREST)
    views = one_view(tmp_path, camera, np.repeat(grey[..., None], 3, axis=2), 150, mask=path)
    valid = views.valid[0]
    assert valid is not None and 0.85 < valid.mean() < 0.97
    assert views.images[0][valid].min() >= 250  # the picture is black exactly where the mask is 0


# ---------------------------------------------------------------------------------------------------- depth


def test_depth_of_the_same_camera(tmp_path: Path) -> None:
    depth = np.full((360, 480), 2000, np.uint16)
    depth[:, 200:] = 3500
    depth[:40] = 0
    depth[-30:] = 65535
    path = save(tmp_path / "depth.png", depth)
    frame = posed(save(tmp_path / "a.png", texture(360, 480)), BARREL, depth=path)
    views = prepare_views(capture_of(tmp_path, [frame]), Similarity(0.5, np.eye(3), np.zeros(3)), CaptureSettings(image_size=240))
    got = views.depths[0]
    assert got is not None and got.dtype == np.float32 and got.shape == (180, 240)
    assert set(np.unique(got)) == {np.float32(0), np.float32(1.0), np.float32(1.75)}  # no value between two surfaces
    assert got[90, 60] == 1.0 and got[90, 180] == 1.75 and got[2, 120] == 0 and got[178, 120] == 0


@pytest.mark.parametrize("lens", [(), (-0.2, 0.05, 0.001, 0.001)], ids=["plain", "lens"])
def test_depth_of_its_own_camera_is_aligned(tmp_path: Path, lens: tuple[float, ...]) -> None:
    """A slanted plane: its depth at every pixel of the colour camera is known in closed form."""
    depth_camera = Intrinsics(320, 240, 290.0, 288.0, 158.0, 121.0)
    colour = replace(PLAIN, lens=OPENCV, distortion=lens) if lens else PLAIN

    def plane(camera: Intrinsics) -> np.ndarray:
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        x, y = (u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy
        return 2.0 / (1 - 0.3 * x + 0.2 * y)  # z + normal · (x, y) z = 2

    np.save(tmp_path / "depth.npy", plane(depth_camera).astype(np.float32) * 1000)
    frame = posed(save(tmp_path / "a.png", texture(360, 480)), colour, depth=tmp_path / "depth.npy", depth_intrinsics=depth_camera)
    views = prepare_views(capture_of(tmp_path, [frame]), SAME, CaptureSettings(image_size=480))
    got, expected = views.depths[0], plane(views.intrinsics[0])
    assert got is not None
    seen = got > 0
    assert 0.75 < seen.mean() < 1.0  # the depth camera sees a little less
    step = 0.5 * (0.3 / 290 + 0.2 / 288) / 2.0 * expected**2  # half a depth pixel both ways along the slope
    assert (np.abs(got - expected)[seen] <= 1.05 * step[seen]).all()
    assert seen[5:-5, 100:-100][50:-50].all()  # no holes inside


def test_depth_of_another_shape_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "depth.png", np.full((100, 100), 900, np.uint16))
    frame = posed(save(tmp_path / "a.png", texture(360, 480)), PLAIN, depth=path)
    with pytest.raises(InputError, match=r"depth\.png"):
        prepare_views(capture_of(tmp_path, [frame]), SAME, CaptureSettings())
