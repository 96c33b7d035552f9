"""NeRF-synthetic: `<scene>/transforms_train.json` and pictures with alpha on nothing; objects, white behind them."""

from __future__ import annotations

from pathlib import Path

from fieldfuse.capture.blender import looks_like_blender, read_blender
from fieldfuse.nerfusion.training.captured import CapturedScene
from fieldfuse.nerfusion.training.datasets.folders import scene_folders


def synthetic_folders(root: Path | str) -> list[Path]:
    """The scenes under `root`.

    Raises:
        InputError: there is none.
    """
    return scene_folders(root, looks_like_blender, "NeRF-synthetic", inside=("nerf_synthetic",))


def synthetic_scene(folder: Path, long_side: int) -> CapturedScene:
    """The training split of one scene; its test pictures are never read.

    Raises:
        InputError: it cannot be read.
    """
    capture = read_blender(folder)
    return CapturedScene(capture.with_frames([frame for frame in capture.frames if frame.split != "test"]), "object", long_side)
