"""Captures that break readers: nothing to see, too much light, one pixel, no opacity, single rows, 2,000 frames."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Similarity, opengl_from_world
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.evaluation.selftest.case import Measure, absolute, case, not_finite, refused
from fieldfuse.render.paths import look_at

GROUP = "data"
Paint = Callable[[int, int, int], Array]


def texture(index: int, height: int, width: int) -> Array:
    """(H, W, 3) uint8 waves that move with the index."""
    v, u = np.mgrid[0:height, 0:width]
    waves = [np.sin(0.31 * u + 0.17 * v + 0.9 * index + phase) * np.cos(0.23 * v - 0.11 * u + phase) for phase in (0, 1.1, 2.3)]
    return np.asarray(np.round(127 + 120 * np.stack(waves, axis=2)), dtype=np.uint8)


def poses(count: int) -> Array:
    angle = np.linspace(0, 1.5, count)
    at = 3 * np.stack([np.cos(angle), np.sin(angle), np.full(count, 0.4)], axis=1)
    return look_at(at, np.zeros(3), np.array([0.0, 0.0, 1.0]))


def write_capture(
    folder: Path,
    paint: Paint = texture,
    count: int = 6,
    height: int = 32,
    width: int = 40,
    depth: Callable[[int], Array] | None = None,
) -> Path:
    """A `transforms.json` capture with pictures by `paint` and depth by `depth` (uint16 as PNG, floating point as .npy)."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, pose in enumerate(opengl_from_world(poses(count))):
        picture = paint(index, height, width)
        name = f"{index:04d}.png"
        cv2.imwrite(str(folder / name), picture[..., [2, 1, 0, 3]] if picture.shape[2] == 4 else picture[..., ::-1])
        frame = {"file_path": name, "transform_matrix": pose.tolist()}
        if depth is not None:
            values = depth(index)
            frame["depth_file_path"] = f"depth{index:04d}." + ("png" if values.dtype == np.uint16 else "npy")
            if values.dtype == np.uint16:
                cv2.imwrite(str(folder / frame["depth_file_path"]), values)
            else:
                np.save(folder / frame["depth_file_path"], values)
        frames.append(frame)
    data = {"w": width, "h": height, "fl_x": 1.1 * width, "fl_y": 1.1 * width, "cx": width / 2, "cy": height / 2, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def prepared(folder: Path, holdout: int = 0, size: int | None = None) -> tuple[Capture, Views]:
    """Read, look at and prepare a capture, as a run does."""
    capture = check_capture(open_capture(folder))
    return capture, prepare_views(capture, Similarity.identity(), CaptureSettings(image_size=size, holdout=holdout))


def fine_or_refused(folder: Path) -> list[Measure]:
    """A capture is prepared with finite numbers, or refused in a sentence."""
    try:
        _, views = prepared(folder)
    except FieldfuseError as error:
        return [Measure("refused without a sentence", float("\n" in str(error) or len(str(error)) < 20), 0.0)]
    depths = [depth for depth in views.depths if depth is not None]
    return [Measure("values that are not finite", not_finite(views.world_from_camera, *depths), 0.0)]


def flat(value: int) -> Paint:
    return lambda index, height, width: np.full((height, width, 3), value, np.uint8)


def saturated(index: int, height: int, width: int) -> Array:
    return np.asarray(np.minimum(texture(index, height, width).astype(int) * 3, 255), dtype=np.uint8)


def one_pixel(index: int, height: int, width: int) -> Array:
    out = np.zeros((height, width, 3), np.uint8)
    out[height // 2, (width // 2 + index) % width] = 255
    return out


def no_opacity(index: int, height: int, width: int) -> Array:
    return np.dstack([texture(index, height, width), np.zeros((height, width), np.uint8)])


@case(GROUP, "black, white and grey pictures are refused")
def constant(folder: Path) -> list[Measure]:
    out = []
    for value in (0, 128, 255):
        path = write_capture(folder / str(value), flat(value))
        out.append(Measure(f"pictures of {value} taken", refused(partial(prepared, path), InputError, "picture"), 0.0))
    return out


@case(GROUP, "some constant, saturated, one bright pixel, alpha all 0")
def awkward_pictures(folder: Path) -> list[Measure]:
    def some_flat(index: int, height: int, width: int) -> Array:
        return flat(0)(index, height, width) if index % 3 == 0 else texture(index, height, width)

    out = []
    for paint in (some_flat, saturated, one_pixel, no_opacity):
        path = write_capture(folder / paint.__name__, paint)
        out += [Measure(f"{paint.__name__.replace('_', ' ')}: {m.quantity}", m.error, m.bound) for m in fine_or_refused(path)]
    capture, views = prepared(folder / "some_flat")
    out.append(Measure("constant pictures not told", float(not any("one colour" in text for text in capture.warnings)), 0.0))
    try:
        _, white = prepared(folder / "no_opacity")
        out.append(Measure("colour behind alpha 0", absolute(np.array(white.images), np.full_like(np.array(white.images), 255)), 0.0))
    except InputError as error:
        out.append(Measure("alpha all 0 refused without a sentence", float("\n" in str(error)), 0.0))
    out.append(Measure("pictures lost", abs(len(views) - 6.0), 0.0))
    return out


@case(GROUP, "single rows, single columns, one pixel a picture")
def thin_pictures(folder: Path) -> list[Measure]:
    out = []
    for height, width in ((1, 64), (64, 1), (1, 1), (2, 300)):

        def paint(index: int, height: int, width: int) -> Array:
            return np.asarray(np.random.default_rng(index).integers(0, 255, (height, width, 3)), dtype=np.uint8)

        path = write_capture(folder / f"{width}x{height}", paint, 4, height, width)
        out += [Measure(f"{width}×{height}: {m.quantity}", m.error, m.bound) for m in fine_or_refused(path)]
        for size in (16, 40):
            try:
                _, views = prepared(path, size=size)
            except InputError:
                continue
            small = [image.shape for image in views.images]
            wrong = sum(min(shape[:2]) < 1 or max(shape[:2]) > max(size, 1) for shape in small)
            out.append(Measure(f"{width}×{height} at {size}: pictures of a wrong size", float(wrong), 0.0))
    return out


@case(GROUP, "one training view, no training view, no test view, two frames")
def few_views(folder: Path) -> list[Measure]:
    path = write_capture(folder / "two", count=2)
    _, views = prepared(path, holdout=2)
    _, none = prepared(path, holdout=0)
    one = write_capture(folder / "one", count=1)
    return [
        Measure("training views of two frames, holdout 2", abs(float((~views.test).sum()) - 1), 0.0),
        Measure("test views with holdout 0", float(none.test.sum()), 0.0),
        Measure("one picture taken", refused(lambda: prepared(one), InputError, "one picture"), 0.0),
    ]


@case(GROUP, "2,000 frames", slow=True)
def many_frames(folder: Path) -> list[Measure]:
    path = write_capture(folder / "many", count=2000, height=24, width=32)
    capture, views = prepared(path, holdout=8)
    return [
        Measure("frames lost", abs(len(capture.frames) - 2000.0) + abs(len(views) - 2000.0), 0.0),
        Measure("frames out of order", float(capture.frames[1999].name != "1999"), 0.0),
        Measure("test views, beyond 250", abs(float(views.test.sum()) - 250), 0.0),
        Measure("values that are not finite", not_finite(views.world_from_camera), 0.0),
        Measure("worst pose", absolute(views.world_from_camera, poses(2000)), 1e-12),
    ]


@case(GROUP, "numbers at the edge of float64 in a transforms.json")
def extreme_numbers(folder: Path) -> list[Measure]:
    out = []
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
        path = write_capture(folder / name.replace(" ", "_"), count=3)
        data = json.loads((path / "transforms.json").read_text())
        data.update(change)
        if name.startswith("place"):
            for frame in data["frames"]:
                frame["transform_matrix"][0][3] = float(name.split()[1])
        (path / "transforms.json").write_text(json.dumps(data))
        with np.errstate(all="ignore"):
            measures = fine_or_refused(path)
        out += [Measure(f"{name}: {m.quantity}", m.error, m.bound) for m in measures]
    assert math.isfinite(sum(measure.error for measure in out))
    return out
