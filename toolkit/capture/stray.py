"""Stray Scanner, of phones with a depth sensor: `rgb.mp4`, `camera_matrix.csv`, `odometry.csv`, `depth/` and `confidence/`.

A row of `odometry.csv` is a frame of the video: `timestamp, frame, x, y, z, qx, qy, qz, qw` under a header (older recordings: the last
seven alone; newer ones: then `fx, fy, cx, cy` of this frame, and more), world_from_camera in OpenCV axes, metres, y up. Depth and
confidence are named by the frame, in millimetres and 0 to 2, smaller than the video. The matrix has commas, and is for the whole
image, whose corner is (0, 0).

The video is read as it is stored. The app stamps its first frame with a time before zero, so players leave it out, and players turn
older recordings upright, while matrix and depth are for the sensor's own, lying images.
"""

from __future__ import annotations

from pathlib import Path

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.calibration import fitted, from_matrix
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, is_file, numbers, read_text, require_folder
from fieldfuse.capture.poses import checked_pose, rigid, single_frame
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.video import read_video
from fieldfuse.errors import InputError

VIDEO, POSES, LENS = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
POSE, CAMERA = ("x", "y", "z", "qx", "qy", "qz", "qw"), ("fx", "fy", "cx", "cy")
COLUMNS = ("frame", *POSE, *CAMERA)


def looks_like_stray(path: Path) -> bool:
    return all((path / name).is_file() for name in (VIDEO, POSES, LENS))


def read_stray(path: Path | str) -> Capture:
    """The video's frames with their poses and depth, still inside the video (`Capture.filmed`).

    Raises:
        InputError: the video, the poses or the matrix are not usable.
    """
    root = require_folder(path)
    video = read_video(root / VIDEO, as_stored=True)
    size = int(video.extra["width"]), int(video.extra["height"])
    words = [word for line in read_text(root / LENS).splitlines() if line.strip() for word in line.split(",")]
    lens = str(root / LENS)
    shared = from_matrix(numbers(words, lens, 9, "a 3×3 matrix is expected").reshape(3, 3), *size, lens, shift=0.0)
    rows = _rows(root / POSES)
    frames = []
    for index, row in enumerate(rows[: len(video.frames)]):
        name = f"frame_{index:06d}"
        with single_frame(name):
            frames.append(_frame(root, row, index, shared))
    remarks = []
    if len(rows) != len(video.frames):
        remarks.append(
            f"the video has {len(video.frames)} frames and {POSES} {len(rows)} rows; the first {min(len(rows), len(video.frames))} are "
            "used, and if others are missing than the last, images and poses do not belong together, and --poses sfm finds others"
        )
    return assemble("stray", root, frames, remarks, ordered=True, metric=True, up=(0.0, 1.0, 0.0), extra=dict(video.extra))


def _frame(root: Path, row: dict[str, str], index: int, shared: Intrinsics) -> Frame:
    """The frame of a row (name of a column → word). Only the camera may be empty; what is not used may hold anything."""
    where = f"{root / POSES}, row {index + 1}"
    values = numbers([row[name] for name in POSE], where)
    number = float(numbers([row["frame"]], where)[0]) if "frame" in row else float(index)
    if not (number >= 0 and number == int(number)):
        raise InputError(f"{where}: the frame's number is {number:g}; correct or remove this row")
    camera = shared
    if all(row.get(name) for name in CAMERA):
        own = numbers([row[name] for name in CAMERA], where).tolist()
        camera = Intrinsics(shared.width, shared.height, *own).checked(where)
    file = f"{int(number):06d}"
    depth = next((found for suffix in ("png", "npy") if is_file(found := root / "depth" / f"{file}.{suffix}")), None)
    confidence = root / "confidence" / f"{file}.png"
    return Frame(
        name=f"frame_{index:06d}",
        image=root / VIDEO,
        intrinsics=camera,
        world_from_camera=checked_pose(rigid(values[[6, 3, 4, 5]], values[:3], where), where),
        depth=depth,
        depth_intrinsics=None if depth is None else fitted(camera, image_header(depth).size, str(depth)),
        confidence=confidence if depth is not None and is_file(confidence) else None,
        video_index=index,
        as_stored=True,
    )


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of `odometry.csv`, at least one, each as name of a column → word."""
    lines = [[word.strip() for word in line.split(",")] for line in read_text(path).splitlines() if line.strip()]
    header: list[str] = []
    if lines and any(letter.isalpha() for word in lines[0] for letter in word.lower().replace("e", "")):
        header = [word.lower() for word in lines.pop(0)]
    count, named = len(lines[0]) if lines else 0, set(POSE) <= set(header)
    columns: dict[str, int] = {}  # by the header's names, else by how many numbers a row has
    if named:
        columns = {name: header.index(name) for name in COLUMNS if name in header}
    elif count == len(POSE):
        columns = {name: place for place, name in enumerate(POSE)}
    elif count == 2 + len(POSE) or count > len(COLUMNS):
        columns = {name: place for place, name in enumerate(COLUMNS[: count - 1], start=1)}
    if not columns or not lines:
        raise InputError(f"{path} must hold {2 + len(POSE)} numbers a row (time, frame, place, quaternion); record or export again")
    needed = 1 + max(columns[name] for name in ("frame", *POSE) if name in columns)
    if any(len(line) < needed if named else len(line) != count for line in lines):
        raise InputError(f"{path} has rows of different length; check how it was written")
    return [{name: line[place] for name, place in columns.items() if place < len(line)} for line in lines]
