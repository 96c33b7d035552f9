"""Stray Scanner, of phones with a depth sensor: `rgb.mp4`, `camera_matrix.csv`, `odometry.csv`, `depth/` and `confidence/`.

A row of `odometry.csv` is a frame of the video: `timestamp, frame, x, y, z, qx, qy, qz, qw` under a header (older recordings: the last
seven alone), world_from_camera in OpenCV axes, metres, y up. Depth and confidence are named by the frame, in millimetres and 0 to 2,
smaller than the video. The matrix has commas, and is for the whole picture, whose corner is (0, 0).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.camera import Array, checked_pose
from toolkit.capture.calibration import from_matrix
from toolkit.capture.listing import assemble, fitted, is_file, picture_header, read_text, require_folder
from toolkit.capture.quaternion import rigid
from toolkit.capture.types import Capture, Frame
from toolkit.capture.video import read_video
from toolkit.errors import InputError, first_line

VIDEO, POSES, LENS = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
VALUES, VALUES_NOW = 7, 9  # numbers a row, in older recordings and since


def looks_like_stray(path: Path) -> bool:
    return all((path / name).is_file() for name in (VIDEO, POSES, LENS))


def read_stray(path: Path | str) -> Capture:
    """The video's frames with their poses and depth, still inside the video (`Capture.filmed`).

    Raises:
        InputError: the video, the poses or the matrix are not usable.
    """
    root = require_folder(path)
    video = read_video(root / VIDEO)
    width, height = int(video.extra["width"]), int(video.extra["height"])
    matrix = _numbers(root / LENS, header=False)
    if matrix.size != 9:
        raise InputError(f"{root / LENS} holds {matrix.size} numbers, a 3×3 matrix is expected; record or export again")
    camera = from_matrix(matrix.reshape(3, 3), width, height, str(root / LENS), shift=0.0)
    table = _numbers(root / POSES, header=True)
    if table.ndim != 2 or table.shape[1] not in (VALUES, VALUES_NOW) or len(table) == 0:
        raise InputError(f"{root / POSES} must hold {VALUES_NOW} numbers a row (time, frame, place, quaternion); record or export again")
    frames = []
    for index, row in enumerate(table[: len(video.frames)]):
        where = f"{root / POSES}, row {index + 1}"
        x, y, z, qx, qy, qz, qw = row[-VALUES:]
        number = _number(row[1], where) if len(row) == VALUES_NOW else index
        depth = next((found for suffix in ("png", "npy") if is_file(found := root / "depth" / f"{number:06d}.{suffix}")), None)
        confidence = root / "confidence" / f"{number:06d}.png"
        frames.append(
            Frame(
                name=f"frame_{index:06d}",
                image=root / VIDEO,
                intrinsics=camera,
                world_from_camera=checked_pose(rigid(np.array([qw, qx, qy, qz]), np.array([x, y, z]), where), where),
                depth=depth,
                depth_intrinsics=None if depth is None else fitted(camera, picture_header(depth).size, str(depth)),
                confidence=confidence if depth is not None and is_file(confidence) else None,
                video_index=index,
            )
        )
    remarks = []
    if abs(len(table) - len(video.frames)) > 1:
        remarks.append(f"the video has {len(video.frames)} frames and {POSES} {len(table)} rows; the first {len(frames)} are used")
    return assemble("stray", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0), extra=dict(video.extra))


def _number(value: float, where: str) -> int:
    if not (value >= 0 and value == int(value)):
        raise InputError(f"{where}: the frame's number is {value:g}; correct or remove this row")
    return int(value)


def _numbers(path: Path, header: bool) -> Array:
    """All rows of a file of numbers with commas, float64 (N, M).

    Raises:
        InputError: missing, not text, a word that is not a finite number, or rows of different length.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if header and lines and any(letter.isalpha() for letter in lines[0].replace("e", "").replace("E", "")):
        lines = lines[1:]
    try:
        rows = [[float(word) for word in line.split(",")] for line in lines]
    except ValueError as error:
        raise InputError(f"{path} must hold numbers with commas between them ({first_line(error)}); check how it was written") from error
    if len({len(row) for row in rows}) > 1 or not np.isfinite(rows).all():
        raise InputError(f"{path} has rows of different length, or numbers that are not finite; check how it was written")
    return np.array(rows, dtype=np.float64)
