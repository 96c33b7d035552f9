"""`transforms.json` of instant-ngp and nerfstudio (camera-to-world in OpenGL axes).

The input's frame is the frame of the file's own `transform_matrix` entries. nerfstudio's `applied_transform` and
`applied_scale` describe how an earlier frame was turned into it; they are *not* undone, so that what is exported lies over the
cameras and the `ply_file_path` points of the given file. Both are in `extra` for those who want to go back.
Stored depth is in the earlier frame's unit: `applied_scale` is part of `depth_scale`.
"""

from __future__ import annotations

import posixpath
from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldfuse.camera import Intrinsics
from fieldfuse.capture import nerf_json
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.exr import SUFFIX as EXR
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, counted, number, read_object, require_folder
from fieldfuse.capture.ply_points import read_ply_points
from fieldfuse.capture.resolve import DEPTH, MASK, POINTS, CaptureFiles
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

NAME = "transforms.json"
MASKS, DYNAMIC = ("mask_path", "mask_file_path"), "dynamic_mask_path"  # keys of masks; the latter: what is white moves, and is excluded


def looks_like_transforms(path: Path) -> bool:
    return (path / NAME).is_file()


def read_transforms(path: Path | str, within: Path | None = None) -> Capture:
    """The capture that `path/transforms.json` (or the JSON file `path` itself) describes.

    Listed files are read below `within`, by default the json's own folder.

    Raises:
        InputError: not readable, no image exists, a pose or camera is not usable, or a link leads outside the folder.
    """
    source = Path(path).absolute()
    json_path = source if source.is_file() else require_folder(source) / NAME
    data = read_object(json_path)
    root = within or json_path.parent
    base = json_path.parent.relative_to(root).as_posix()
    entries = nerf_json.frame_list(data, json_path)
    splits, split_remarks = _splits(data, entries, json_path)
    folder = CaptureFiles(root)
    listed = [(data, entry, f"frame {index} ({entry['file_path'][:80]}) of {root.name}") for index, entry in enumerate(entries)]
    there, frames, remarks = nerf_json.read_listed(folder, listed, json_path.name, base)
    used = [entries[index] for index in there]
    images = [frame.image for frame in frames]
    beside: list[list[Path | None]] = []
    for what, keys, kind in (("depth image", ("depth_file_path", "depth_path"), DEPTH), ("mask", (*MASKS, DYNAMIC), MASK)):
        names = nerf_json.listed_names(used, keys, json_path)
        found, found_remarks = folder.find_beside(names, kind, images, json_path.name, base)
        gone = found.count(None) - names.count(None)
        remarks += [f"{counted(gone, f'listed {what}')} not found"] if gone else []
        remarks += found_remarks
        beside.append(found)
    dynamic = [all(entry.get(key) is None for key in MASKS) and entry.get(DYNAMIC) is not None for entry in used]
    frames = [
        replace(
            frame,
            depth=depth,
            depth_intrinsics=_depth_camera(frame, depth),
            mask=mask,
            mask_excludes=mask is not None and excludes,
            split=splits.get(_plain(entry["file_path"])),
        )
        for frame, entry, excludes, depth, mask in zip(frames, used, dynamic, *beside, strict=True)
    ]
    frames, copies = nerf_json.once_each(frames)
    extra: dict[str, Any] = {"listed": len(entries), "missing": len(entries) - len(there)}
    if data.get("applied_transform") is not None:
        extra["applied_transform"] = nerf_json.matrix(data["applied_transform"], f"{json_path}: 'applied_transform'").tolist()
    applied_scale = _positive(data, "applied_scale", json_path)
    if applied_scale is not None:
        extra["applied_scale"] = applied_scale
    points, point_remarks = None, list[str]()
    if (listed_points := nerf_json.listed_names([data], ("ply_file_path",), json_path)) != [None]:
        (ply,), point_remarks = folder.find_beside(listed_points, POINTS, (), json_path.name, base)
        if ply is None:
            point_remarks = ["the points listed in 'ply_file_path' were not found"]
        else:
            points = read_ply_points(ply)
    # instant-ngp's `integer_depth_scale` is in the file's own unit, nerfstudio's factor is not.
    in_metres = any(frame.depth is not None and frame.depth.suffix.lower() == EXR for frame in frames)  # as all that write OpenEXR have it
    factor = (_positive(data, "depth_unit_scale_factor", json_path) or (1.0 if in_metres else 1e-3)) * (applied_scale or 1.0)
    return assemble(
        "transforms",
        root,
        [frame for frame in frames if frame.split != "val"],  # these are neither for fitting nor for the final measure
        [*remarks, *copies, *split_remarks, *point_remarks],
        depth_scale=1.0 / (_positive(data, "integer_depth_scale", json_path) or factor),
        points=points,
        extra=extra,
    )


def _depth_camera(frame: Frame, depth: Path | None) -> Intrinsics | None:
    """Depth is of the same camera, often at a lower resolution: the lens is the image's too."""
    if depth is None or frame.intrinsics is None:
        return None
    camera = fitted(frame.intrinsics, image_header(depth).size, str(depth))
    return None if camera is frame.intrinsics else camera


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
            remarks.append(f"'{split}_filenames' of {json_path.name} names none of its frames and is ignored")
        out.update(dict.fromkeys(known, split))
    if "test" not in out.values():
        out = {name: "test" if split == "val" else split for name, split in out.items()}
    return out, remarks


def _plain(path: str) -> str:
    """One spelling of a listed path: `./images/a.jpg` and `images\\a.jpg` are `images/a.jpg`."""
    return posixpath.normpath(path.replace("\\", "/"))


def _positive(data: dict[str, Any], key: str, json_path: Path) -> float | None:
    value = number(data, key, str(json_path))
    if value is not None and value <= 0:
        raise InputError(f"{json_path}: {key!r} is {value:g}, it must be positive; correct it")
    return value
