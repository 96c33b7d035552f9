"""Training scenes drawn ahead of time: one safetensors file a scene, frames are read from it one by one.

A shard holds `images` (N, 3, H, W) uint8, `depths` (N, H, W) float32 along z with 0 = nothing, `intrinsics` (N, 4) float32 (fx, fy, cx,
cy; pixel centres at +0.5) and `world_from_camera` (N, 4, 4) float64; name, kind and order stand in the metadata.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from fieldfuse.camera import Array
from fieldfuse.capture.poses import checked_pose
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.training.samples import Pictures

FORMAT = "fieldfuse-shard-1"


def write_shard(
    path: Path | str, images: Array, depths: Array, intrinsics: Array, world_from_camera: Array, *, kind: str, ordered: bool
) -> None:
    """Write one scene; see the module for shapes.

    Raises:
        OutputError: it cannot be written.
        ValueError: the arrays do not belong together.
    """
    count, _, height, width = images.shape
    if depths.shape != (count, height, width) or intrinsics.shape != (count, 4) or world_from_camera.shape != (count, 4, 4):
        raise ValueError("pictures, depths, cameras and poses of a shard must have as many entries and one size")
    tensors = {
        "images": torch.from_numpy(np.ascontiguousarray(images, dtype=np.uint8)),
        "depths": torch.from_numpy(np.ascontiguousarray(depths, dtype=np.float32)),
        "intrinsics": torch.from_numpy(np.ascontiguousarray(intrinsics, dtype=np.float32)),
        "world_from_camera": torch.from_numpy(np.ascontiguousarray(world_from_camera, dtype=np.float64)),
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"format": FORMAT, "kind": kind, "ordered": str(int(ordered))})


def shard_files(root: Path | str) -> list[Path]:
    """All shards in a folder.

    Raises:
        InputError: there is none.
    """
    found = sorted(Path(root).glob("*.safetensors"))
    if not found:
        raise InputError(f"{root} holds no shards (*.safetensors); make them with python -m benchmarks.make_shards, see docs/training.md")
    return found


class ShardScene:
    """One shard as a training scene.

    Args:
        long_side: pictures are brought down to it by averaging; never enlarged.

    Raises:
        InputError: not a shard.
    """

    depth_hint: float | None = None

    def __init__(self, path: Path, long_side: int) -> None:
        self.path, self.name, self._long_side = path, path.stem, long_side
        try:
            with safe_open(path, "pt") as file:
                meta = file.metadata() or {}
                if meta.get("format") != FORMAT:
                    raise ValueError(f"its format is {meta.get('format')!r}")
                self.kind, self.ordered = meta["kind"], meta["ordered"] == "1"
                self._intrinsics = file.get_tensor("intrinsics")
                poses = file.get_tensor("world_from_camera").numpy()
                shape = file.get_slice("images").get_shape()
                depth_shape = file.get_slice("depths").get_shape()
                kinds = file.get_slice("images").get_dtype(), file.get_slice("depths").get_dtype()
            if len(shape) != 4 or shape[1] != 3 or depth_shape != [shape[0], *shape[2:]] or self._intrinsics.shape != (shape[0], 4):
                raise ValueError("its arrays do not belong together")
            if kinds != ("U8", "F32"):
                raise ValueError(f"its pictures and depths have the types {kinds}")
            if len(poses) != shape[0] or not bool(torch.isfinite(self._intrinsics).all()):
                raise ValueError("its cameras are not usable")
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            raise InputError(f"{path} is not a shard of training pictures ({first_line(error)}); make it again") from error
        self.world_from_camera = np.stack([checked_pose(pose, f"pose {i} of {path}") for i, pose in enumerate(poses)])

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`."""
        with safe_open(self.path, "pt") as file:
            stored, depth = file.get_slice("images"), file.get_slice("depths")
            images = torch.cat([stored[i : i + 1] for i in indices]).float() / 255
            depths = torch.cat([depth[i : i + 1] for i in indices])
        intrinsics = self._intrinsics[list(indices)]
        height, width = images.shape[2:]
        factor = min(1.0, self._long_side / max(height, width))
        if factor < 1:
            size = max(8, round(height * factor)), max(8, round(width * factor))
            images = F.interpolate(images, size, mode="area")
            depths = F.interpolate(depths[:, None], size, mode="nearest-exact")[:, 0]
            x, y = size[1] / width, size[0] / height
            intrinsics = intrinsics * torch.tensor([x, y, x, y])
        return Pictures(images, intrinsics, torch.from_numpy(self.world_from_camera[list(indices)].astype(np.float32)), depths)
