"""`transforms.json` of instant-ngp and nerfstudio (camera-to-world in OpenGL axes).

The input's frame is the frame of the file's own `transform_matrix` entries. nerfstudio's `applied_transform` and
`applied_scale` tell how an earlier frame was turned into it; they are *not* undone, so that what is exported lies over the
cameras and the `ply_file_path` points of the file that the user gave. Both are kept in `extra` for those who want to go back.
Stored depth is in the earlier frame's unit: `applied_scale` is part of `depth_scale`.
"""

from __future__ import annotations

import posixpath
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from toolkit.capture import nerf_json
from toolkit.capture.listing import assemble, counted, fitted, picture_header, read_object, require_folder, unique_names
from toolkit.capture.ply_points import read_ply_points
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError

NAME = "transforms.json"
DEPTH_KEYS = ("depth_file_path", "depth_path")


@dataclass
class _Tally:
    missing: int = 0
    depth_missing: int = 0
    mask_missing: int = 0
    scaled: int = 0
    bent: int = 0
    files: list[Path] = field(default_factory=list)

    def warnings(self, listed: int) -> list[str]:
        out = []
        if self.missing:
            out.append(f"{self.missing} of the {listed} listed pictures do not exist; the other {listed - self.missing} are used")
        if self.depth_missing:
            out.append(f"{counted(self.depth_missing, 'listed depth picture')} not found")
        if self.mask_missing:
            out.append(f"{counted(self.mask_missing, 'listed mask')} not found")
        if self.scaled:
            out.append(f"{counted(self.scaled, 'picture')} of another size than the json tells; intrinsics were scaled to fit")
        return out + nerf_json.bent_remarks(self.bent)


def looks_like_transforms(path: Path) -> bool:
    return (path / NAME).is_file()


def read_transforms(path: Path | str) -> Capture:
    """The capture that `path/transforms.json` (or the JSON file `path` itself) describes.

    Raises:
        InputError: not readable, no picture exists, a pose or camera is not usable, or a path leads outside the folder.
    """
    source = Path(path).absolute()
    json_path = source if source.is_file() else require_folder(source) / NAME
    data = read_object(json_path)
    root = json_path.parent
    entries = nerf_json.frame_list(data, json_path)
    splits, remarks = _splits(data, entries, json_path)
    tally = _Tally()
    frames = [frame for index, entry in enumerate(entries) if (frame := _frame(root, data, entry, index, splits, tally)) is not None]
    if not frames and tally.missing:
        raise InputError(
            f"none of the {counted(len(entries), 'picture')} listed in {json_path} exists; put them beside it or correct the paths"
        )
    named = [replace(frame, name=name) for frame, name in zip(frames, unique_names(tally.files), strict=True)]
    extra: dict[str, Any] = {"listed": len(entries), "missing": tally.missing}
    if data.get("applied_transform") is not None:
        extra["applied_transform"] = nerf_json.matrix(data["applied_transform"], f"{json_path}: 'applied_transform'").tolist()
    applied_scale = _positive(data, "applied_scale", json_path)
    if applied_scale is not None:
        extra["applied_scale"] = applied_scale
    return assemble(
        "transforms",
        root,
        _kept(named),
        [*tally.warnings(len(entries)), *remarks],
        depth_scale=_depth_scale(data, applied_scale or 1.0, json_path),
        points=_points(root, data, json_path),
        extra=extra,
    )


def _frame(root: Path, data: dict[str, Any], entry: dict[str, Any], index: int, splits: dict[str, str], tally: _Tally) -> Frame | None:
    listed = entry["file_path"]
    where = f"frame {index} ({listed[:80]}) of {root.name}"
    image = nerf_json.listed_file(root, listed, where)
    if image is None:
        tally.missing += 1
        return None
    header = picture_header(image)
    described = nerf_json.picture_camera(data, entry, header.size, where)
    intrinsics = fitted(described, header.size, where)
    tally.scaled += intrinsics is not described
    tally.bent += described.distorted and nerf_json.says_pinhole(data, entry)
    tally.files.append(image)
    depth, depth_intrinsics = None, None
    depth_listed = next((entry[key] for key in DEPTH_KEYS if entry.get(key) is not None), None)
    if depth_listed is not None:
        depth = nerf_json.listed_file(root, depth_listed, where)
        tally.depth_missing += depth is None
    if depth is not None:
        depth_size = picture_header(depth).size
        # Depth of the same camera, often at a lower resolution: the lens is the picture's too.
        depth_intrinsics = None if depth_size == header.size else fitted(intrinsics, depth_size, f"{where}, depth")
    mask = None
    if entry.get("mask_path") is not None:
        mask = nerf_json.listed_file(root, entry["mask_path"], where)
        tally.mask_missing += mask is None
    return Frame(
        name=listed,
        image=image,
        intrinsics=intrinsics,
        world_from_camera=nerf_json.pose(entry, where),
        depth=depth,
        depth_intrinsics=depth_intrinsics,
        mask=mask,
        split=splits.get(_plain(listed)),
    )


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


def _points(root: Path, data: dict[str, Any], json_path: Path) -> Any:
    if data.get("ply_file_path") is None:
        return None
    path = nerf_json.listed_file(root, data["ply_file_path"], str(json_path))
    return None if path is None else read_ply_points(path)
