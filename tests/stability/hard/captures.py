"""Small captures for tests, in memory and in files: textured, and with little or nothing to see."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, Similarity, opengl_from_world
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import CaptureSettings
from fieldfuse.poses.scene import Scene
from fieldfuse.render.paths import look_at

CAMERA = Intrinsics(40, 32, 44.0, 44.0, 20.0, 16.0)
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


def noise(index: int, height: int, width: int) -> Array:
    return np.asarray(np.random.default_rng(index).integers(0, 255, (height, width, 3)), dtype=np.uint8)


def views_of(paint: Paint, count: int = 6, tested: int = 0, alpha: bool = False) -> Views:
    """Views on an arc, the first `tested` held out; with `alpha` nothing is opaque."""
    pictures = [paint(index, CAMERA.height, CAMERA.width) for index in range(count)]
    views = Views([str(i) for i in range(count)], pictures, [CAMERA] * count, poses(count), np.arange(count) < tested)
    if alpha:
        views.alpha, views.background = [np.zeros(pictures[0].shape[:2], np.uint8)] * count, (1.0, 1.0, 1.0)
    return views


def scene_of(half: Array | None = None, centre: Array | None = None, background: bool = False) -> Scene:
    half = np.full(3, 1.2) if half is None else half
    return Scene(Similarity.identity(), np.zeros(3) if centre is None else centre, half, 3.0, 0.5, 6.0, 0.1, background, True)
