"""Frames of a video written as pictures: as JPEG, or as the JPEG that a `.sens` file holds, with their depth as PNG."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import cv2

from toolkit.camera import Array
from toolkit.capture.sens import JPEG, is_sens, scan
from toolkit.capture.sens_frames import sens_bytes, sens_depth
from toolkit.capture.video import iterate_video
from toolkit.errors import InputError, OutputError
from toolkit.files import atomic_path, fingerprint, read_json, write_json
from toolkit.progress import Progress

VERSION = 1  # of what is measured and written
QUALITY = 97
DEPTH = "depth"  # folder beside the pictures


def origin(video: Path, as_stored: bool) -> list[Any]:
    """What tells this video's frames from others."""
    return [VERSION, video, *(["as stored"] if as_stored else [])]


def picture_at(folder: Path, index: int) -> Path:
    """Where frame `index` is written."""
    return folder / f"frame_{index:06d}.jpg"


def depth_at(folder: Path, index: int) -> Path:
    """Where its depth is written, if the video holds it."""
    return folder / DEPTH / f"frame_{index:06d}.png"


def write_frames(
    video: Path, as_stored: bool, chosen: list[int], deep: Collection[int], folder: Path, announced: int, progress: Progress
) -> None:
    """Write the frames `chosen` that are not there yet, the depth of those in `deep`, and remove those of an earlier choice.

    Raises:
        InputError: a frame cannot be decoded.
        OutputError: it cannot be encoded or written.
    """
    wanted = {index: picture_at(folder, index) for index in chosen}
    depths = {index: depth_at(folder, index) for index in deep}
    marker = folder / "source.json"
    made_of: dict[str, Any] = {"video": fingerprint(*origin(video, as_stored)), "quality": QUALITY}
    try:
        same = marker.is_file() and read_json(marker) == made_of
    except InputError:
        same = False
    kept = {*wanted.values(), *depths.values()}
    for stale in (*folder.glob("frame_*.jpg"), *(folder / DEPTH).glob("frame_*.png")):
        if not same or stale not in kept:
            stale.unlink(missing_ok=True)
    if not same:
        write_json(marker, made_of)
    for index, data in _coded(video, {index for index, path in wanted.items() if not path.is_file()}, as_stored):
        progress.check()
        progress.update(announced + index, 2 * announced, f"writing frame {index}")
        with atomic_path(wanted[index]) as temporary:
            temporary.write_bytes(data)
    for index, path in depths.items():
        if not path.is_file():
            progress.check()
            data = _encoded(".png", sens_depth(video, index), f"the depth of frame {index} of {video}")
            with atomic_path(path) as temporary:
                temporary.write_bytes(data)
    for index, path in wanted.items():
        if not path.is_file():
            raise InputError(f"frame {index} of the video {video} could be decoded once and not again; the file or the disk is damaged")


def _coded(video: Path, missing: set[int], as_stored: bool) -> Iterator[tuple[int, bytes]]:
    """The frames `missing` as JPEG files. Those of a `.sens` file mostly are that already, and lose nothing."""
    if is_sens(video) and scan(video).codings[0] == JPEG:
        for index in sorted(missing):
            yield index, sens_bytes(scan(video), index)
        return
    for index, picture in iterate_video(video, missing, as_stored=as_stored):
        quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
        yield index, _encoded(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), f"frame {index} of {video}", quality)


def _encoded(suffix: str, picture: Array, what: str, settings: list[int] | None = None) -> bytes:
    coded, data = cv2.imencode(suffix, picture, settings or [])
    if not coded:
        raise OutputError(f"{what} cannot be encoded as {'JPEG' if suffix == '.jpg' else 'PNG'}")
    return data.tobytes()
