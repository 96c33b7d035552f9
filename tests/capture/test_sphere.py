"""Views of panoramas and fisheye images: directions, coverage, pixels, poses, depth, and what is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from fieldfuse.camera import EQUIRECTANGULAR, FISHEYE, PINHOLE, Array, Intrinsics, directions_of, pixel_grid, project, seen_at
from fieldfuse.capture.images import load_depth, load_image, load_mask
from fieldfuse.capture.prepare import held_out, limited
from fieldfuse.capture.sphere import View, announced, cut_images, cut_view, image_circles, share_of_pinhole, to_cut, views_of
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.types import CUT, Capture, Frame
from tests.capture.spheres import room, walk

PANORAMA = Intrinsics.equirectangular(800, 400)


def fisheye(degrees: float, width: int = 480, height: int = 480, lens: tuple[float, ...] = ()) -> Intrinsics:
    """An equidistant lens of so many degrees across the width."""
    focal = width / np.radians(degrees)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2, FISHEYE, lens)


def psnr(one: Array, two: Array) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(np.float64) - two) ** 2)))


@pytest.mark.parametrize(
    ("direction", "pixel"),
    [((0, 0, 1), (400, 200)), ((1, 0, 0), (600, 200)), ((-2, 0, 0), (200, 200)), ((0, 1, 1), (400, 300)), ((1, 0, -1), (700, 200))],
)
def test_directions_lie_in_a_panorama_by_longitude_and_latitude(direction: tuple[float, ...], pixel: tuple[float, ...]) -> None:
    found, seen = seen_at(PANORAMA, np.array(direction, dtype=float))
    np.testing.assert_allclose(found, pixel, atol=1e-9)
    assert seen
    assert seen_at(PANORAMA, np.array([0.0, -1.0, 0.0]))[0][1] == 0  # straight up: the first row


@pytest.mark.parametrize(
    ("model", "own"),
    [("EQUIRECTANGULAR", PANORAMA), ("OPENCV_FISHEYE", Intrinsics(800, 400, 250.0, 260.0, 410.0, 190.0, FISHEYE, (0.03, -0.01, 0.0, 0.0)))],
)
def test_colmap_puts_directions_where_we_do(model: str, own: Intrinsics) -> None:
    theirs = pycolmap.Camera.create_from_model_name(0, model, 250.0, 800, 400)
    if own.lens == FISHEYE:
        theirs.params = [own.fx, own.fy, own.cx, own.cy, *own.distortion]
    rays = np.random.default_rng(2).normal(size=(200, 3)) * [1, 1, 1.0 if own.lens == EQUIRECTANGULAR else 0] + [0, 0, 0.7]
    for ray, pixel in zip(rays, seen_at(own, rays)[0], strict=True):
        np.testing.assert_allclose(theirs.img_from_cam(ray), pixel, atol=1e-6)


def test_a_fisheye_lens_is_opencvs_and_shows_what_lies_beside_the_camera() -> None:
    camera = fisheye(190, lens=(0.02, -0.004, 0.001, 0.0))
    rays = np.random.default_rng(0).normal(size=(300, 3)) * [1, 1, 0.5]
    front = rays[:, 2] > 0.05
    pixels, _ = seen_at(camera, rays)
    theirs, _ = cv2.fisheye.projectPoints(rays[front][:, None], np.zeros(3), np.zeros(3), camera.matrix(), np.array(camera.distortion))
    np.testing.assert_allclose(pixels[front], theirs[:, 0], atol=1e-6)
    plain = fisheye(180)
    pixel, seen = seen_at(plain, np.array([[1.0, 0, -0.01], [0, 1.0, 0.01], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(pixel[:2], [[481.5, 240], [240, 478.5]], atol=0.1)
    assert seen.tolist() == [False, True, False]  # a hundredth of a radian beyond the rim; within it; behind


@pytest.mark.parametrize("camera", [PANORAMA, fisheye(170, lens=(0.05, -0.01, 0.0, 0.0)), Intrinsics(64, 48, 50.0, 52.0, 30.0, 25.0)])
def test_directions_of_pixels_are_the_reverse(camera: Intrinsics) -> None:
    grid = pixel_grid(camera.width, camera.height)[::37]
    directions = directions_of(camera, grid)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    pixels, seen = seen_at(camera, directions)
    inside = np.hypot(*(grid - [camera.cx, camera.cy]).T) < 0.49 * camera.width if camera.lens == FISHEYE else seen
    assert inside.sum() > 0.7 * len(grid) and seen[inside].all()
    np.testing.assert_allclose(pixels[inside], grid[inside], atol=1e-3)


def test_a_panorama_becomes_six_views_around_and_one_up() -> None:
    views, kept = views_of(PANORAMA)
    assert len(views) == 7 and kept == pytest.approx(0.84, abs=0.01)
    looking = np.array([view.source_from_view[:, 2] for view in views])
    turns = np.radians(60 * np.arange(6))
    np.testing.assert_allclose(looking[:6], np.stack([np.sin(turns), 0 * turns, np.cos(turns)], axis=1), atol=1e-9)  # to the right
    np.testing.assert_allclose(looking[6], [0, -1, 0], atol=1e-9)
    assert all(view.camera.lens == PINHOLE and view.camera.width == view.camera.height for view in views)
    rays = directions_of(PANORAMA, pixel_grid(800, 400))
    seen = np.any([seen_at(view.camera, rays @ view.source_from_view)[1] for view in views], axis=0)
    above = rays[:, 1] < np.sin(np.radians(39))  # y points down
    assert seen[above].mean() > 0.995 and not seen[rays[:, 1] > np.sin(np.radians(46))].any()
    assert views_of(Intrinsics.equirectangular(5760, 2880))[0][0].camera.width == 1024


@pytest.mark.parametrize(
    ("degrees", "size", "most"),
    [(85, (640, 480), 1), (120, (640, 480), 2), (150, (1280, 720), 3), (180, (640, 480), 4), (180, (640, 640), 5), (200, (640, 640), 6)],
)
def test_a_fisheye_lens_gets_as_few_views_as_keep_95_percent(degrees: float, size: tuple[int, int], most: int) -> None:
    camera = fisheye(degrees, *size)
    assert share_of_pinhole(camera) < 0.9  # of its size and focal length: what was used before
    views, kept = views_of(camera)
    assert 1 <= len(views) <= most and kept >= 0.95
    random = np.random.default_rng(1).normal(size=(4000, 3))
    shown = random[seen_at(camera, random)[1]]
    inside = np.any([seen_at(view.camera, shown @ view.source_from_view)[1] for view in views], axis=0)
    assert inside.mean() == pytest.approx(kept, abs=0.02)


def test_lenses_whose_own_pinhole_image_keeps_enough_stay_whole() -> None:
    assert views_of(fisheye(30, 640, 480)) == ((), 1.0)
    (view,), kept = views_of(fisheye(50, 1500, 1000))  # one view, of a wider field than its own pinhole image
    assert kept > 0.99 and 1500 >= view.camera.width > 1300
    assert views_of(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, "opencv", (-0.3, 0.1, 0.0, 0.0)))[0] == ()


def test_views_show_what_pinhole_cameras_there_would_see() -> None:
    pose = walk(3)[1]
    for camera in (Intrinsics.equirectangular(1024, 512), fisheye(180)):
        image, _ = room(camera, pose, soft=6)
        for view in views_of(camera)[0]:
            turned = pose.copy()
            turned[:3, :3] = pose[:3, :3] @ view.source_from_view
            pixels, seen = cut_view(image, camera, view)
            assert psnr(pixels[seen], room(view.camera, turned, soft=6)[0][seen]) > 36


def test_from_a_panorama_to_views_and_back() -> None:
    camera = Intrinsics.equirectangular(512, 256)
    image, _ = room(camera, walk(3)[1], soft=12)
    rays = directions_of(camera, pixel_grid(512, 256))
    back, known = np.zeros((256 * 512, 3)), np.zeros(256 * 512, dtype=bool)
    for view in views_of(camera)[0]:
        pixels, inside = seen_at(view.camera, rays @ view.source_from_view)
        u, v = (at.astype(np.float32).reshape(256, 512) for at in (pixels - 0.5).T)
        again = cv2.remap(cut_view(image, camera, view)[0], u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        back[inside], known[inside] = again.reshape(-1, 3)[inside], True
    assert psnr(back[known], image.reshape(-1, 3)[known]) > 36


def test_what_is_finer_than_a_views_pixels_becomes_grey() -> None:
    camera = Intrinsics.equirectangular(4096, 2048)
    image = np.zeros((2048, 4096, 3), dtype=np.uint8)
    image[:, ::2] = 200
    pixels, _ = cut_view(image, camera, View(Intrinsics(256, 256, 128.0, 128.0, 128.0, 128.0), np.eye(3)))
    assert abs(float(pixels.mean()) - 100) < 2 and pixels.std() < 12


def captured(folder: Path, camera: Intrinsics, count: int = 4, posed: bool = True, depth: bool = False) -> Capture:
    """A capture of the room by that camera."""
    frames = []
    for number, pose in enumerate(walk(count)):
        image, distance = room(camera, pose, soft=6)
        path = folder / f"shot {number}.png"
        cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        frame = Frame(f"shot {number}", path, camera, pose if posed else None)
        if depth:
            along = directions_of(camera, pixel_grid(camera.width, camera.height))[:, 2].reshape(distance.shape)
            np.save(folder / f"{number}.npy", np.where(along > 0.02, distance * along * 1000, 0).astype(np.float32))
            frame = replace(frame, depth=folder / f"{number}.npy")
        frames.append(frame)
    return announced(Capture("transforms" if posed else "photos", folder, tuple(frames)))


def test_a_posed_fisheye_capture_becomes_posed_views_with_masks_and_depth(tmp_path: Path) -> None:
    camera = fisheye(180, 320, 320)
    capture = captured(tmp_path, camera, depth=True)
    assert capture.extra[CUT] == "each of 4 fisheye images is cut into 4 views; 98% of what it shows is kept"
    cut = cut_images(capture, tmp_path / "run", 2)
    assert len(cut.frames) == 16 and cut.posed and cut.has_depth and not to_cut(cut)
    assert capture_to_dict(capture_from_dict(capture_to_dict(cut))) == capture_to_dict(cut)
    for frame in cut.frames[:5]:
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        image, mask, depth = load_image(frame), load_mask(frame), load_depth(frame, cut)
        expected, distance = room(frame.intrinsics, frame.world_from_camera, soft=6)
        assert mask is not None and 0.6 < mask.mean() < 1
        assert psnr(image[mask], expected[mask]) > 33
        along = directions_of(frame.intrinsics, pixel_grid(frame.intrinsics.width, frame.intrinsics.height))[:, 2].reshape(distance.shape)
        there = depth > 0
        assert there.mean() > 0.5 and np.median(np.abs(depth[there] / (distance * along)[there] - 1)) < 0.01


def test_what_lies_outside_a_fisheye_lenses_image_circle_is_masked_out(tmp_path: Path) -> None:
    camera = fisheye(200, 240, 240)
    capture = captured(tmp_path, camera, count=3)
    radius = np.hypot(*np.mgrid[-119.5:120, -119.5:120])
    for frame in capture.frames:
        image = cv2.imread(str(frame.image))
        image[radius > 110] = 0  # 183°
        image[100:110, 100:110] = 0  # black, but not outside
        cv2.imwrite(str(frame.image), image)
    (circle,) = image_circles(capture.frames, False).values()
    assert circle.mean() == pytest.approx(np.pi * 108**2 / 240**2, rel=0.03) and circle[110, 110]
    for frame in cut_images(capture, tmp_path / "run", 1).frames:
        assert (load_image(frame)[load_mask(frame)].max(axis=1) > 5).mean() > 0.97


def test_views_are_written_once_and_again_where_their_image_changed(tmp_path: Path) -> None:
    capture = captured(tmp_path, Intrinsics.equirectangular(256, 128), posed=False)
    first = cut_images(capture, tmp_path / "run", 2)
    written = {frame.image: frame.image.stat().st_mtime_ns for frame in first.frames}
    assert len(written) == 28 and all(path.parent == (tmp_path / "run/frames/views").resolve() for path in written)
    capture.frames[1].image.write_bytes(capture.frames[2].image.read_bytes())
    next(iter(written)).unlink()
    again = cut_images(capture, tmp_path / "run", 2)
    assert [frame.name for frame in again.frames] == [frame.name for frame in first.frames]
    renewed = {frame.instant for frame in again.frames if frame.image.stat().st_mtime_ns != written[frame.image]}
    assert renewed == {"shot 0", "shot 1"}


def test_views_of_an_instant_are_held_out_and_left_out_together(tmp_path: Path) -> None:
    capture = cut_images(captured(tmp_path, Intrinsics.equirectangular(128, 64), count=12), tmp_path / "run", 2)
    test = held_out(capture, 4)
    assert {frame.instant for frame, held in zip(capture.frames, test, strict=True) if held} == {"shot 0", "shot 4", "shot 8"}
    assert test.sum() == 3 * 7
    some = limited(capture, 4, 28)
    left = [frame.instant for frame, held in zip(some.frames, held_out(some, 4), strict=True) if not held]
    assert len(left) == 28 and len(set(left)) == 4


def test_points_of_the_world_lie_where_the_views_show_them(tmp_path: Path) -> None:
    """A bright spot on a panorama of another orientation, through pose, rotation and intrinsics."""
    camera, pose = Intrinsics.equirectangular(1024, 512), walk(5)[3]
    point = np.array([1.0, -0.4, 2.0])
    (u, v), _ = seen_at(camera, (point - pose[:3, 3]) @ pose[:3, :3])
    image = np.zeros((512, 1024, 3), dtype=np.uint8)
    cv2.circle(image, (int(u), int(v)), 4, (255, 255, 255), -1)
    image[::8] += 20
    cv2.imwrite(str(tmp_path / "a.png"), image)
    cv2.imwrite(str(tmp_path / "b.png"), image[:, ::-1])
    frames = (Frame("a", tmp_path / "a.png", camera, pose), Frame("b", tmp_path / "b.png", camera, np.eye(4)))
    cut = cut_images(announced(Capture("transforms", tmp_path, frames)), tmp_path / "run", 1)
    found = 0
    for frame in cut.frames[:7]:
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        pixel, depth = project(frame.intrinsics, frame.world_from_camera, point[None])
        if depth[0] > 0 and np.all((pixel > 6) & (pixel < frame.intrinsics.width - 6)):
            bright = np.argwhere(load_image(frame)[..., 0] > 150).mean(axis=0)[::-1] + 0.5
            np.testing.assert_allclose(bright, pixel[0], atol=1.5)
            found += 1
    assert found >= 1 and cut.frames[0].intrinsics.lens != EQUIRECTANGULAR
