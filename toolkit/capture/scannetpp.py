"""ScanNet++'s DSLR images: `dslr/nerfstudio/transforms_undistorted.json` with `dslr/resized_undistorted_images/`, else `transforms.json`
with `resized_images/` (fisheye). `path` is the scene or its `dslr/`.

The json is nerfstudio's, but for the images' folder, which it does not name; `test_frames` stands beside `frames`. Poses are metres.
`train_test_lists.json` gives the split. Frames with `is_bad` are left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fieldfuse.capture import nerf_json
from fieldfuse.capture.listing import assemble, counted, images_in, is_file, read_object, require_folder
from fieldfuse.capture.resolve import CaptureFiles
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

PAIRS = (
    ("nerfstudio/transforms_undistorted.json", "resized_undistorted_images", "resized_undistorted_masks"),
    ("nerfstudio/transforms.json", "resized_images", "resized_anon_masks"),
)
SPLITS = "train_test_lists.json"


def _parts(path: Path) -> tuple[Path, str, str, str] | None:
    """`dslr/`, and in it the json, and the folders of images and masks."""
    for root in (path / "dslr", path):
        for json, images, masks in PAIRS:
            if is_file(root / json) and images_in(root / images):
                return root, json, images, masks
    return None


def looks_like_scannetpp(path: Path) -> bool:
    return _parts(path) is not None


def read_scannetpp(path: Path | str) -> Capture:
    """The images with poses in metres, and the published split.

    Raises:
        InputError: the json is broken, or no image exists.
    """
    root = require_folder(path)
    parts = _parts(root)
    if parts is None:
        raise InputError(f"{root} holds no dslr/nerfstudio with its resized images; download ScanNet++'s DSLR data")
    folder, name, images, masks = parts
    json_path = folder / name
    data = read_object(json_path)
    entries = [dict(entry, split="train") for entry in nerf_json.frame_list(data, json_path)]
    if data.get("test_frames"):
        entries += [dict(entry, split="test") for entry in nerf_json.frame_list({"frames": data["test_frames"]}, json_path)]
    bad = [entry for entry in entries if entry.get("is_bad") is True]
    entries = [entry for entry in entries if entry.get("is_bad") is not True]
    splits = _splits(folder)
    files = CaptureFiles(folder)
    listed = [(data, entry, f"frame {index} ({entry['file_path'][:80]}) of {json_path.name}") for index, entry in enumerate(entries)]
    there, frames, remarks = nerf_json.read_listed(files, listed, json_path.name, images)
    remarks += [f"{counted(len(bad), 'image')} marked as bad (blurred or shadowed) in {json_path.name} are left out"] if bad else []
    out = []
    for index, frame in zip(there, frames, strict=True):
        mask = entries[index].get("mask_path")
        file = folder / masks / mask if isinstance(mask, str) and "/" not in mask and "\\" not in mask else None
        split = splits.get(frame.image.name, entries[index]["split"])
        out.append(replace(frame, split=split, mask=file if file is not None and is_file(file) else None))
    extra = {"listed": len(entries), "missing": len(entries) - len(there)}
    return assemble("scannetpp", root, out, remarks, metric=True, extra=extra)


def _splits(folder: Path) -> dict[str, str]:
    if not is_file(folder / SPLITS):
        return {}
    data = read_object(folder / SPLITS)
    lists = {split: data.get(split) for split in ("train", "test")}
    return {str(name): split for split, names in lists.items() if isinstance(names, list) for name in names}
