"""`transforms.json` of instant-ngp and nerfstudio (camera-to-world in OpenGL axes).

The input's frame is the frame of the file's own `transform_matrix` entries. nerfstudio's `applied_transform` and
`applied_scale` tell how an earlier frame was turned into it; they are *not* undone, so that what is exported lies over the
cameras and the `ply_file_path` points of the file that the user gave. Both are kept in `extra` for those who want to go back.
Stored depth is in the earlier frame's unit: `applied_scale` is part of `depth_scale`.
"""

from __future__ import annotations

import posixpath
from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldfuse.camera import Intrinsics
from fieldfuse.capture import nerf_json
from fieldfuse.capture.listing import assemble, counted, read_object, require_folder, unique_names
from fieldfuse.capture.ply_points import read_ply_points
from fieldfuse.capture.resolve import DEPTH, MASK, POINTS, CaptureFiles
from fieldfuse.capture.sizes import fitted, picture_header
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

NAME = "transforms.json"
DEPTH_KEYS = ("depth_file_path", "depth_path")


def looks_like_transforms(path: Path) -> bool:
    return (path / NAME).is_file()


def read_transforms(path: Path | str, within: Path | None = None) -> Capture:
    """The capture that `path/transforms.json` (or the JSON file `path` itself) describes.

    Listed files are read below `within`, by default the json's own folder.

    Raises:
        InputError: not readable, no picture exists, a pose or camera is not usable, or a link leads outside the folder.
    """
    source = Path(path).absolute()
    json_path = source if source.is_file() else require_folder(source) / NAME
    data = read_object(json_path)
    root = within or json_path.parent
    base = json_path.parent.relative_to(root).as_posix()
    entries = nerf_json.frame_list(data, json_path)
    splits, remarks = _splits(data, entries, json_path)
    folder = CaptureFiles(root)
    found = folder.find([entry["file_path"] for entry in entries], source=json_path.name, base=base)
    if not found.count:
        raise folder.none_exists(json_path.name, len(entries), found)
    there = [(index, entry, image) for index, (entry, image) in enumerate(zip(entries, found.files, strict=True)) if image is not None]
    taken = [image for _, _, image in there]
    beside: dict[str, list[Path | None]] = {}
    absent = []
    for what, keys, kind in (("depth picture", DEPTH_KEYS, DEPTH), ("mask", ("mask_path",), MASK)):
        listed = nerf_json.listed_names([entry for _, entry, _ in there], keys, json_path)
        beside[what], found_remarks = folder.find_beside(listed, kind, taken, json_path.name, base)
        gone = beside[what].count(None) - listed.count(None)
        absent += [f"{counted(gone, f'listed {what}')} not found"] if gone else []
        remarks += found_remarks
    where = [(data, entry, f"frame {index} ({entry['file_path'][:80]}) of {root.name}") for index, entry, _ in there]
    read, camera_remarks = nerf_json.read_frames(where, taken)
    frames = [
        replace(
            frame,
            depth=depth,
            depth_intrinsics=_depth_camera(frame, depth),
            mask=mask,
            split=splits.get(_plain(entry["file_path"])),
        )
        for frame, (_, entry, _), depth, mask in zip(read, there, beside["depth picture"], beside["mask"], strict=True)
    ]
    frames, copies = nerf_json.once_each(frames)
    named = [replace(frame, name=name) for frame, name in zip(frames, unique_names([frame.image for frame in frames]), strict=True)]
    extra: dict[str, Any] = {"listed": len(entries), "missing": len(entries) - found.count}
    if data.get("applied_transform") is not None:
        extra["applied_transform"] = nerf_json.matrix(data["applied_transform"], f"{json_path}: 'applied_transform'").tolist()
    applied_scale = _positive(data, "applied_scale", json_path)
    if applied_scale is not None:
        extra["applied_scale"] = applied_scale
    points, point_remarks = _points(folder, data, json_path, base)
    return assemble(
        "transforms",
        root,
        _kept(named),
        [
            *found.remarks,
            *nerf_json.missing_remarks(len(entries), found),
            *absent,
            *camera_remarks,
            *copies,
            *remarks,
            *point_remarks,
        ],
        depth_scale=_depth_scale(data, applied_scale or 1.0, json_path),
        points=points,
        extra=extra,
    )


def _depth_camera(frame: Frame, depth: Path | None) -> Intrinsics | None:
    """Depth is of the same camera, often at a lower resolution: the lens is the picture's too."""
    if depth is None or frame.intrinsics is None:
        return None
    size = picture_header(depth).size
    same = size == (frame.intrinsics.width, frame.intrinsics.height)
    return None if same else fitted(frame.intrinsics, size, str(depth))


def _splits(data: dict[str, Any], entries: list[dict[str, Any]], json_path: Path) -> tuple[dict[str, str], list[str]]:
    """nerfstudio's optional `train_filenames`, `val_filenames`, `test_filenames` → split by path, and remarks on lists without a frame."""
    out: dict[str, str] = {}
    remarks = []
    listed = {_plain(entry["file_path"]) for entry in entries}
    for split in ("train", "val", "test"):
        names = data.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{json_path}: '{split}_filenames' must be a list of file names; correct it")
        known = listed.intersection(map(_plain, names))
        if names and not known:
            remarks.append(f"'{split}_filenames' of {json_path.name} names none of its frames and is left out of account")
        out.update(dict.fromkeys(known, split))
    if "test" not in out.values():
        out = {name: "test" if split == "val" else split for name, split in out.items()}
    return out, remarks


def _plain(path: str) -> str:
    """One spelling of a listed path: `./images/a.jpg` and `images\\a.jpg` are `images/a.jpg`."""
    return posixpath.normpath(path.replace("\\", "/"))


def _kept(frames: list[Frame]) -> list[Frame]:
    """Without validation frames: they are neither for fitting nor for the final measure."""
    return [frame for frame in frames if frame.split != "val"]


def _positive(data: dict[str, Any], key: str, json_path: Path) -> float | None:
    value = nerf_json.number(data, key, str(json_path))
    if value is not None and value <= 0:
        raise InputError(f"{json_path}: {key!r} is {value:g}, it must be positive; correct it")
    return value


def _depth_scale(data: dict[str, Any], applied_scale: float, json_path: Path) -> float:
    """Stored values per unit: instant-ngp's `integer_depth_scale` is in the file's own unit, nerfstudio's factor is not."""
    integer = _positive(data, "integer_depth_scale", json_path)
    if integer is not None:
        return 1.0 / integer
    factor = _positive(data, "depth_unit_scale_factor", json_path) or 1e-3
    return 1.0 / (factor * applied_scale)


def _points(folder: CaptureFiles, data: dict[str, Any], json_path: Path, base: str) -> tuple[Any, list[str]]:
    """The listed points, and remarks on where they are."""
    listed = nerf_json.listed_names([data], ("ply_file_path",), json_path)
    if listed == [None]:
        return None, []
    (path,), remarks = folder.find_beside(listed, POINTS, (), json_path.name, base)
    return (None, ["the points listed in 'ply_file_path' were not found"]) if path is None else (read_ply_points(path), remarks)
