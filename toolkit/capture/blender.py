"""NeRF-synthetic (Blender) layout: `transforms_train.json`, `transforms_test.json`, pictures with alpha, OpenGL axes, z up.

`val` is used as the test split only when there is no `test`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from toolkit.capture import nerf_json
from toolkit.capture.listing import assemble, counted, fitted, picture_header, read_object, require_folder, unique_names
from toolkit.capture.types import Capture, Frame
from toolkit.errors import InputError


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
    files: list[Path] = []
    frames: list[Frame] = []
    listed, scaled, bent, alpha = 0, 0, 0, False
    for split, source in (("train", "train"), ("test", test)):
        json_path = _json(root, source)
        if split == "test" and not json_path.is_file():
            continue
        data = read_object(json_path)
        for index, entry in enumerate(nerf_json.frame_list(data, json_path)):
            listed += 1
            where = f"frame {index} of {json_path.name}"
            image = nerf_json.listed_file(root, entry["file_path"], where)
            if image is None:
                continue
            header = picture_header(image)
            described = nerf_json.picture_camera(data, entry, header.size, where)
            intrinsics = fitted(described, header.size, where)
            scaled += intrinsics is not described
            bent += described.distorted and nerf_json.says_pinhole(data, entry)
            alpha |= header.alpha
            files.append(image)
            frames.append(Frame(name="", image=image, intrinsics=intrinsics, world_from_camera=nerf_json.pose(entry, where), split=split))
    if not frames:
        raise InputError(f"none of the {counted(listed, 'picture')} listed in {root}/transforms_*.json exists; put them beside the files")
    missing = listed - len(frames)
    warnings = [f"{missing} of the {listed} listed pictures do not exist; the other {len(frames)} are used"] if missing else []
    if scaled:
        warnings.append(f"{counted(scaled, 'picture')} of another size than the json tells; intrinsics were scaled to fit")
    warnings += nerf_json.bent_remarks(bent)
    named = [replace(frame, name=name) for frame, name in zip(frames, unique_names(files), strict=True)]
    return assemble("blender", root, named, warnings, alpha=alpha, up=(0.0, 0.0, 1.0), extra={"listed": listed, "missing": missing})
