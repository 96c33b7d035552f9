"""Cameras in the input's frame: `transforms.json` (instant-ngp and nerfstudio) and COLMAP's models, as text and binary."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import FISHEYE, Array, Intrinsics, invert, opengl_from_world
from fieldfuse.errors import InputError
from fieldfuse.export.ply import write_points
from fieldfuse.files import atomic_path, write_json
from fieldfuse.tsdf.mesh import as_bytes

POINTS = "points3D.ply"
LENS_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
MODEL_NUMBERS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}  # COLMAP's
FISHEYE_KEYS = ("k1", "k2", "k3", "k4")


def write_cameras(
    folder: Path | str,
    files: Sequence[str],
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    points: Array | None = None,
    colours: Array | None = None,
    names: Sequence[str] | None = None,
) -> None:
    """Write `folder/transforms.json` and `folder/colmap/{cameras,images,points3D}.txt`; where there are points, `folder/points3D.ply` as
    well, which the json names as other programs look for it.

    Args:
        files: the images' paths.
        intrinsics: one each, lens included.
        world_from_camera: (N, 4, 4) in OpenCV axes.
        points, colours: (P, 3) sparse points and their colours (None: grey).
        names: of the images in COLMAP's model; None: their paths. COLMAP's text ends a name at a space, so spaces become underscores there.

    Raises:
        InputError: lists of different length.
        OutputError: a file cannot be written.
    """
    folder, names = Path(folder), files if names is None else names
    poses = np.asarray(world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    if not len(files) == len(names) == len(intrinsics) == len(poses):
        counts = f"{len(files)} names, {len(intrinsics)} intrinsics and {len(poses)} poses"
        raise InputError(f"cameras need one of each, but there are {counts}; give lists of one length")
    data = transforms(files, intrinsics, poses)
    if points is not None and len(points):
        write_points(folder / POINTS, points, colours)
        data["ply_file_path"] = POINTS
    else:
        (folder / POINTS).unlink(missing_ok=True)
    write_json(folder / "transforms.json", data)
    write_colmap(folder / "colmap", names, intrinsics, poses, points, colours)


def transforms(files: Sequence[str], intrinsics: Sequence[Intrinsics], world_from_camera: Array) -> dict[str, Any]:
    """The `transforms.json` of (N, 4, 4) cameras: OpenGL axes, pixel centres at +0.5, intrinsics shared where all are equal."""
    shared = bool(intrinsics) and all(camera == intrinsics[0] for camera in intrinsics)
    out: dict[str, Any] = _camera_keys(intrinsics[0]) if shared else {}
    # nerfstudio takes one lens model for the file. It does not know FULL_OPENCV, and says so; read as OPENCV, k4 would be another term.
    models = {lens_model(camera) for camera in intrinsics}
    out["camera_model"] = models.pop() if len(models) == 1 else "FULL_OPENCV" if "FULL_OPENCV" in models else "OPENCV"
    if out["camera_model"] == "OPENCV_FISHEYE":
        out["is_fisheye"] = True
    frames = []
    for file, camera, pose in zip(files, intrinsics, opengl_from_world(world_from_camera), strict=True):
        frame: dict[str, Any] = {"file_path": file, "transform_matrix": pose.tolist()}
        if not shared:
            frame.update(_camera_keys(camera))
            if (model := lens_model(camera)) != out["camera_model"]:
                frame.update(camera_model=model, is_fisheye=model == "OPENCV_FISHEYE")
        frames.append(frame)
    out["frames"] = frames
    return out


def write_colmap(
    folder: Path,
    names: Sequence[str],
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    points: Array | None = None,
    colours: Array | None = None,
) -> None:
    """Write COLMAP's three text files; equal intrinsics share a camera. Points have no tracks."""
    numbers: dict[Intrinsics, int] = {}
    for camera in intrinsics:
        numbers.setdefault(camera, len(numbers) + 1)
    camera_lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera, number in numbers.items():
        model, parameters = colmap_model(camera)
        camera_lines.append(f"{number} {model} {camera.width} {camera.height} {_numbers(parameters)}")
    image_lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points (empty)"]
    for number, (name, camera, pose) in enumerate(zip(names, intrinsics, invert(world_from_camera), strict=True), 1):
        row = _numbers([*quaternion(pose[:3, :3]), *pose[:3, 3]])
        image_lines += [f"{number} {row} {numbers[camera]} {'_'.join(name.split())}", ""]
    point_lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    if points is not None:
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        colours = np.full(points.shape, 128, np.uint8) if colours is None else as_bytes(colours)
        for number, (point, colour) in enumerate(zip(points.tolist(), colours.tolist(), strict=True), 1):
            point_lines.append(f"{number} {_numbers(point)} {colour[0]} {colour[1]} {colour[2]} 0")
    for file, lines in (("cameras.txt", camera_lines), ("images.txt", image_lines), ("points3D.txt", point_lines)):
        with atomic_path(folder / file) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_colmap_binary(
    folder: Path,
    names: Sequence[str],
    intrinsics: Sequence[Intrinsics],
    world_from_camera: Array,
    points: Array,
    colours: Array,
) -> None:
    """The same as COLMAP's three binary files (src/colmap/scene/reconstruction_io_binary.cc), which other programs read first."""
    numbers: dict[Intrinsics, int] = {}
    for camera in intrinsics:
        numbers.setdefault(camera, len(numbers) + 1)
    cameras = [struct.pack("<Q", len(numbers))]
    for camera, number in numbers.items():
        model, parameters = colmap_model(camera)
        cameras.append(struct.pack(f"<iiQQ{len(parameters)}d", number, MODEL_NUMBERS[model], camera.width, camera.height, *parameters))
    images = [struct.pack("<Q", len(names))]
    for number, (name, camera, pose) in enumerate(zip(names, intrinsics, invert(world_from_camera), strict=True), 1):
        images.append(struct.pack("<i7di", number, *quaternion(pose[:3, :3]), *pose[:3, 3], numbers[camera]))
        images += [name.encode() + b"\0", struct.pack("<Q", 0)]
    rows = np.zeros(len(points), [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("tracks", "<u8")])
    rows["id"], rows["xyz"], rows["rgb"] = np.arange(1, len(points) + 1), points, colours
    stored = [struct.pack("<Q", len(points)), rows.tobytes()]
    for file, parts in (("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", stored)):
        with atomic_path(folder / file) as temporary:
            temporary.write_bytes(b"".join(parts))


