"""Record3D, of phones with a depth sensor: an `.r3d` file, which is a zip, or the folder that comes of unpacking it.

`metadata` is a JSON: `w` and `h` of the images, `K` (nine numbers, column by column, for these), `perFrameIntrinsicCoeffs` (fx, fy,
cx, cy of each frame, in newer recordings), `poses` (qx, qy, qz, qw, x, y, z of each frame: world_from_camera in OpenGL axes, metres),
`dw` and `dh` of the depth (in newer recordings), `fps`. Frame i is `rgbd/i.jpg` with `rgbd/i.depth` (LZFSE, float32, metres along z, row
by row) and `rgbd/i.conf` (LZFSE, uint8, 0 to 2). Depth shows what the image shows, in fewer pixels: 256×192 of LiDAR.

The export "EXR + RGB" has the same as `metadata.json`, `rgb/i.jpg` (or `.png`) and `depth/i.exr` (metres along z) in a folder `EXR_RGBD`.

Images, depth, `K` and poses go together as they are stored: recordings held upright have upright ones, and so have those that were
held lying until version 1.10.1 of the app.

The first frame's pose is mostly zero, so that its camera's axes are the world's. Only where it is turned, the world is ARKit's, whose y is
up. `initPose` is ignored: what it is the pose of has changed. The front camera has no poses, all are the same.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, world_from_opengl
from fieldfuse.capture.archive import MAP_PIXELS, count_pixels, members, read_bytes, read_member, require_lzfse
from fieldfuse.capture.calibration import MAX_SIDE, fitted, from_matrix
from fieldfuse.capture.headers import image_header, read_header
from fieldfuse.capture.listing import assemble, counted, files_in, images_in, is_file, number, numbers, read_object
from fieldfuse.capture.poses import checked_pose, rigid
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import MAX_JSON_BYTES

SUFFIX = ".r3d"
METADATA, FRAMES = "metadata", "rgbd"
EXPORT, EXPORTED, EXPORTED_IMAGES, EXPORTED_DEPTH = "EXR_RGBD", "metadata.json", "rgb", "depth"
NUMBER = re.compile(r"[0-9]{1,9}")
MEMBER = re.compile(r"(?P<folder>(?:[^/]+/)*)rgbd/(?P<number>[0-9]{1,9})\.(?P<kind>jpg|depth|conf)")
TRIED = 20  # images of which one has to be readable, so that their size is known: the app leaves damaged ones behind at times
FAR = 0.1  # of a side: stabilisers move a principal point by less, and that of an image that lies the other way is farther off
TURNED = 0.02  # radians by which a first frame is turned whose pose is not simply zero
SAME_SHAPE = 0.02  # difference of two aspect ratios
AGAIN = "export the recording again"


@dataclass(frozen=True)
class _Contents:
    """Where everything of a recording lies; paths may lead into a zip file."""

    metadata: Path
    images: dict[int, Path]  # by the number in their names
    depths: dict[int, Path]
    confidences: dict[int, Path]

    @classmethod
    def of(cls, metadata: Path, files: Iterable[tuple[Path, re.Match[str] | None]]) -> _Contents:
        kinds: dict[str, dict[int, Path]] = {"jpg": {}, "depth": {}, "conf": {}}
        for file, member in files:
            if member is not None:
                kinds[member["kind"]][int(member["number"])] = file
        return cls(metadata, kinds["jpg"], kinds["depth"], kinds["conf"])

    @classmethod
    def exported(cls, folder: Path) -> _Contents:
        """Of the export "EXR + RGB"."""

        def numbered(files: list[Path]) -> dict[int, Path]:
            return {int(file.stem): file for file in files if NUMBER.fullmatch(file.stem)}

        images, maps = images_in(folder / EXPORTED_IMAGES, (".jpg", ".jpeg", ".png")), images_in(folder / EXPORTED_DEPTH, (".exr",))
        return cls(folder / EXPORTED, numbered(images), numbered(maps), {})


def _export_of(path: Path) -> Path | None:
    """The folder of an export "EXR + RGB": `path`, or the one in it."""
    found = (folder for folder in (path, path / EXPORT) if is_file(folder / EXPORTED))
    return next((one for one in found if images_in(one / EXPORTED_IMAGES) and images_in(one / EXPORTED_DEPTH, (".exr",))), None)


def looks_like_record3d(path: Path) -> bool:
    return (is_file(path / METADATA) and bool(images_in(path / FRAMES, (".jpg",)))) or _export_of(path) is not None


def holds_record3d(archive: Path) -> bool:
    """Whether a zip file holds such a recording."""
    return _root(members(archive)) is not None


def read_record3d(path: Path | str) -> Capture:
    """The frames of a recording with their poses and depth, from which some are still to be chosen (`Capture.film`).

    Raises:
        InputError: it cannot be read, or its `metadata` is not usable; or there is depth, and nothing reads it.
    """
    path = Path(path).absolute()
    if path.is_dir() and (export := _export_of(path)) is not None:
        found = _Contents.exported(export)
    elif path.is_dir():
        files = [file for kind in ("jpg", "depth", "conf") for file in files_in(path / FRAMES, f"*.{kind}")]
        found = _Contents.of(path / METADATA, ((file, MEMBER.fullmatch(f"{FRAMES}/{file.name}")) for file in files))
    else:
        names = members(path)
        root = _root(names)
        if root is None:
            raise InputError(f"{path} holds no recording of Record3D ({METADATA} and {FRAMES}/); export it again as .r3d")
        of_root = ((path / name, member) for name in names if (member := MEMBER.fullmatch(name)) and member["folder"] == root)
        found = _Contents.of(path / f"{root}{METADATA}", of_root)
    data, where = _metadata(found.metadata), str(found.metadata)
    if not found.images:
        raise InputError(f"{path} holds no images whose names are numbers (0.jpg, 1.jpg, …); {AGAIN}")
    poses, shown = _poses(data, where), sorted(found.images)
    # Of a recording that was cut, images may count from where it was.
    places = list(range(len(shown))) if poses is None or len(poses) == len(shown) else shown
    used = [at for at, place in zip(shown, places, strict=True) if poses is None or place < len(poses)]
    if not used:
        raise InputError(f"{where} has no pose for any of the {counted(len(shown), 'image')}; {AGAIN}")
    places = places[: len(used)]  # both ascend
    size = _image_size([found.images[at] for at in shown])
    cameras, refused = _cameras(data, places, size, where)
    maps = _depth_size(data, [found.depths[at] for at in used if at in found.depths], size, where)
    frames = []
    for order, (at, place, camera) in enumerate(zip(used, places, cameras, strict=True)):
        depth = found.depths.get(at)
        frames.append(
            Frame(
                name=f"frame_{order:06d}",
                image=found.images[at],
                intrinsics=camera,
                world_from_camera=None if poses is None else _world_from_camera(poses[place], f"{where}, pose {place}"),
                depth=depth,
                depth_intrinsics=None if depth is None or maps is None else fitted(camera, maps, str(depth)),
                confidence=None if depth is None else found.confidences.get(at),
            )
        )
    remarks, up = [], None
    if poses is None:
        remarks.append("the recording has no poses, as those of the front camera have none; they are found from the images")
    else:
        turned = 2 * math.atan2(float(np.linalg.norm(poses[0, :3])), abs(float(poses[0, 3])))
        up = (0.0, 1.0, 0.0) if turned > TURNED else None
        if len(poses) != len(shown):
            both = f"{counted(len(shown), 'image')} and {counted(len(poses), 'pose')}"
            remarks.append(f"the recording has {both}; {len(used)} are used, which go together by number")
    if refused:
        many = counted(refused, "frame")
        remarks.append(f"the cameras of {many} are far from the recording's ('K'), as if of turned images; that one is used")
    fps = number(data, "fps", where) or 0.0
    extra = {"fps": fps, "width": size[0], "height": size[1], "seconds": len(frames) / fps if fps > 0 else None}
    facts = {"film": True, "ordered": True, "metric": True, "depth_scale": 1.0, "alpha": False, "up": up, "extra": extra}
    return assemble("record3d", path if path.is_dir() else path.parent, frames, remarks, **facts)


def _root(names: Iterable[str]) -> str | None:
    """The folder inside a zip file that holds the recording's images, "" or with a slash at its end; None: there is none."""
    known = set(names)
    for name in names:
        member = MEMBER.fullmatch(name)
        folder = str(member["folder"]) if member is not None and member["kind"] == "jpg" else None
        if folder is not None and f"{folder}{METADATA}" in known and ".." not in folder.split("/"):
            return folder
    return None


