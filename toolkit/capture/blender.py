"""NeRF-synthetic (Blender) layout: `transforms_train.json`, `transforms_test.json`, images with alpha, OpenGL axes, z up.

`val` is used as the test split only when there is no `test`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fieldfuse.capture import nerf_json
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, read_object, require_folder
from fieldfuse.capture.resolve import CaptureFiles
from fieldfuse.capture.types import Capture


def looks_like_blender(path: Path) -> bool:
    return (path / "transforms_train.json").is_file()


def read_blender(path: Path | str) -> Capture:
    """Frames of the train and test splits. Image sizes come from the files, the focal length from `camera_angle_x`.

    Raises:
        InputError: a JSON file is not readable, no image exists, or a pose or camera is not usable.
    """
    root = require_folder(path)
    jsons = {split: root / f"transforms_{split}.json" for split in ("train", "test", "val")}
    test = "test" if jsons["test"].is_file() or not jsons["val"].is_file() else "val"
    listed: list[nerf_json.Listed] = []
    splits: list[str] = []
    for split, json_path in (("train", jsons["train"]), ("test", jsons[test])):
        if split == "train" or json_path.is_file():
            data = read_object(json_path)
            entries = nerf_json.frame_list(data, json_path)
            listed += [(data, entry, f"frame {index} of {json_path.name}") for index, entry in enumerate(entries)]
            splits += [split] * len(entries)
    there, read, remarks = nerf_json.read_listed(CaptureFiles(root), listed, "transforms_*.json")
    # An image of both splits is of the test; where the two list the same images, there is no split.
    held_out = {frame.image for frame, index in zip(read, there, strict=True) if splits[index] == "test"}
    both = {frame.image for frame, index in zip(read, there, strict=True) if splits[index] == "train"} <= held_out
    split_of = {frame.image: ("train" if frame.image not in held_out else None if both else "test") for frame in read}
    frames, copies = nerf_json.once_each([replace(frame, split=split_of[frame.image]) for frame in read])
    return assemble(
        "blender",
        root,
        frames,
        [*remarks, *copies],
        alpha=any(image_header(frame.image).alpha for frame in read),
        up=(0.0, 0.0, 1.0),
        extra={"listed": len(listed), "missing": len(listed) - len(there)},
    )