def lens_model(camera: Intrinsics) -> str:
    """The lens model in `transforms.json`: a pinhole is an OPENCV lens without coefficients, and so is one with k1, k2, p1, p2, k3."""
    if camera.lens == FISHEYE:
        return "OPENCV_FISHEYE"
    return "FULL_OPENCV" if any(camera.distortion[5:]) else "OPENCV"


def colmap_model(camera: Intrinsics) -> tuple[str, list[float]]:
    """COLMAP's name and parameters of a camera (the smallest model that holds its lens)."""
    base = [camera.fx, camera.fy, camera.cx, camera.cy]
    if camera.lens == FISHEYE:
        return "OPENCV_FISHEYE", base + _padded(camera.distortion, 4)
    if not camera.distorted:
        return "PINHOLE", base
    if any(camera.distortion[4:]):
        return "FULL_OPENCV", base + _padded(camera.distortion, 8)
    return "OPENCV", base + _padded(camera.distortion, 4)


def quaternion(rotation: Array) -> Array:
    """(w, x, y, z) with w ≥ 0 of a rotation matrix (3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))[[3, 0, 1, 2]]


def _camera_keys(camera: Intrinsics) -> dict[str, Any]:
    out: dict[str, Any] = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    out["camera_angle_x"] = float(2 * np.arctan(camera.width / (2 * camera.fx)))
    out["camera_angle_y"] = float(2 * np.arctan(camera.height / (2 * camera.fy)))
    keys = FISHEYE_KEYS if camera.lens == FISHEYE else LENS_KEYS
    coefficients = _padded(camera.distortion, 4)
    out.update({key: float(value) for key, value in zip(keys, coefficients, strict=False)})
    return out


def _padded(values: Sequence[float], count: int) -> list[float]:
    return [float(value) for value in values] + [0.0] * (count - len(values))


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(repr(float(value)) for value in values)
