"""Pinhole cameras as tensors, for the networks: a few views at a time, in the working frame; and the blocks of a lattice that they see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.volume.topology import BLOCK, Topology

SLACK = 1.25  # balls grow by this much: views see a voxel beside their images, and blocks of the contracted shell are bent


@dataclass(frozen=True)
class Cameras:
    """K cameras with OpenCV axes and pixel centres at +0.5."""

    intrinsics: Tensor  # (K, 4) fx, fy, cx, cy in pixels
    size: Tensor  # (K, 2) width and height in pixels
    world_from_camera: Tensor  # (K, 4, 4)
    # The same cameras in the processor's memory, where they came from there, so that reading them does not wait for the device.
    host: Cameras | None = field(default=None, compare=False, repr=False)

    @classmethod
    def of(cls, intrinsics: Sequence[Intrinsics], world_from_camera: Array, device: torch.device | str = "cpu") -> Cameras:
        """From the toolkit's cameras; lenses are not looked at (images are undistorted before)."""
        lenses = torch.tensor([(c.fx, c.fy, c.cx, c.cy) for c in intrinsics], dtype=torch.float32)
        sizes = torch.tensor([(c.width, c.height) for c in intrinsics], dtype=torch.float32)
        return cls(lenses, sizes, torch.from_numpy(np.asarray(world_from_camera).astype(np.float32))).to(device)

    @classmethod
    def same_size(cls, intrinsics: Tensor, world_from_camera: Tensor, width: int, height: int) -> Cameras:
        """(K, 4) and (K, 4, 4) of images of one size."""
        return cls(intrinsics, intrinsics.new_tensor([width, height]).expand(len(intrinsics), 2), world_from_camera)

    def __len__(self) -> int:
        return len(self.intrinsics)

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> Cameras:
        """Some of the cameras (one stays a bundle of one)."""
        if isinstance(index, int):
            index = slice(index, index + 1) if index != -1 else slice(index, None)
        host = None if self.host is None or isinstance(index, Tensor) else self.host[index]
        return Cameras(self.intrinsics[index], self.size[index], self.world_from_camera[index], host)

    @classmethod
    def together(cls, parts: Sequence[Cameras]) -> Cameras:
        """All of them in one bundle."""
        hosts = [part.host for part in parts if part.host is not None]
        if hosts and len(hosts) == len(parts):
            return cls.together(hosts).to(parts[0].intrinsics.device)
        lenses, sizes = torch.cat([part.intrinsics for part in parts]), torch.cat([part.size for part in parts])
        return cls(lenses, sizes, torch.cat([part.world_from_camera for part in parts]))

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on another device, in one piece."""
        device, on_cpu = torch.device(device), self.intrinsics.device.type == "cpu"
        if device.type == self.intrinsics.device.type:
            return self
        if device.type == "cpu" and self.host is not None:
            return self.host
        parts = self.intrinsics, self.size, self.world_from_camera
        flat = torch.cat([part.reshape(-1) for part in parts])
        moved = (to_device_async(flat.numpy(), device) if on_cpu else flat.to(device)).split([part.numel() for part in parts])
        intrinsics, size, poses = (new.view(old.shape) for new, old in zip(moved, parts, strict=True))
        return Cameras(intrinsics, size, poses, self if on_cpu else None)

    @property
    def positions(self) -> Tensor:
        """(K, 3)."""
        return self.world_from_camera[:, :3, 3]

    def lens(self, view: int) -> Tensor:
        """(6,) fx, fy, cx, cy, width and height of one view."""
        return torch.cat([self.intrinsics[view], self.size[view]])

    def local(self, points: Tensor) -> Tensor:
        """(N, 3) working frame → (K, N, 3) camera axes."""
        rotation = self.world_from_camera[:, :3, :3]
        # Subtract first: differences are small numbers, products with a far origin are not. In bfloat16 a pixel would be lost.
        with torch.autocast(points.device.type, enabled=False):
            return (points[None] - self.positions[:, None]) @ rotation

    def directions(self, view: int, pixels: Tensor) -> Tensor:
        """(N, 2) pixels of one view → (N, 3) unit directions in the working frame."""
        fx, fy, cx, cy = self.intrinsics[view].unbind()
        ray = torch.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, torch.ones_like(pixels[:, 0])], 1)
        with torch.autocast(pixels.device.type, enabled=False):
            return torch.nn.functional.normalize(ray @ self.world_from_camera[view, :3, :3].T, dim=1)


# Blocks that a camera can see at all, judged before anything is unprojected, in the processor's memory: there an operation on a few numbers
# is cheap, and the device is not waited for.


def all_blocks(lattice: Lattice) -> Tensor:
    """(M, 3) int32 keys of every block that holds a corner of the space (without a shell: of its box)."""
    space = lattice.space
    line = torch.arange(lattice.resolution // BLOCK + 1)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    keys = torch.stack([x, y, z], -1).view(-1, 3)
    if space.shell == 0:
        box = torch.tensor(space.box) + lattice.voxel
        low = keys * (BLOCK * lattice.voxel) - space.extent
        high = low + (BLOCK - 1) * lattice.voxel
        keys = keys[((low <= box) & (high >= -box)).all(1)]
    return keys.int()


def block_balls(lattice: Lattice, keys: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 3) keys → centres (M, 3) and radii (M,) of balls around each block's corners, working frame."""
    offsets = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]) * (BLOCK - 1)
    corners = (keys[:, None].long() * BLOCK + offsets).float() * lattice.voxel - lattice.space.extent
    centre = lattice.space.to_working(corners.mean(1))
    radius = (lattice.space.to_working(corners.view(-1, 3)).view(-1, 8, 3) - centre[:, None]).norm(dim=2).amax(1)
    return centre, radius * SLACK


