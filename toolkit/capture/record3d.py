"""Record3D, of phones with a depth sensor: an `.r3d` file, which is a zip, or the folder that comes of unpacking it.

`metadata` is a JSON: `w` and `h` of the pictures, `K` (nine numbers, column by column, for these), `perFrameIntrinsicCoeffs` (fx, fy,
cx, cy of each frame, in newer recordings), `poses` (qx, qy, qz, qw, x, y, z of each frame: world_from_camera in OpenGL axes, metres),
`dw` and `dh` of the depth (in newer recordings), `fps`. Frame i is `rgbd/i.jpg` with `rgbd/i.depth` (LZFSE, float32, metres along z, row
by row) and `rgbd/i.conf` (LZFSE, uint8, 0 to 2). Depth shows what the picture shows, in fewer pixels: 256×192 of LiDAR.

Pictures, depth, `K` and poses go together as they are stored: recordings held upright have upright ones, and so have those that were
held lying until the app learned of it (version 1.10.1).

The first frame's pose is mostly zero, so that its camera's axes are the world's. Only where it is turned, the world is ARKit's, whose y is
up. `initPose` is left alone: what it is the pose of has changed. The front camera has no poses, all are the same.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldfuse.capture import lzfse
from fieldfuse.capture.archive import members, read_member
from fieldfuse.capture.headers import read_bytes, read_header
from fieldfuse.capture.listing import assemble, counted, files_in, is_file, pictures_in, read_object
from fieldfuse.capture.nerf_json import number
from fieldfuse.capture.record3d_metadata import cameras, depth_size, poses, up_of, world_from_camera
from fieldfuse.capture.sizes import fitted
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import MAX_JSON_BYTES

SUFFIX = ".r3d"
METADATA, FRAMES = "metadata", "rgbd"
MEMBER = re.compile(r"(?P<folder>(?:[^/]+/)*)rgbd/(?P<number>[0-9]{1,9})\.(?P<kind>jpg|depth|conf)")
TRIED = 20  # pictures of which one has to be readable, so that their size is known: the app leaves damaged ones behind at times


@dataclass(frozen=True)
class Contents:
    """Where everything of a recording lies; paths may lead into a zip file."""

    metadata: Path
    pictures: dict[int, Path]  # by the number in their names
    depths: dict[int, Path]
    confidences: dict[int, Path]


def looks_like_record3d(path: Path) -> bool:
    return is_file(path / METADATA) and bool(pictures_in(path / FRAMES, (".jpg",)))


def holds_record3d(archive: Path) -> bool:
    """Whether a zip file holds such a recording.

    Raises:
        InputError: it is no zip file, or cut short.
    """
    return _root(members(archive)) is not None


def read_record3d(path: Path | str) -> Capture:
    """The frames of a recording with their poses and depth, from which some are still to be chosen (`Capture.film`).

    Raises:
        InputError: it cannot be read, or what `metadata` says is not usable; or there is depth, and nothing reads it.
    """
    path = Path(path).absolute()
    found = _in_folder(path) if path.is_dir() else _in_archive(path)
    data, where = _metadata(found.metadata), str(found.metadata)
    listed, numbers = poses(data, where), sorted(found.pictures)
    # Of a recording that was cut, pictures may count from where it was.
    places = list(range(len(numbers))) if listed is None or len(listed) == len(numbers) else numbers
    used = [at for at, place in zip(numbers, places, strict=True) if listed is None or place < len(listed)]
    if not used:
        raise InputError(f"{where} has no pose for any of the {counted(len(numbers), 'picture')}; export the recording again")
    places = places[: len(used)]  # both ascend
    size = _picture_size([found.pictures[at] for at in numbers])
    lenses, refused = cameras(data, places, size, where)
    maps = _depth_size(data, [found.depths[at] for at in used if at in found.depths], size, where)
    frames = []
    for order, (at, place, camera) in enumerate(zip(used, places, lenses, strict=True)):
        depth = found.depths.get(at)
        frames.append(
            Frame(
                name=f"frame_{order:06d}",
                image=found.pictures[at],
                intrinsics=camera,
                world_from_camera=None if listed is None else world_from_camera(listed[place], f"{where}, pose {place}"),
                depth=depth,
                depth_intrinsics=None if depth is None or maps is None else fitted(camera, maps, str(depth)),
                confidence=None if depth is None else found.confidences.get(at),
            )
        )
    fps = number(data, "fps", where) or 0.0
    return assemble(
        "record3d",
        path if path.is_dir() else path.parent,
        frames,
        _remarks(len(numbers), None if listed is None else len(listed), len(used), refused),
        film=True,
        ordered=True,
        metric=True,
        depth_scale=1.0,
        alpha=False,
        up=up_of(listed),
        extra={"fps": fps, "width": size[0], "height": size[1], "seconds": len(frames) / fps if fps > 0 else None},
    )


def _remarks(pictures: int, told: int | None, used: int, refused: int) -> list[str]:
    remarks = []
    if told is None:
        remarks.append("the recording has no poses, as those of the front camera have none; they are found from the pictures")
    elif told != pictures:
        remarks.append(
            f"the recording has {counted(pictures, 'picture')} and {counted(told, 'pose')}; {used} are used, which go together by number"
        )
    if refused:
        remarks.append(
            f"the cameras of {counted(refused, 'frame')} are far from the recording's ('K'), as if of turned pictures; that one is used"
        )
    return remarks


def _picture_size(pictures: list[Path]) -> tuple[int, int]:
    """(width, height) of the first picture that can be read.

    Raises:
        InputError: none of the first can.
    """
    for path in pictures[:TRIED]:
        with suppress(InputError):
            header = read_header(read_bytes(path), path)
            return header.width, header.height
    header = read_header(read_bytes(pictures[0]), pictures[0])
    return header.width, header.height


def _depth_size(data: dict[str, Any], maps: list[Path], size: tuple[int, int], where: str) -> tuple[int, int] | None:
    """(width, height) of the depth maps; None where there are none."""
    if not maps:
        return None
    lzfse.require(maps[0])
    told = data.get("dw") is not None and data.get("dh") is not None
    return depth_size(data, None if told else lzfse.count_pixels(maps[0]), size, where)


# ------------------------------------------------------------------------------------------------ where things lie


def _metadata(path: Path) -> dict[str, Any]:
    """The object in `metadata`, a file or a zip file's member.

    Raises:
        InputError: it cannot be read, or is something else.
    """
    if is_file(path):
        return read_object(path)
    content = read_member(path, MAX_JSON_BYTES)
    try:
        data = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({first_line(error)}); export the recording again") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold a JSON object at its top level; export the recording again")
    return data


def _in_folder(root: Path) -> Contents:
    kinds = {
        kind: {int(file.stem): file for file in files_in(root / FRAMES, f"*.{kind}") if MEMBER.fullmatch(f"{FRAMES}/{file.name}")}
        for kind in ("jpg", "depth", "conf")
    }
    return Contents(root / METADATA, kinds["jpg"], kinds["depth"], kinds["conf"])


def _in_archive(path: Path) -> Contents:
    names = members(path)
    root = _root(names)
    if root is None:
        raise InputError(f"{path} holds no recording of Record3D ({METADATA} and {FRAMES}/); export it again as .r3d")
    kinds: dict[str, dict[int, Path]] = {"jpg": {}, "depth": {}, "conf": {}}
    for name in names:
        member = MEMBER.fullmatch(name)
        if member is not None and member["folder"] == root:
            kinds[member["kind"]][int(member["number"])] = path / name
    return Contents(path / f"{root}{METADATA}", kinds["jpg"], kinds["depth"], kinds["conf"])


def _root(names: Sequence[str]) -> str | None:
    """The folder inside a zip file that holds the recording's pictures, "" or with a slash at its end; None: there is none."""
    known = set(names)
    for name in names:
        member = MEMBER.fullmatch(name)
        folder = None if member is None or member["kind"] != "jpg" else str(member["folder"])
        if folder is not None and f"{folder}{METADATA}" in known and ".." not in folder.split("/"):
            return folder
    return None
