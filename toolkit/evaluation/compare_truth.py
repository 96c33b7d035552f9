"""Ground truth that a capture brings: `ground_truth/` beside its `transforms.json`, as simulated captures have it.

`mesh.ply` is the true surface in the input's frame; `cameras.json` lists for each picture a file with its exact depth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from fieldfuse.camera import Array, Intrinsics, resample_maps
from fieldfuse.capture.types import Capture, Views
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import inside, read_json

FOLDER = "ground_truth"
MESH = "mesh.ply"
CAMERAS = "cameras.json"


@dataclass(frozen=True)
class GroundTruth:
    """Where the truth of a capture lies."""

    mesh: Path | None  # in the input's frame
    depths: dict[Path, Path]  # picture → safetensors with `depth` (H, W) along z in the input's units
    camera: Intrinsics | None  # of the depth maps, with its lens


def find_truth(capture: Capture) -> GroundTruth | None:
    """The truth beside a capture, None when there is none.

    Raises:
        InputError: it is there and damaged, or leads outside the capture's folder.
    """
    root = capture.root if capture.root.is_dir() else capture.root.parent
    folder = root / FOLDER
    if not folder.is_dir():
        return None
    mesh = folder / MESH if (folder / MESH).is_file() else None
    depths: dict[Path, Path] = {}
    camera = None
    if (folder / CAMERAS).is_file():
        about = read_json(folder / CAMERAS)
        try:
            camera = Intrinsics.from_dict(about["intrinsics"]).checked(str(folder / CAMERAS))
            for entry in about["frames"]:
                if "picture" in entry:
                    depths[inside(root, str(entry["picture"]))] = inside(root, str(entry["truth"]))
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
            raise InputError(
                f"{folder / CAMERAS} does not list cameras as a simulated capture does ({first_line(error)}); remove {folder}"
            ) from error
    return None if mesh is None and not depths else GroundTruth(mesh, depths, camera)


def true_depths(truth: GroundTruth, posed: Capture, views: Views, indices: Iterable[int], scale: float) -> list[Array | None]:
    """The exact depth of the views at `indices` on their own pixels, (H, W) float32 in working units (`scale` of them an input unit).

    Each pixel takes the nearest stored value. None where there is no file for the picture.

    Raises:
        InputError: a file is damaged.
    """
    out: list[Array | None] = []
    for index in indices:
        path = truth.depths.get(posed.frames[int(index)].image.resolve())
        if path is None or truth.camera is None:
            out.append(None)
            continue
        depth = _read_depth(path)
        height, width = depth.shape
        source, target = truth.camera.scaled(width, height), views.intrinsics[int(index)]
        if source != target:
            map_x, map_y, seen = resample_maps(source, target)
            column = np.clip(np.floor(map_x + 0.5), 0, width - 1).astype(np.intp)
            row = np.clip(np.floor(map_y + 0.5), 0, height - 1).astype(np.intp)
            depth = np.where(seen, depth[row, column], np.float32(0))
        out.append(np.ascontiguousarray(depth * np.float32(scale), dtype=np.float32))
    return out


def _read_depth(path: Path) -> Array:
    try:
        with safe_open(str(path), framework="numpy") as file:
            depth = file.get_tensor("depth")
        if depth.ndim != 2 or depth.dtype.kind != "f":
            raise ValueError(f"its depth is {depth.dtype} of shape {depth.shape}")
        return np.asarray(depth)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"the true depth {path} cannot be read ({first_line(error)}); make the capture again") from error
