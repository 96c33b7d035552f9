"""A small made-up room with exact colours and depths, written as captures; and the command line called in this process."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, opengl_from_world

ROOT = Path(__file__).resolve().parents[2]
HALF = np.array([2.0, 1.5, 2.0])  # half size of the room, metres
TILE = 0.45  # metres
FINE = 2  # samples along each side of a pixel, so that edges are soft as in photos
COLOURS = np.random.default_rng(7).random((32, 32, 32, 3))
CAMERA = Intrinsics(96, 72, 82.5, 82.5, 48.0, 36.0)


def look_at(eye: Array, target: Array) -> Array:
    """world_from_camera (4, 4) of a camera at `eye`; the world's y points down."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def circle(count: int, part: float = 1.0) -> list[Array]:
    """Cameras on (part of) a circle in the room, each looking across its middle."""
    poses = []
    for angle in np.arange(count) / count * 2 * np.pi * part:
        eye = np.array([np.cos(angle), 0.25 * np.sin(3 * angle), np.sin(angle)])
        poses.append(look_at(eye, np.array([0.1, 0.0, -0.1])))
    return poses


def colour_at(points: Array) -> Array:
    """(N, 3) points → (N, 3) RGB in [0, 1]: tiles of many colours with soft waves over them."""
    cells = np.floor(points / TILE + 0.37).astype(np.int64) & 31
    tiles = COLOURS.reshape(-1, 3)[(cells[:, 0] * 32 + cells[:, 1]) * 32 + cells[:, 2]]
    x, y, z = points.T
    waves = np.stack([np.sin(3.1 * x + 1.7 * y - 2.3 * z), np.sin(4.3 * y - 5.1 * x + 1.0), np.sin(3.1 * z + 4.3 * y + 2.0)], axis=1)
    return 0.1 + 0.6 * tiles + 0.1 * (1 + waves)


def shoot(pose: Array, camera: Intrinsics = CAMERA) -> tuple[Array, Array]:
    """(H, W, 3) uint8 RGB and (H, W) float64 depth along z of the room."""
    fine = camera.scaled(camera.width * FINE, camera.height * FINE)
    rgb, _ = trace(pose, fine)
    rgb = rgb.reshape(camera.height, FINE, camera.width, FINE, 3).mean(axis=(1, 3))
    return (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8), trace(pose, camera)[1]


def trace(pose: Array, camera: Intrinsics) -> tuple[Array, Array]:
    """(H, W, 3) RGB and (H, W) depth at the pixels' centres."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    directions, eye = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore"):
        x, y, z = np.maximum((HALF - eye) / directions, (-HALF - eye) / directions).T
    distance = np.minimum(np.minimum(x, y), z)
    return colour_at(eye + directions * distance[:, None]).reshape(*u.shape, 3), distance.reshape(u.shape)


def save_picture(path: Path, rgb: Array) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return path


def make_room(folder: Path, count: int = 12, depth: bool = False, camera: Intrinsics = CAMERA) -> dict[str, Any]:
    """Write the room as transforms.json with pictures (and depth in millimetres); answers the JSON."""
    frames = []
    for index, pose in enumerate(circle(count)):
        rgb, metres = shoot(pose, camera)
        frame: dict[str, Any] = {"file_path": f"images/{index:03d}.png", "transform_matrix": opengl_from_world(pose).tolist()}
        save_picture(folder / frame["file_path"], rgb)
        if depth:
            frame["depth_file_path"] = f"depth/{index:03d}.png"
            (folder / "depth").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / frame["depth_file_path"]), (metres * 1000 + 0.5).astype(np.uint16))
        frames.append(frame)
    data = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "frames": frames}
    write_transforms(folder, data)
    return data


def make_photos(folder: Path, poses: list[Array], camera: Intrinsics) -> Path:
    """Bare photos of the room, nothing known of their cameras."""
    for index, pose in enumerate(poses):
        save_picture(folder / f"{index:02d}.jpg", shoot(pose, camera)[0])
    return folder


def write_transforms(folder: Path, data: dict[str, Any]) -> None:
    (folder / "transforms.json").write_text(json.dumps(data))


@dataclass
class Answer:
    """What a command did."""

    code: int
    out: str
    err: str

    def sentence(self) -> str:
        """The one line of an error, checked to be one and to hold no traceback."""
        lines = [line for line in self.err.splitlines() if line.startswith("fieldfuse: ")]
        assert "Traceback" not in self.err + self.out, self.err
        assert len(lines) == 1 and self.err.rstrip().endswith(lines[0]), self.err
        return lines[0]


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> Answer:
    """`fieldfuse …` in this process."""
    code = _main(arguments)
    shown = capsys.readouterr()
    return Answer(code, shown.out, shown.err)


def said(*arguments: object) -> Answer:
    """`fieldfuse …` in this process, for fixtures of a module or a session, which have no `capsys`."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = _main(arguments)
    return Answer(code, out.getvalue(), err.getvalue())


def bench(capsys: pytest.CaptureFixture[str], name: str, *arguments: object) -> Answer:
    """`python -m benchmarks.NAME …` in this process."""
    code = _main(arguments, f"benchmarks/{name}.py", importlib.import_module(f"benchmarks.{name}").app)
    shown = capsys.readouterr()
    return Answer(code, shown.out, shown.err)


def _main(arguments: tuple[object, ...], program: str = "fieldfuse", *commands: Any) -> int:
    """The exit code."""
    from fieldfuse.pipelines import cli

    with mock.patch.object(sys, "argv", [program, *map(str, arguments)]), pytest.raises(SystemExit) as end:
        cli.main(*commands)
    return int(end.value.code or 0)


def command(*arguments: object) -> list[str]:
    """`fieldfuse …` as a process of its own."""
    return [sys.executable, "-m", "fieldfuse.pipelines.cli", *map(str, arguments)]


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **more}


def spawn(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run `fieldfuse …` as a process of its own until it ends; without bytecode, which a limit on files would cut off."""
    without = {"PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command(*arguments), capture_output=True, text=True, env=environment() | without, **options)
