"""Folders in the layouts that data sets are published in, made small: a plane with a picture on it, seen by a row of cameras."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert, opengl_from_world

DEPTH = 2.0  # of the plane z = 0 from the cameras' row


def camera(width: int, height: int) -> Intrinsics:
    return Intrinsics(width, height, 0.9 * width, 0.9 * width, width / 2 + 0.7, height / 2 - 0.4)


def poses(count: int, unit: float = 1.0) -> Array:
    """Cameras in a row that look along +z at the plane z = 2 units."""
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, 0, 3] = np.linspace(-0.3, 0.3, count) * unit
    return out


def picture(number: int, width: int, height: int, channels: int = 3) -> Array:
    """(height, width, channels) uint8 that tells its number: red is 10 times it."""
    out = np.random.default_rng(number).integers(0, 255, (height, width, channels), dtype=np.uint8)
    out[..., 2] = 10 * number  # OpenCV's order: red
    if channels == 4:
        out[..., 3] = 255
    return out


def write(path: Path, image: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_matrix(path: Path, matrix: Array, one_line: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix.reshape(1, -1) if one_line else matrix, fmt="%.9g")


def scannet(root: Path, scenes: int = 2, frames: int = 8) -> Path:
    for scene in range(scenes):
        folder = root / "scans" / f"scene{scene:04d}_00"
        colour, depth = camera(64, 48), camera(32, 24)
        for name, c in (("color", colour), ("depth", depth)):
            matrix = np.eye(4)
            matrix[:3, :3] = c.matrix_integer_centres()
            write_matrix(folder / "intrinsic" / f"intrinsic_{name}.txt", matrix)
        for i, pose in enumerate(poses(frames)):
            write(folder / "color" / f"{i}.jpg", picture(i, 64, 48))
            write(folder / "depth" / f"{i}.png", np.full((24, 32), 1000 * DEPTH, np.uint16))
            write_matrix(folder / "pose" / f"{i}.txt", pose)
    return root


def dtu(root: Path, views: int = 6, scans: tuple[int, ...] = (1, 4), lights: tuple[int, ...] = (0, 3), full_depth: bool = False) -> Path:
    """MVSNet's rectified layout at its true sizes, millimetres."""
    matrix = np.array([[361.5, 0, 82.9], [0, 360.4, 66.4], [0, 0, 1.0]])  # for 160×128
    for view, pose in enumerate(poses(views, unit=200.0)):
        lines = ["extrinsic"] + [" ".join(f"{x:.9g}" for x in row) for row in invert(pose)]
        lines += ["", "intrinsic"] + [" ".join(f"{x:.9g}" for x in row) for row in matrix] + ["", "425.0 2.5"]
        path = root / "Cameras" / "train" / f"{view:08d}_cam.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        for scan in scans:
            for light in lights:
                write(root / "Rectified" / f"scan{scan}_train" / f"rect_{view + 1:03d}_{light}_r5000.png", picture(view, 640, 512))
            size = (1200, 1600) if full_depth else (128, 160)
            folder = f"scan{scan}" if full_depth else f"scan{scan}_train"
            write(root / "Depths" / folder / f"depth_map_{view:04d}.pfm", np.full(size, 200 * DEPTH, np.float32))
    return root


def scanned_objects(root: Path, objects: int = 2, views: int = 8) -> Path:
    for number in range(objects):
        folder = root / f"object_{number}"
        matrix = np.eye(4)
        matrix[:3, :3] = camera(32, 32).matrix_integer_centres()
        for i, pose in enumerate(poses(views)):
            pose = pose.copy()
            pose[2, 3] = -DEPTH  # the object is at the origin
            write(folder / "rgb" / f"{i:03d}.png", picture(i, 32, 32))
            write_matrix(folder / "pose" / f"{i:03d}.txt", pose, one_line=True)
            write_matrix(folder / "intrinsics" / f"{i:03d}.txt", matrix, one_line=True)
    return root


def synthetic(root: Path, scenes: tuple[str, ...] = ("chair", "drums"), views: int = 8) -> Path:
    for scene in scenes:
        for split, count in (("train", views), ("test", 2)):
            frames = []
            for i, pose in enumerate(poses(count)):
                pose = pose.copy()
                pose[2, 3] = -DEPTH
                number = i if split == "train" else 20 + i
                write(root / scene / split / f"r_{i}.png", picture(number, 32, 32, 4))
                frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": opengl_from_world(pose).tolist()})
            data = {"camera_angle_x": 0.7, "frames": frames}
            (root / scene / f"transforms_{split}.json").write_text(json.dumps(data), encoding="utf-8")
    return root