@lru_cache(maxsize=4)
def _all_balls(lattice: Lattice) -> tuple[Array, Array, Array]:
    """Keys, centres and radii of all blocks of a lattice."""
    keys = all_blocks(lattice)
    centres, radii = block_balls(lattice, keys)
    return keys.numpy(), centres.numpy(), radii.numpy()


def frustum(lattice: Lattice, camera: Cameras, near: float, far: float, device: torch.device | str = "cpu") -> Topology:
    """The blocks of the lattice in the first camera's frustum between the depths `near` and `far` (never too few)."""
    keys, centres, radii = _all_balls(lattice)
    kept = keys[visible(centres, radii, camera, near, far)]
    return Topology(to_device_async(kept, torch.device(device)), bounds=lattice.bounds(device), host=kept)


def visible(centres: Array, radii: Array, camera: Cameras, near: float, far: float) -> Array:
    """(M,) bool: a part of the ball lies in the first camera's frustum, inside each of its six planes."""
    camera = camera[0].to("cpu")
    (fx, fy, cx, cy), (width, height), pose = camera.intrinsics[0].tolist(), camera.size[0].tolist(), camera.world_from_camera[0].numpy()
    sides = [[fx, 0, cx], [-fx, 0, width - cx], [0, fy, cy], [0, -fy, height - cy], [0, 0, 1], [0, 0, -1]]
    local = np.array(sides, np.float32)
    world = local / np.linalg.norm(local, axis=1, keepdims=True) @ pose[:3, :3].T  # unit normals, inwards
    offsets = np.array([0, 0, 0, 0, -near, min(far, 1e30)], np.float32) - world @ pose[:3, 3]
    return np.asarray((centres @ world.T + offsets + radii[:, None] > 0).all(1))


def depth_range(lattice: Lattice, topology: Topology, camera: Cameras) -> tuple[float, float]:
    """Where the blocks begin (0: at the camera) and end along the first camera's axis, working units."""
    if topology.blocks == 0:
        return 1.0, 2.0
    centres, radii = block_balls(lattice, torch.from_numpy(topology.host))
    depth = camera[0].to("cpu").local(centres)[0, :, 2]
    return max(float((depth - radii).amin()), 0.0), max(float((depth + radii).amax()), 1e-6)
