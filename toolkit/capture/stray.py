"""Stray Scanner, of phones with a depth sensor: `rgb.mp4`, `camera_matrix.csv`, `odometry.csv`, `depth/` and `confidence/`.

A row of `odometry.csv` is a frame of the video: `timestamp, frame, x, y, z, qx, qy, qz, qw` under a header (older recordings: the last
seven alone; newer ones: then `fx, fy, cx, cy` of this frame, and more), world_from_camera in OpenCV axes, metres, y up. Depth and
confidence are named by the frame, in millimetres and 0 to 2, smaller than the video. The matrix has commas, and is for the whole
picture, whose corner is (0, 0).

The video is read as it is stored. The app stamps its first frame with a time before zero, so that players are told to leave it out, and
older recordings are told to be shown upright, while matrix and depth are for the sensor's own, lying pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.calibration import from_matrix
from fieldfuse.capture.listing import assemble, is_file, read_text, require_folder
from fieldfuse.capture.poses import checked_pose, rigid, single_frame
from fieldfuse.capture.sizes import fitted, picture_header
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.video import read_video
from fieldfuse.errors import InputError, first_line

VIDEO, POSES, LENS = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
NUMBER, POSE, CAMERA = "frame", ("x", "y", "z", "qx", "qy", "qz", "qw"), ("fx", "fy", "cx", "cy")
VALUES, VALUES_NOW = len(POSE), 2 + len(POSE)  # numbers a row, in older recordings and since
WITH_CAMERA = VALUES_NOW + len(CAMERA)  # numbers a row at least, where frames have their own camera


@dataclass(frozen=True)
class Row:
    """What is used of a frame's row."""

    number: int  # of its depth and confidence
    pose: Array  # (4, 4) float64 world_from_camera
    camera: tuple[float, float, float, float] | None  # fx, fy, cx, cy in pixels of the video; None: not told


def looks_like_stray(path: Path) -> bool:
    return all((path / name).is_file() for name in (VIDEO, POSES, LENS))


def read_stray(path: Path | str) -> Capture:
    """The video's frames with their poses and depth, still inside the video (`Capture.filmed`).

    Raises:
        InputError: the video, the poses or the matrix are not usable.
    """
    root = require_folder(path)
    video = read_video(root / VIDEO, as_stored=True)
    width, height = int(video.extra["width"]), int(video.extra["height"])
    shared = from_matrix(_matrix(root / LENS), width, height, str(root / LENS), shift=0.0)
    rows = _rows(root / POSES)
    frames = []
    for index, row in enumerate(rows[: len(video.frames)]):
        if row is None:
            continue
        camera = shared if row.camera is None else Intrinsics(width, height, *row.camera).checked(_where(root / POSES, index))
        depth = next((found for suffix in ("png", "npy") if is_file(found := root / "depth" / f"{row.number:06d}.{suffix}")), None)
        confidence = root / "confidence" / f"{row.number:06d}.png"
        frames.append(
            Frame(
                name=f"frame_{index:06d}",
                image=root / VIDEO,
                intrinsics=camera,
                world_from_camera=row.pose,
                depth=depth,
                depth_intrinsics=None if depth is None else fitted(camera, picture_header(depth).size, str(depth)),
                confidence=confidence if depth is not None and is_file(confidence) else None,
                video_index=index,
                as_stored=True,
            )
        )
    remarks = []
    if len(rows) != len(video.frames):
        remarks.append(
            f"the video has {len(video.frames)} frames and {POSES} {len(rows)} rows; the first {min(len(rows), len(video.frames))} are "
            "used, and if others are missing than the last, pictures and poses do not belong together, and --poses sfm finds others"
        )
    return assemble("stray", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0), extra=dict(video.extra))


def _rows(path: Path) -> list[Row | None]:
    """The rows of `odometry.csv`, at least one; None where one cannot be read.

    Raises:
        InputError: missing, not text, a word that is not a finite number, rows of different length, or too few numbers a row.
    """
    lines = [[word.strip() for word in line.split(",")] for line in read_text(path).splitlines() if line.strip()]
    header: list[str] = []
    if lines and any(letter.isalpha() for word in lines[0] for letter in word.lower().replace("e", "")):
        header = [word.lower() for word in lines.pop(0)]
    columns = _columns(header, len(lines[0]) if lines else 0)
    if columns is None or not lines:
        raise InputError(f"{path} must hold {VALUES_NOW} numbers a row (time, frame, place, quaternion); record or export again")
    named = set(POSE) <= set(header)
    needed = 1 + max(columns[name] for name in (*POSE, NUMBER) if name in columns)
    if any(len(line) < needed if named else len(line) != len(lines[0]) for line in lines):
        raise InputError(f"{path} has rows of different length; check how it was written")
    rows: list[Row | None] = [None] * len(lines)
    for index, line in enumerate(lines):
        with single_frame(f"frame_{index:06d}"):
            rows[index] = _row(line, columns, index, _where(path, index))
    return rows


def _columns(header: list[str], count: int) -> dict[str, int] | None:
    """Where what is used stands: by the header's names, else by how many numbers a row has. None where neither tells."""
    if set(POSE) <= set(header):
        return {name: header.index(name) for name in (NUMBER, *POSE, *CAMERA) if name in header}
    if count == VALUES:
        return {name: place for place, name in enumerate(POSE)}
    if count == VALUES_NOW or count >= WITH_CAMERA:
        return {name: place for place, name in enumerate((NUMBER, *POSE, *CAMERA)[: count - 1], start=1)}
    return None


def _row(line: list[str], columns: dict[str, int], index: int, where: str) -> Row:
    """One row. Only the camera may be left empty; what is not used may hold anything."""
    words = {name: line[place] for name, place in columns.items() if place < len(line)}
    given = all(words.get(name) for name in CAMERA)
    x, y, z, qx, qy, qz, qw = _finite([words[name] for name in POSE], where)
    number = _finite([words[NUMBER]], where)[0] if NUMBER in words else index
    if not (number >= 0 and number == int(number)):
        raise InputError(f"{where}: the frame's number is {number:g}; correct or remove this row")
    pose = checked_pose(rigid(np.array([qw, qx, qy, qz]), np.array([x, y, z]), where), where)
    if not given:
        return Row(int(number), pose, None)
    fx, fy, cx, cy = _finite([words[name] for name in CAMERA], where)
    return Row(int(number), pose, (fx, fy, cx, cy))


def _matrix(path: Path) -> Array:
    """The (3, 3) float64 camera matrix in a file of numbers with commas.

    Raises:
        InputError: missing, not text, a word that is not a finite number, or another number of them.
    """
    words = [word for line in read_text(path).splitlines() if line.strip() for word in line.split(",")]
    numbers = _finite(words, str(path))
    if len(numbers) != 9:
        raise InputError(f"{path} holds {len(numbers)} numbers, a 3×3 matrix is expected; record or export again")
    return np.array(numbers, dtype=np.float64).reshape(3, 3)


def _finite(words: list[str], where: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{where} must hold numbers with commas between them ({first_line(error)}); check how it was written") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{where} holds numbers that are not finite; check how it was written")
    return numbers


def _where(path: Path, index: int) -> str:
    return f"{path}, row {index + 1}"