def _metadata(path: Path) -> dict[str, Any]:
    """The object in `metadata`, a file or a zip file's member."""
    if is_file(path):
        return read_object(path)
    content = read_member(path, MAX_JSON_BYTES)
    try:
        data = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({first_line(error)}); {AGAIN}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold a JSON object at its top level; {AGAIN}")
    return data


def _image_size(images: list[Path]) -> tuple[int, int]:
    """(width, height) of the first image that can be read, of the first few."""
    for path in images[:TRIED]:
        with suppress(InputError):
            return read_header(read_bytes(path), path).size
    return read_header(read_bytes(images[0]), images[0]).size


def _side(data: dict[str, Any], key: str, where: str) -> int | None:
    value = number(data, key, where)
    if value is not None and not (1 <= value <= MAX_SIDE and value == int(value)):
        raise InputError(f"{where}: {key!r} is {value:g}, which cannot be; {AGAIN}")
    return None if value is None else int(value)


def _cameras(data: dict[str, Any], places: list[int], size: tuple[int, int], where: str) -> tuple[list[Intrinsics], int]:
    """The camera of each of the frames `places` for images of `size`: its own where it has one, else that of all; and how many own ones
    contradict that of all so far that this was used: they would be those of a turned image."""
    given = _side(data, "w", where) or size[0], _side(data, "h", where) or size[1]
    shared, listed = None, data.get("perFrameIntrinsicCoeffs")
    if data.get("K") is not None:
        nine = numbers(data["K"], f"{where}: 'K'", 9, AGAIN).reshape(3, 3)  # column by column
        shared = fitted(from_matrix(nine.T, *given, where, shift=0.0).centred(where), size, where)
    found, refused = [], 0
    for place in places:
        camera = shared
        if isinstance(listed, list) and place < len(listed):
            row = f"{where}, intrinsics {place}"
            values = numbers(listed[place], row, advice=AGAIN)
            if values.size < 4:
                raise InputError(f"{row} must hold fx, fy, cx and cy; {AGAIN}")
            own = fitted(Intrinsics(*given, *values[:4].tolist()).checked(row).centred(row), size, row)
            agrees = shared is None or max(abs(own.cx - shared.cx) / own.width, abs(own.cy - shared.cy) / own.height) <= FAR
            camera, refused = (own, refused) if agrees else (shared, refused + 1)
        if camera is None:
            raise InputError(f"{where} has no camera ('K'); {AGAIN}")
        found.append(camera)
    return found, refused


