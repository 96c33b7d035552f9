"""ScanNet: `scans/scene0000_00/scene0000_00.sens` as the site publishes it, or `{color,depth,pose,intrinsic}` as its exporter writes them;
video of rooms with depth, metres.

A `scannetv2_train.txt` beside the scans names the training scenes; without it every scene is used.
"""

from __future__ import annotations

from pathlib import Path

from fieldfuse.capture.scannet import looks_exported, packed, read_scannet
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.captured import CapturedScene
from fieldfuse.nerfusion.training.datasets.folders import listed, scene_folders

LISTS = ("scannetv2_train.txt", "train.txt")


def _is_scene(path: Path) -> bool:
    return looks_exported(path) or bool(packed(path))


def scannet_folders(root: Path | str) -> list[Path]:
    """The training scenes under `root`.

    Raises:
        InputError: there is none, or none of those that the list names.
    """
    folders = scene_folders(root, _is_scene, "ScanNet", inside=("scans", "scans_train"))
    wanted = listed(Path(root), LISTS)
    chosen = folders if wanted is None else [path for path in folders if path.name in wanted]
    if not chosen:
        raise InputError(f"none of the scenes that the list in {root} names is there; export them or remove the list")
    return chosen


def scannet_scene(folder: Path, long_side: int) -> CapturedScene:
    """One scan.

    Raises:
        InputError: it cannot be read as ScanNet's file or exported layout.
    """
    return CapturedScene(read_scannet(folder), "room", long_side)
