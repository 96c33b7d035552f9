"""NeRF-synthetic (Blender) layout: `transforms_train.json`, `transforms_test.json`, pictures with alpha, OpenGL axes, z up.

`val` is used as the test split only when there is no `test`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldfuse.capture import nerf_json
from fieldfuse.capture.listing import assemble, read_object, require_folder, unique_names
from fieldfuse.capture.resolve import CaptureFiles
from fieldfuse.capture.sizes import picture_header
from fieldfuse.capture.types import Capture, Frame


def _json(root: Path, split: str) -> Path:
    return root / f"transforms_{split}.json"


def looks_like_blender(path: Path) -> bool:
    return _json(path, "train").is_file()


def read_blender(path: Path | str) -> Capture:
    """Frames of the train and test splits. Picture sizes come from the files, the focal length from `camera_angle_x`.

    Raises:
        InputError: a JSON file is not readable, no picture exists, or a pose or camera is not usable.
    """
    root = require_folder(path)
    test = "test" if _json(root, "test").is_file() or not _json(root, "val").is_file() else "val"
    listed: list[tuple[dict[str, Any], dict[str, Any], str]] = []
    splits: list[str] = []
    for split, json_path in (("train", _json(root, "train")), ("test", _json(root, test))):
        if split == "train" or json_path.is_file():
            data = read_object(json_path)
            entries = nerf_json.frame_list(data, json_path)
            listed += [(data, entry, f"frame {index} of {json_path.name}") for index, entry in enumerate(entries)]
            splits += [split] * len(entries)
    folder = CaptureFiles(root)
    found = folder.find([entry["file_path"] for _, entry, _ in listed], source="transforms_*.json")
    if not found.count:
        raise folder.none_exists("transforms_*.json", len(listed), found)
    there = [index for index, image in enumerate(found.files) if image is not None]
    images = [image for image in found.files if image is not None]
    read, remarks = nerf_json.read_frames([listed[index] for index in there], images)
    frames, copies = nerf_json.once_each(_held_out([replace(frame, split=splits[i]) for frame, i in zip(read, there, strict=True)]))
    named = [replace(frame, name=name) for frame, name in zip(frames, unique_names([frame.image for frame in frames]), strict=True)]
    return assemble(
        "blender",
        root,
        named,
        [*found.remarks, *nerf_json.missing_remarks(len(listed), found), *remarks, *copies],
        alpha=any(picture_header(image).alpha for image in images),
        up=(0.0, 0.0, 1.0),
        extra={"listed": len(listed), "missing": len(listed) - found.count},
    )


def _held_out(frames: list[Frame]) -> list[Frame]:
    """Frames in the one split that each image has: of the test where it is in both, of none where the two list the same images."""
    test = {frame.image for frame in frames if frame.split == "test"}
    both = {frame.image for frame in frames if frame.split == "train"} <= test
    return [replace(frame, split=None if both else "test") if frame.image in test else frame for frame in frames]