def _poses(data: dict[str, Any], where: str) -> Array | None:
    """(N, 7) the poses as they are listed, finite. None where there are none, or all are the same, as those of the front camera."""
    if not data.get("poses"):
        return None
    listed = numbers(data["poses"], f"{where}: 'poses'", advice=AGAIN)
    if listed.ndim != 2 or listed.shape[1] != 7:
        raise InputError(f"{where}: 'poses' must hold seven numbers a frame (quaternion and place); {AGAIN}")
    return None if len(listed) > 1 and np.all(listed == listed[0]) else listed


def _world_from_camera(pose: Array, where: str) -> Array:
    return checked_pose(world_from_opengl(rigid(pose[[3, 0, 1, 2]], pose[4:], where)), where)


def _depth_size(data: dict[str, Any], maps: list[Path], size: tuple[int, int], where: str) -> tuple[int, int] | None:
    """(width, height) of the depth maps: as `metadata` has it, else of the image's shape; None where there are none.

    Some programs that write recordings have the two the other way round; both lie as the image does.
    """
    if not maps:
        return None
    if maps[0].suffix == ".exr":
        return _of_shape(*image_header(maps[0]).size, size, str(maps[0]))
    require_lzfse(maps[0])
    width, height = _side(data, "dw", where), _side(data, "dh", where)
    if width is None or height is None:
        pixels = count_pixels(maps[0])
        height = round(math.sqrt(pixels * size[1] / size[0]))
        width = pixels // max(height, 1)
        if not pixels or width * height != pixels:
            raise InputError(f"{where} does not have the size of the depth ('dw', 'dh'), and it is no smaller image; export it again")
    return _of_shape(width, height, size, where)


def _of_shape(width: int, height: int, size: tuple[int, int], where: str) -> tuple[int, int]:
    """The size of depth maps as images of `size` lie."""
    if not 1 <= width * height <= MAP_PIXELS:
        raise InputError(f"{where}: depth of {width}×{height} cannot be; {AGAIN}")
    for across, down in ((width, height), (height, width)):
        if abs(across * size[1] / (down * size[0]) - 1) < SAME_SHAPE:
            return across, down
    raise InputError(f"{where}: depth is {width}×{height} and images {size[0]}×{size[1]}, which is another shape; export it again")
