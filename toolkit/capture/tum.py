"""TUM RGB-D: `rgb.txt`, `depth.txt`, `groundtruth.txt`, associated by nearest time (20 ms at most).

`groundtruth.txt` has `time tx ty tz qx qy qz qw`, world_from_camera in OpenCV axes, metres, z up. Depth is stored 5000 to the
metre, registered to the colour picture. Cameras are those of the set's own calibration page, told apart by the folder's name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldfuse.camera import OPENCV, Array, Intrinsics
from fieldfuse.capture.calibration import PRIMESENSE, find_json
from fieldfuse.capture.listing import assemble, counted, posed_frame, read_text, require_folder, unique_names
from fieldfuse.capture.poses import rigid
from fieldfuse.capture.resolve import DEPTH, CaptureFiles
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

MAX_GAP = 0.02  # seconds
DEPTH_SCALE = 5000.0
CAMERAS = {
    "freiburg1": Intrinsics(640, 480, 517.3, 516.5, 319.1, 255.8, OPENCV, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": Intrinsics(640, 480, 520.9, 521.0, 325.6, 250.2, OPENCV, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": Intrinsics(640, 480, 535.4, 539.2, 320.6, 248.1),
}


@dataclass(frozen=True)
class _Listing:
    times: Array  # (N,) seconds, ascending
    values: list[list[str]]

    def nearest(self, time: float) -> list[str] | None:
        """The entry nearest in time, None when none is near enough."""
        if len(self.times) == 0:
            return None
        at = int(np.searchsorted(self.times, time))
        best = min((i for i in (at - 1, at) if 0 <= i < len(self.times)), key=lambda i: abs(self.times[i] - time))
        return self.values[best] if abs(self.times[best] - time) <= MAX_GAP else None


def looks_like_tum(path: Path) -> bool:
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read_tum(path: Path | str) -> Capture:
    """RGB-D frames that have a pose near in time. Pictures without one, or that do not exist, are counted and left out.

    Raises:
        InputError: a list is not readable, no picture has a pose, or a pose is not usable.
    """
    root = require_folder(path)
    colours = _read_list(root / "rgb.txt", 1)
    poses = _read_list(root / "groundtruth.txt", 7)
    depths = _read_list(root / "depth.txt", 1) if (root / "depth.txt").is_file() else _Listing(np.zeros(0), [])
    camera, warnings = _camera(root)
    folder = CaptureFiles(root)
    found = folder.find([listed for listed, *_ in colours.values], source="rgb.txt")
    if not found.count:
        raise folder.none_exists("rgb.txt", len(colours.values), found)
    there = [(time, image) for time, image in zip(colours.times, found.files, strict=True) if image is not None]
    posed = [(time, image, pose) for time, image in there if (pose := poses.nearest(time)) is not None]
    images = [image for _, image, _ in posed]
    listed_depth = [None if (entry := depths.nearest(time)) is None else entry[0] for time, *_ in posed]
    maps, remarks = folder.find_beside(listed_depth, DEPTH, images, "depth.txt")
    frames: list[Frame] = []
    for (time, image, pose), depth in zip(posed, maps, strict=True):
        where = f"{root / 'groundtruth.txt'} at {time:.4f} s"
        frames.append(posed_frame("", image, camera, _pose(pose, where), where, depth))
    total = len(colours.values)
    if not frames:
        raise InputError(
            f"none of the {counted(total, 'picture')} in {root / 'rgb.txt'} has both a file and "
            f"a pose within {MAX_GAP * 1000:.0f} ms; check the three lists"
        )
    warnings += [*found.remarks, *remarks]
    gone = maps.count(None) - listed_depth.count(None)
    if gone:
        warnings.append(f"{counted(gone, 'listed depth picture')} not found")
    missing, unposed = total - found.count, found.count - len(posed)
    if missing:
        warnings.append(f"{missing} of the {total} listed pictures do not exist; the others are used")
    if unposed:
        warnings.append(f"{unposed} of the {total} listed pictures have no pose within {MAX_GAP * 1000:.0f} ms and are left out")
    named = [replace(frame, name=name) for frame, name in zip(frames, unique_names(images), strict=True)]
    extra = {"listed": total, "missing": missing, "unposed": unposed}
    return assemble("tum", root, named, warnings, ordered=True, metric=True, depth_scale=DEPTH_SCALE, up=(0.0, 0.0, 1.0), extra=extra)


def _camera(root: Path) -> tuple[Intrinsics, list[str]]:
    found = find_json(root)
    if found is not None:
        return found[0], []
    name = root.name.lower()
    for key, camera in CAMERAS.items():
        if key in name or f"fr{key[-1]}" in name:
            return camera, []
    return PRIMESENSE, ["the folder's name does not tell which TUM camera it is (freiburg1, 2 or 3); the default of 525 pixels is used"]


def _read_list(path: Path, values: int) -> _Listing:
    entries: list[tuple[float, list[str]]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time = float(words[0])
        except ValueError:
            time = float("nan")
        if not np.isfinite(time) or len(words) < 1 + values:
            raise InputError(f"{path}, line {number}: a time and {counted(values, 'value')} are expected; correct or remove this line")
        entries.append((time, words[1:]))
    if not entries:
        raise InputError(f"{path} lists nothing; check how it was written")
    entries.sort(key=lambda entry: entry[0])
    return _Listing(np.array([time for time, _ in entries]), [words for _, words in entries])


def _pose(words: list[str], where: str) -> Array:
    try:
        x, y, z, qx, qy, qz, qw = (float(word) for word in words[:7])
    except ValueError as error:
        raise InputError(f"{where}: the pose holds a word that is not a number; correct or remove this line") from error
    return rigid(np.array([qw, qx, qy, qz]), np.array([x, y, z]), where)
