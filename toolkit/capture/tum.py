"""TUM RGB-D: `rgb.txt`, `depth.txt`, `groundtruth.txt`, associated by nearest time (20 ms at most).

`groundtruth.txt` has `time tx ty tz qx qy qz qw`, world_from_camera in OpenCV axes, metres, z up. Depth is stored 5000 to the
metre, registered to the colour image. Cameras are those of the set's own calibration page, distinguished by the folder's name.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldfuse.camera import OPENCV, Array, Intrinsics
from fieldfuse.capture.calibration import PRIMESENSE, find_json, posed_frame
from fieldfuse.capture.listing import assemble, counted, read_text, require_folder
from fieldfuse.capture.poses import rigid
from fieldfuse.capture.resolve import DEPTH, CaptureFiles
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

MAX_GAP = 0.02  # seconds
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
        best = int(np.argmin(np.abs(self.times - time)))
        return self.values[best] if abs(self.times[best] - time) <= MAX_GAP else None


def looks_like_tum(path: Path) -> bool:
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read_tum(path: Path | str) -> Capture:
    """RGB-D frames that have a pose near in time. Images without one, or that do not exist, are counted and left out.

    Raises:
        InputError: a list is not readable, no image has a pose, or a pose is not usable.
    """
    root = require_folder(path)
    colours = _read_list(root / "rgb.txt", 1)
    poses = _read_list(root / "groundtruth.txt", 7)
    depths = _read_list(root / "depth.txt", 1) if (root / "depth.txt").is_file() else _Listing(np.zeros(0), [])
    camera, warnings = _camera(root)
    folder = CaptureFiles(root)
    found = folder.find([listed for listed, *_ in colours.values], source="rgb.txt")
    total = len(colours.values)
    if not found.count:
        raise folder.none_exists("rgb.txt", total, found)
    there = [(time, image) for time, image in zip(colours.times, found.files, strict=True) if image is not None]
    posed = [(time, image, pose) for time, image in there if (pose := poses.nearest(time)) is not None]
    listed_depth = [None if (entry := depths.nearest(time)) is None else entry[0] for time, *_ in posed]
    maps, remarks = folder.find_beside(listed_depth, DEPTH, [image for _, image, _ in posed], "depth.txt")
    frames = []
    for (time, image, words), depth in zip(posed, maps, strict=True):
        where = f"{root / 'groundtruth.txt'} at {time:.4f} s"
        try:
            values = np.array([float(word) for word in words[:7]])
        except ValueError as error:
            raise InputError(f"{where}: the pose holds a word that is not a number; correct or remove this line") from error
        frames.append(posed_frame("", image, camera, rigid(values[[6, 3, 4, 5]], values[:3], where), where, depth))
    if not frames:
        raise InputError(
            f"none of the {counted(total, 'image')} in {root / 'rgb.txt'} has both a file and "
            f"a pose within {MAX_GAP * 1000:.0f} ms; check the three lists"
        )
    warnings += [*found.remarks, *remarks]
    gone = maps.count(None) - listed_depth.count(None)
    if gone:
        warnings.append(f"{counted(gone, 'listed depth image')} not found")
    missing, unposed = total - found.count, found.count - len(posed)
    if missing:
        warnings.append(f"{missing} of the {total} listed images do not exist; the others are used")
    if unposed:
        warnings.append(f"{unposed} of the {total} listed images have no pose within {MAX_GAP * 1000:.0f} ms and are left out")
    extra = {"listed": total, "missing": missing, "unposed": unposed}
    return assemble("tum", root, frames, warnings, ordered=True, metric=True, depth_scale=5000.0, up=(0.0, 0.0, 1.0), extra=extra)


def _camera(root: Path) -> tuple[Intrinsics, list[str]]:
    found = find_json(root)
    if found is not None:
        return found[0], []
    name = root.name.lower()
    for key, camera in CAMERAS.items():
        if key in name or f"fr{key[-1]}" in name:
            return camera, []
    return PRIMESENSE, ["the folder's name does not show which TUM camera it is (freiburg1, 2 or 3); the default of 525 pixels is used"]


def _read_list(path: Path, values: int) -> _Listing:
    entries: list[tuple[float, list[str]]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time = float(words[0])
        except ValueError:
            time = np.nan
        if not np.isfinite(time) or len(words) < 1 + values:
            raise InputError(f"{path}, line {number}: a time and {counted(values, 'value')} are expected; correct or remove this line")
        entries.append((time, words[1:]))
    if not entries:
        raise InputError(f"{path} lists nothing; check how it was written")
    entries.sort(key=lambda entry: entry[0])
    return _Listing(np.array([time for time, _ in entries]), [words for _, words in entries])
