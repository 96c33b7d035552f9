"""Captures that break readers: nothing to see, too much light, one pixel, damaged depth, single rows, 2,000 frames."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import FieldfuseError, InputError, PoseError
from fieldfuse.poses.result import given_poses
from fieldfuse.poses.scene import describe_scene
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.volume import DepthFrame, TsdfVolume
from tests.stability.hard.captures import flat, no_opacity, one_pixel, poses, prepared, saturated, texture, write_capture
from tests.stability.hard.errors import absolute, not_finite, refused
from tests.stability.hard.within import Within

GROUP = "data"


def fine_or_refused(within: Within, name: str, folder: Path) -> None:
    """A capture is prepared with finite numbers, or refused in a sentence."""
    try:
        _, views = prepared(folder)
    except FieldfuseError as error:
        within(f"{name}: refused without a sentence", float("\n" in str(error) or len(str(error)) < 20), 0.0)
        return
    depths = [depth for depth in views.depths if depth is not None]
    within(f"{name}: values that are not finite", not_finite(views.world_from_camera, *depths), 0.0)


def test_awkward_pictures(within: Within, tmp_path: Path) -> None:
    """Some constant, saturated, one bright pixel, alpha all 0."""

    def some_flat(index: int, height: int, width: int) -> Array:
        return flat(0)(index, height, width) if index % 3 == 0 else texture(index, height, width)

    for paint in (some_flat, saturated, one_pixel, no_opacity):
        path = write_capture(tmp_path / paint.__name__, paint)
        fine_or_refused(within, paint.__name__.replace("_", " "), path)
    capture, views = prepared(tmp_path / "some_flat")
    within("constant pictures not told", float(not any("one colour" in text for text in capture.warnings)), 0.0)
    try:
        _, white = prepared(tmp_path / "no_opacity")
        within("colour behind alpha 0", absolute(np.array(white.images), np.full_like(np.array(white.images), 255)), 0.0)
    except InputError as error:
        within("alpha all 0 refused without a sentence", float("\n" in str(error)), 0.0)
    within("pictures lost", abs(len(views) - 6.0), 0.0)


def test_thin_pictures(within: Within, tmp_path: Path) -> None:
    """Single rows, single columns, one pixel a picture."""
    for height, width in ((1, 64), (64, 1), (1, 1), (2, 300)):

        def paint(index: int, height: int, width: int) -> Array:
            return np.asarray(np.random.default_rng(index).integers(0, 255, (height, width, 3)), dtype=np.uint8)

        path = write_capture(tmp_path / f"{width}x{height}", paint, 4, height, width)
        fine_or_refused(within, f"{width}×{height}", path)
        for size in (16, 40):
            try:
                _, views = prepared(path, size=size)
            except InputError:
                continue
            small = [image.shape for image in views.images]
            wrong = sum(min(shape[:2]) < 1 or max(shape[:2]) > max(size, 1) for shape in small)
            within(f"{width}×{height} at {size}: pictures of a wrong size", float(wrong), 0.0)


@pytest.mark.long
def test_many_frames(within: Within, tmp_path: Path) -> None:
    """2,000 frames."""
    path = write_capture(tmp_path / "many", count=2000, height=24, width=32)
    capture, views = prepared(path, holdout=8)
    within("frames lost", abs(len(capture.frames) - 2000.0) + abs(len(views) - 2000.0), 0.0)
    within("frames out of order", float(capture.frames[1999].name != "1999"), 0.0)
    within("test views, beyond 250", abs(float(views.test.sum()) - 250), 0.0)
    within("values that are not finite", not_finite(views.world_from_camera), 0.0)
    within("worst pose", absolute(views.world_from_camera, poses(2000)), 1e-12)


def test_extreme_numbers(within: Within, tmp_path: Path) -> None:
    """Numbers at the edge of float64 in a transforms.json."""
    changes: dict[str, dict[str, float]] = {
        "fl_x 1e308": {"fl_x": 1e308, "fl_y": 1e308},
        "fl_x 1e-300": {"fl_x": 1e-300, "fl_y": 1e-300},
        "cx 1e300": {"cx": 1e300},
        "k1 1e10": {"k1": 1e10},
        "k1 -1e308": {"k1": -1e308},
        "w 1e308": {"w": 1e308},
        "place 1e200": {},
        "place 1e12": {},
    }
    for name, change in changes.items():
        path = write_capture(tmp_path / name.replace(" ", "_"), count=3)
        data = json.loads((path / "transforms.json").read_text())
        data.update(change)
        if name.startswith("place"):
            for frame in data["frames"]:
                frame["transform_matrix"][0][3] = float(name.split()[1])
        (path / "transforms.json").write_text(json.dumps(data))
        fine_or_refused(within, name, path)


HEIGHT, WIDTH = 32, 40


def plane_depth(index: int) -> Array:
    """(H, W) float32 depth of the sphere of radius 1 round the origin, 5 where it is missed."""
    pose = poses(6)[index]
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / (1.1 * WIDTH), (v - HEIGHT / 2) / (1.1 * WIDTH), np.ones_like(u)], axis=2) @ pose[:3, :3].T
    a, b, c = (rays**2).sum(2), rays @ pose[:3, 3], (pose[:3, 3] ** 2).sum() - 1
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 5.0).astype(np.float32)


def spoilt(index: int) -> Array:
    """True depth in millimetres as float32, with rows of NaN, infinities, 0, negative and huge values."""
    depth = plane_depth(index) * 1000
    for row, value in enumerate((np.nan, np.inf, -np.inf, 0.0, -5.0, -0.0)):
        depth[row + 2] = value
    return depth


def spoilt_16_bits(index: int) -> Array:
    depth = np.round(plane_depth(index) * 1000).astype(np.uint16)
    depth[3], depth[4] = 0, 65535
    return depth


def _even(value: float, index: int) -> Array:
    return np.full((HEIGHT, WIDTH), value, np.float32)


def test_depth_holes(within: Within, tmp_path: Path) -> None:
    """Depth with rows of NaN, infinity, 0, negative and 65535."""
    for name, make, rows in (("float32", spoilt, range(2, 8)), ("16 bits", spoilt_16_bits, (3, 4))):
        _, views = prepared(write_capture(tmp_path / name.replace(" ", ""), depth=make))
        depths = np.array(views.depths)
        truth = np.array([plane_depth(index) for index in range(6)])
        truth[:, list(rows)] = 0
        within(f"{name}: depth", absolute(depths, truth), 6e-4)
        within(f"{name}: not finite or negative", not_finite(depths) + float((depths < 0).sum()), 0.0)
    for name, value in (("NaN", np.nan), ("infinite", np.inf), ("zero", 0.0), ("negative", -1.0)):
        path = write_capture(tmp_path / f"all{name}", depth=partial(_even, value))
        within(f"all {name} taken", refused(partial(prepared, path), InputError, "depth"), 0.0)
    path = write_capture(tmp_path / "all65535", depth=lambda index: np.full((HEIGHT, WIDTH), 65535, np.uint16))
    within("all 65535 taken", refused(lambda: prepared(path), InputError, "depth"), 0.0)


def test_fused_holes(within: Within) -> None:
    """Fusing depth that is not finite, 0 or beyond the range."""
    camera = Intrinsics(WIDTH, HEIGHT, 1.1 * WIDTH, 1.1 * WIDTH, WIDTH / 2, HEIGHT / 2)
    volumes = []
    for damaged in (False, True):
        volume = TsdfVolume(0.06, 4.0, expected_blocks=200)
        for index, pose in enumerate(poses(6)):
            depth = plane_depth(index)
            depth[2:8] = 0
            if damaged:
                for row, value in enumerate((np.nan, np.inf, -np.inf, -1.0, 1e30, 65535.0)):
                    depth[row + 2] = value
            volume.integrate(DepthFrame(depth, texture(index, HEIGHT, WIDTH), camera, camera, pose))
        volumes.append(volume.mesh())
    whole, spoilt_mesh = volumes
    away = np.abs(np.linalg.norm(whole.vertices, axis=1) - 1)
    within("vertices that are not finite", not_finite(whole.vertices, spoilt_mesh.vertices), 0.0)
    within("vertices that damage added or moved", absolute(_sorted(spoilt_mesh.vertices), _sorted(whole.vertices)), 1e-6)
    within("distance from the sphere, median, metres", float(np.median(away)), 0.02)


def _sorted(vertices: Array) -> Array:
    return vertices[np.lexsort(vertices.round(9).T)]


def test_constant(within: Within, tmp_path: Path) -> None:
    """Black, white and grey pictures are refused."""
    for value in (0, 128, 255):
        path = write_capture(tmp_path / str(value), flat(value))
        within(f"pictures of {value} taken", refused(partial(prepared, path), InputError, "image"), 0.0)


def test_few_views(within: Within, tmp_path: Path) -> None:
    """One training view, no training view, no test view, two frames."""
    path = write_capture(tmp_path / "two", count=2)
    _, views = prepared(path, holdout=2)
    _, none = prepared(path, holdout=0)
    one = write_capture(tmp_path / "one", count=1)
    within("training views of two frames, holdout 2", abs(float((~views.test).sum()) - 1), 0.0)
    within("test views with holdout 0", float(none.test.sum()), 0.0)
    within("one picture taken", refused(lambda: prepared(one), InputError, "one image"), 0.0)


def test_scenes(within: Within, tmp_path: Path) -> None:
    """Scenes of pictures without texture, opacity or motion end in a sentence or in finite numbers."""

    def still(index: int, height: int, width: int) -> Array:
        return np.asarray(np.minimum(texture(0, height, width).astype(int) + 2 * index, 255), dtype=np.uint8)

    def noise(index: int, height: int, width: int) -> Array:
        return np.asarray(np.random.default_rng(index).integers(0, 255, (height, width, 3)), dtype=np.uint8)

    for name, paint, depth in (
        ("still", still, None), ("noise", noise, None), ("without opacity", no_opacity, None), ("spoilt depth", texture, spoilt)
    ):  # fmt: skip
        path = write_capture(tmp_path / name.replace(" ", "_"), paint, depth=depth)
        try:
            capture, _ = prepared(path)
            scene = describe_scene(given_poses(capture).apply(capture))
        except FieldfuseError as error:
            within(f"{name}: refused without a sentence", float("\n" in str(error) or len(str(error)) < 20), 0.0)
            continue
        numbers = [scene.centre, scene.half_size, scene.median_depth, scene.near, scene.far, scene.working_from_input.translation]
        within(f"{name}: not finite", not_finite(*numbers), 0.0)
        within(f"{name}: sizes that are not positive", float((scene.half_size <= 0).sum() + (scene.near <= 0)), 0.0)
    still_one = np.repeat(look_at(np.array([[1.0, 2, 3]]), np.zeros(3), np.array([0.0, 0, 1])), 3, axis=0)
    capture, _ = prepared(write_capture(tmp_path / "spot", count=3))
    frames = tuple(replace(frame, world_from_camera=pose) for frame, pose in zip(capture.frames, still_one, strict=True))
    within("one spot taken", refused(lambda: given_poses(replace(capture, frames=frames)), PoseError), 0.0)
