"""The first look at a capture: each kind of bad input refused in one sentence, weaknesses told, good captures left alone."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.depth_checks import Sample, check_depth, unit_factor, with_depth_scale
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.progress import Progress
from fieldfuse.simulate.paths import PathSettings, plan
from fieldfuse.simulate.procedural import random_scene
from tests.capture.board import capture_of, save, texture
from tests.conftest import shared_data

SIZE = (120, 160)
REAL = ["fox_540x960", "lego_400", "dtu_scan24_384", "redkitchen", "scannet_sample_11", "llff_fern_8", "redwood_livingroom1", "gum_360x640"]
def corridor(pose: Array, seed: int) -> tuple[Array, Array]:
    """(60, 80) depth along z and (60, 80) grey of a long corridor with doors at regular distances and posters that are not."""
    v, u = np.mgrid[0:60, 0:80]
    rays = np.stack([(u + 0.5 - 40) / 70, (v + 0.5 - 30) / 70, np.ones((60, 80))], axis=-1) @ pose[:3, :3].T
    depth, grey = np.full((60, 80), 40.0), np.full((60, 80), 60.0)
    posters = np.random.default_rng(seed).uniform(30, 220, 400)
    for normal, distance, shade in (((1, 0, 0), 1.2, 150), ((-1, 0, 0), 1.2, 160), ((0, 1, 0), 1.4, 90), ((0, -1, 0), 1.1, 200)):
        towards = rays @ np.array(normal, float)
        along = (distance - pose[:3, 3] @ np.array(normal, float)) / np.maximum(towards, 1e-6)
        nearer = (towards > 1e-6) & (along < depth)
        place = pose[2, 3] + along * rays[..., 2]
        door = (np.mod(place, 2.0) < 0.9) & (abs(normal[0]) == 1)
        pattern = np.where(door, 40.0, 0.4 * shade + 0.6 * posters[np.clip(place / 0.7, 0, 399).astype(int)])
        depth, grey = np.where(nearer, along, depth), np.where(nearer, pattern, grey)
    return depth, grey


def photos(folder: Path, pictures: list[Array], suffix: str = ".jpg") -> Capture:
    frames = [Frame(f"{index:02d}", save(folder / f"{index:02d}{suffix}", picture)) for index, picture in enumerate(pictures)]
    return capture_of(folder, frames, kind="photos")


def scenery(count: int = 8, size: tuple[int, int] = SIZE) -> list[Array]:
    wide = texture(size[0], size[1] + 20 * count, seed=1)
    return [np.ascontiguousarray(wide[:, 20 * index : 20 * index + size[1]]) for index in range(count)]


def refused(capture: Capture, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        check_capture(capture)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 400


# ---------------------------------------------------------------------------------------------------- refused


def test_no_and_one_picture(tmp_path: Path) -> None:
    refused(capture_of(tmp_path, [], kind="photos"), "no images")
    refused(photos(tmp_path, scenery(1)), "only one image")


def test_ten_identical_photos(tmp_path: Path) -> None:
    refused(photos(tmp_path / "same", [scenery(1)[0]] * 10), "same view")
    # The same view taken ten times: not the same bytes, but nothing new in them either.
    rng = np.random.default_rng(0)
    view = texture(480, 640, blur=4)
    noisy = [np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8) for _ in range(10)]
    refused(photos(tmp_path / "noisy", noisy), "same view")


def test_a_small_move_is_not_identical(tmp_path: Path) -> None:
    wide = texture(SIZE[0], SIZE[1] + 20, seed=1)
    check_capture(photos(tmp_path, [np.ascontiguousarray(wide[:, index : index + SIZE[1]]) for index in range(0, 16, 2)]))


@pytest.mark.parametrize(("level", "text"), [(0, "black"), (255, "of one colour")])
def test_black_and_constant_photos(tmp_path: Path, level: int, text: str) -> None:
    rng = np.random.default_rng(0)
    pictures = [np.clip(level + rng.normal(0, 1, (*SIZE, 3)), 0, 255).astype(np.uint8) for _ in range(10)]
    refused(photos(tmp_path, pictures), text)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_truncated_picture_is_named(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    capture = photos(tmp_path, scenery(), suffix)
    path = capture.frames[5].image
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    checked = check_capture(capture)
    assert capture.frames[5].name not in {frame.name for frame in checked.frames} and len(checked.frames) == len(capture.frames) - 1
    assert any(re.search(rf"left out.*05\{suffix}.*cut short", warning) for warning in checked.warnings)
    for frame in capture.frames[6:]:
        frame.image.write_bytes(path.read_bytes())
    refused(capture, rf"05\{suffix}.*cut short")
    assert capfd.readouterr().err == ""


def test_a_missing_picture_is_named(tmp_path: Path) -> None:
    capture = photos(tmp_path, scenery())
    capture.frames[3].image.unlink()
    assert any("03.jpg" in warning for warning in check_capture(capture).warnings)
    for frame in capture.frames[4:]:
        frame.image.write_bytes(b"")
    refused(capture, r"03\.jpg")


def test_a_picture_of_another_shape_than_its_camera(tmp_path: Path) -> None:
    capture = photos(tmp_path, scenery())
    camera = Intrinsics(SIZE[1], SIZE[0] + 40, 150.0, 150.0, 80.0, 80.0)
    refused(capture.with_frames([replace(frame, intrinsics=camera) for frame in capture.frames]), r"00\.jpg.*another shape")


# ---------------------------------------------------------------------------------------------------- told


def warnings_of(capture: Capture) -> str:
    return " | ".join(check_capture(capture).warnings)


def test_good_photos_pass_without_a_word(tmp_path: Path) -> None:
    checked = check_capture(photos(tmp_path, scenery()))
    assert checked.warnings == () and checked.extra["sizes"] == {"160x120": 8}


def test_mixed_sizes(tmp_path: Path) -> None:
    pictures = scenery(6) + [np.ascontiguousarray(picture[:, :100]) for picture in scenery(8)[6:]]
    capture = photos(tmp_path, pictures)
    checked = check_capture(capture)
    assert checked.extra["sizes"] == {"160x120": 6, "100x120": 2}
    assert "each size gets its own camera" in checked.warnings[0] and "160×120 (6)" in checked.warnings[0]
    cameras = [Intrinsics(picture.shape[1], picture.shape[0], 150.0, 150.0, 80.0, 60.0) for picture in pictures]
    with_cameras = capture.with_frames([replace(frame, intrinsics=camera) for frame, camera in zip(capture.frames, cameras, strict=True)])
    assert "this is fine" in warnings_of(with_cameras)


def test_sizes_are_counted_upright_for_photos(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x0112] = 6
    capture = photos(tmp_path, scenery())
    for frame in capture.frames[:4]:  # four held upright, stored lying
        picture = np.rot90(np.asarray(Image.open(frame.image)))
        Image.fromarray(np.ascontiguousarray(picture)).save(frame.image, exif=tags)
    assert check_capture(capture).extra["sizes"] == {"160x120": 8}
    assert len(check_capture(replace(capture, kind="llff")).extra["sizes"]) == 2


def test_some_bad_pictures_are_told(tmp_path: Path) -> None:
    pictures = scenery(12)
    pictures[4] = np.zeros_like(pictures[4])
    pictures[7] = pictures[6]
    for index in (1, 9):
        pictures[index] = cv2.GaussianBlur(pictures[index], (0, 0), 5)
    text = warnings_of(photos(tmp_path, pictures))
    assert "1 of 11 images show nothing but one colour (04)" in text
    assert "1 image is a copy of others (07.jpg of 06.jpg) and counts once" in text
    assert "2 of 11 images are much less sharp" in text


def test_dark_and_overexposed_pictures_are_told(tmp_path: Path) -> None:
    dark = [(picture / 8).astype(np.uint8) for picture in scenery()]
    assert "8 of 8 images are very dark" in warnings_of(photos(tmp_path / "dark", dark))
    bright = [np.clip(picture.astype(int) * 4, 0, 255).astype(np.uint8) for picture in scenery()]
    assert "white in large parts" in warnings_of(photos(tmp_path / "bright", bright))
    assert "white" not in warnings_of(replace(photos(tmp_path / "object", bright), alpha=True))


def test_stopping_is_heard(tmp_path: Path) -> None:
    class Stop(Progress):
        def stopping(self) -> bool:
            return True

    with pytest.raises(Interrupted):
        check_capture(photos(tmp_path, scenery()), Stop())


def test_many_large_photos_take_seconds(tmp_path: Path) -> None:
    """Half of what it would take to read them in full is more than enough (a quarter where it was measured), on whatever machine."""
    base = cv2.resize(texture(600, 800, blur=1), (4000, 3000), interpolation=cv2.INTER_CUBIC)
    sources = [
        save(tmp_path / f"source{index}.jpg", np.roll(base, 300 * index, axis=1), cv2.IMWRITE_JPEG_QUALITY, 90) for index in range(2)
    ]
    frames = []
    for index in range(60):
        path = tmp_path / f"{index:03d}.jpg"
        path.hardlink_to(sources[index % 2])
        frames.append(Frame(path.stem, path))
    shares = []
    for _ in range(3):  # the clock of a busy machine is a little off now and then
        started = time.process_time()
        check_capture(capture_of(tmp_path, frames, kind="photos"))
        between = time.process_time()
        for source in 2 * sources:
            cv2.imread(str(source))
        shares.append((between - started) / (len(frames) * (time.process_time() - between) / 4))
        if shares[-1] < 0.5:
            break
    assert min(shares) < 0.5, shares


# ---------------------------------------------------------------------------------------------------- depth


CAMERA = Intrinsics(80, 60, 70.0, 70.0, 40.0, 30.0)


def corner_of_a_room(pose: Array) -> Array:
    """(60, 80) depth along z of a floor, a back wall and a side wall, each n · x = d, from inside."""
    v, u = np.mgrid[0:60, 0:80]
    rays = np.stack([(u + 0.5 - 40) / 70, (v + 0.5 - 30) / 70, np.ones((60, 80))], axis=-1) @ pose[:3, :3].T
    depths = []
    for normal, distance in (((0, 1, 0), 1.0), ((0, 0, 1), 4.0), ((-1, 0, 0), 1.5), ((0, -1, 0), 1.5), ((1, 0, 0), 3.0)):
        towards = rays @ np.array(normal, float)
        depths.append(np.where(towards > 1e-6, (distance - pose[:3, 3] @ np.array(normal, float)) / np.maximum(towards, 1e-6), np.inf))
    return np.asarray(np.min(depths, axis=0))


def rgbd(folder: Path, depth_factor: float = 1.0, kind: str = "7scenes", step: float = 0.25, count: int = 8) -> Capture:
    """A walk into the corner of a room, looking about; depth is stored in millimetres × depth_factor."""
    frames = []
    v, u = np.mgrid[0:60, 0:80]
    rays = np.stack([(u + 0.5 - 40) / 70, (v + 0.5 - 30) / 70, np.ones((60, 80))], axis=-1)
    for index in range(count):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.08 * (index - 3), 0.0]))[0]
        pose[:3, 3] = step * index * np.array([0.7, 0.1, 1.0])
        path = folder / f"{index}.npy"
        folder.mkdir(parents=True, exist_ok=True)
        depth = corner_of_a_room(pose)
        np.save(path, (depth * 1000 * depth_factor).astype(np.float32))
        x, y, z = np.moveaxis((rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3], -1, 0)
        waves = [np.sin(5 * x + 3 * y) * np.cos(4 * z - y), np.sin(7 * y - 2 * z), np.cos(6 * x + 5 * z)]
        image = save(folder / f"{index}.png", np.clip(128 + 90 * np.stack(waves, axis=2), 0, 255).astype(np.uint8))
        frames.append(Frame(f"{index}", image, intrinsics=CAMERA, world_from_camera=pose, depth=path))
    return capture_of(folder, frames, kind=kind, metric=kind != "transforms", ordered=True)


def test_depth_in_the_right_unit_passes(tmp_path: Path) -> None:
    assert check_capture(rgbd(tmp_path)).warnings == ()


@pytest.mark.parametrize("factor", [1000.0, 100.0, 10.0, 6.5535, 5.0, 4.0, 2.0, 0.5, 0.2, 0.1, 0.01, 0.001])
def test_a_usual_unit_of_depth_is_found_by_the_poses(tmp_path: Path, factor: float) -> None:
    found = check_capture(rgbd(tmp_path, factor))
    assert found.depth_scale == pytest.approx(1000 * factor)
    assert any("stored values to a unit of length, which fits the camera's motion" in text for text in found.warnings)


def test_a_depth_scale_that_was_given_is_kept_with_a_remark(tmp_path: Path) -> None:
    capture = rgbd(tmp_path, 5.0)
    right, wrong = check_capture(with_depth_scale(capture, "0.2mm")), check_capture(with_depth_scale(capture, 1000))
    assert (right.depth_scale, right.warnings) == (pytest.approx(5000), ())
    assert wrong.depth_scale == 1000 and "that was given" in " ".join(wrong.warnings)


@pytest.mark.parametrize("factor", [3.0, 0.3])
@pytest.mark.parametrize("kind", ["7scenes", "transforms"])
def test_depth_in_a_unit_that_nobody_uses_is_refused(tmp_path: Path, factor: float, kind: str) -> None:
    with pytest.raises(InputError, match=f"times {'smaller' if factor > 1 else 'larger'}, so its unit") as caught:
        check_capture(rgbd(tmp_path, factor, kind))
    assert ("depth_unit_scale_factor" if kind == "transforms" else "millimetres") in str(caught.value)


def sample_of(depth: Array, camera: Intrinsics, pose: Array) -> Sample:
    found = Sample.of(depth, Frame("", Path(), camera, pose))
    assert found is not None
    return found


def plain_corridor(seed: int) -> list[Sample]:
    """Depth maps (45, 60) along a corridor, filmed in steps of half a metre to three: doors at equal distances, or none; an end wall far
    off; a sensor that reaches 4 m, 8 m or all the way."""
    rng = np.random.default_rng(seed)
    half, height, length = rng.uniform(0.7, 1.6), rng.uniform(1.1, 1.7), rng.choice([30.0, 60.0, 200.0])
    period, recess, step = rng.choice([0.0, 2.0, 3.0]), rng.choice([0.1, 0.6]), rng.choice([0.5, 1.0, 2.0, 3.0])
    reach, turn, sway = rng.choice([4.0, 8.0, np.inf]), rng.choice([0.01, 0.1]), rng.choice([0.01, 0.15])
    camera = Intrinsics(60, 45, 45.0, 45.0, 30.0, 22.5)
    v, u = np.mgrid[0:45, 0:60] + 0.5
    found = []
    for index in range(8):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.3 * rng.normal(0, turn), rng.normal(0, turn), 0.0]))[0]
        pose[:3, 3] = [*rng.normal(0, sway, 2), step * index]
        rays = np.stack([(u - 30) / 45, (v - 22.5) / 45, np.ones((45, 60))], axis=-1) @ pose[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):

            def plane(axis: int, at: float, rays: Array = rays, pose: Array = pose) -> Array:
                depth = (at - pose[axis, 3]) / rays[..., axis]
                return np.where(depth > 1e-6, depth, np.inf)

            depths = [plane(1, -height), plane(1, height), plane(2, length)]
            for side in (-half, half):
                wall = plane(0, side)
                along = pose[2, 3] + wall * rays[..., 2]
                door = (along % period < 0.9) if period else np.zeros((45, 60), bool)
                depths += [np.where(door, np.inf, wall), plane(0, side + np.sign(side) * recess)]
        depth = np.min(depths, axis=0)
        depth *= 1 + rng.normal(0, 0.003, depth.shape)
        found.append(sample_of(np.where(depth < reach, depth, 0).astype(np.float32), camera, pose))
    return found


def test_no_unit_is_invented_along_corridors() -> None:
    """There, large depth always agrees: the camera then seems to stand still, and the corridor looks the same from everywhere."""
    factors = [unit_factor(plain_corridor(seed)) for seed in range(40)]
    assert factors == [1.0] * 40


def of_scene(kind: str, seed: int, step: float) -> list[Sample]:
    """Exact depth (45, 60) of a simulated scene, walked through in such steps."""
    rng = np.random.default_rng(seed)
    scene = random_scene(kind, rng)
    camera = Intrinsics(60, 45, 45.0, 45.0, 30.0, 22.5)
    path = PathSettings("walk", 8, 1.0, step)
    poses = plan(scene, path, rng).poses(path.times())
    return [sample_of(scene.render(camera, pose, side=1).depth.numpy(), camera, pose) for pose in poses]


@pytest.mark.parametrize(("kind", "step"), [("corridor", 1.0), ("corridor", 0.5), ("room", 0.5), ("street", 1.0), ("wall", 0.5)])
def test_units_of_simulated_scenes(kind: str, step: float) -> None:
    samples = of_scene(kind, 3, step)
    assert unit_factor(samples) == 1.0
    if kind == "room":
        for factor in (1000.0, 4.0, 0.5, 0.01):
            wrong = [replace(sample, depth=sample.depth * factor, values=sample.values * factor) for sample in samples]
            assert unit_factor(wrong) == pytest.approx(1 / factor)


def test_impossible_metric_depth_is_noticed_without_motion(tmp_path: Path) -> None:
    still = rgbd(tmp_path / "far", 1000.0, step=1e-3)
    refused(still, "e[+]03 m, which no depth camera measures")
    refused(rgbd(tmp_path / "near", 0.001, step=1e-6), "0.00[0-9]* m, which no depth camera measures")
    check_capture(replace(still, metric=False, kind="transforms"))  # without metres nothing is impossible


@pytest.mark.parametrize("value", [0, 65535, np.nan, -1.0])
def test_depth_without_a_value(tmp_path: Path, value: float) -> None:
    capture = rgbd(tmp_path)
    for index, frame in enumerate(capture.frames):
        assert frame.depth is not None
        if isinstance(value, int):
            path = save(tmp_path / f"{index}_depth.png", np.full((60, 80), value, np.uint16))
            capture = capture.with_frames([replace(f, depth=path) if f.name == frame.name else f for f in capture.frames])
        else:
            np.save(frame.depth, np.full((60, 80), value, np.float32))
    refused(capture, "no depth map .* holds a value")


def test_missing_depth_is_told(tmp_path: Path) -> None:
    capture = rgbd(tmp_path)
    for index, frame in enumerate(capture.frames):
        assert frame.depth is not None
        depth = np.load(frame.depth)
        depth[:30] = 0
        np.save(frame.depth, depth if index != 2 else 0 * depth)
    frames = [*capture.frames[:-1], replace(capture.frames[-1], depth=None)]
    text = warnings_of(capture.with_frames(frames))
    assert "50% of the depth is missing" in text and "1 of 7 depth maps" in text and "1 of 8 frames have no depth" in text
    assert capture.frames[1].depth is not None
    capture.frames[1].depth.unlink()
    assert "without depth (1): " in warnings_of(capture)
    for frame in capture.frames[2:5]:
        assert frame.depth is not None
        frame.depth.unlink()
    refused(capture, r"1\.npy")


@pytest.mark.parametrize("factor", [1e4, 1000.0, 100.0, 10.0, 5.0, 4.0, 2.0, 0.5, 0.25, 0.2, 0.1, 0.01, 0.001])
def test_wrong_units_of_thirty_real_frames_are_found(factor: float) -> None:
    """As a sensor of quarter millimetres, tenths or fifths would store them."""
    capture = open_capture(shared_data("redkitchen"))
    capture = replace(capture, frames=capture.frames[:180:6], depth_scale=capture.depth_scale / factor)
    assert check_depth(capture)[0].depth_scale == 1000


@pytest.mark.parametrize("step", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_corridor_filmed_in_long_steps_is_in_the_right_unit(step: float, seed: int, tmp_path: Path) -> None:
    """Each step looks much as if the camera had stood still before something far away."""
    rng, frames = np.random.default_rng(seed), []
    for index in range(14):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.02, 3))[0]
        pose[:3, 3] = [*rng.normal(0, 0.03, 2), step * index]
        depth, grey = corridor(pose, seed)
        np.save(tmp_path / f"{index}.npy", (1000 * depth * (1 + rng.normal(0, 0.005, depth.shape))).astype(np.float32))
        image = save(tmp_path / f"{index}.png", np.repeat(grey[..., None], 3, axis=2).astype(np.uint8))
        frames.append(Frame(f"{index:02d}", image, intrinsics=CAMERA, world_from_camera=pose, depth=tmp_path / f"{index}.npy"))
    check_capture(capture_of(tmp_path, frames, kind="7scenes", metric=True, ordered=True))


@pytest.mark.parametrize("name", REAL)
def test_real_captures_pass(name: str) -> None:
    capture = open_capture(shared_data(name))
    assert len(check_capture(capture).frames) == len(capture.frames)


@pytest.mark.parametrize("name", ["redkitchen", "redwood_livingroom1"])
@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_wrong_units_of_real_depth_are_found(name: str, factor: float) -> None:
    capture = open_capture(shared_data(name))
    assert check_capture(replace(capture, depth_scale=capture.depth_scale * factor)).depth_scale == capture.depth_scale
