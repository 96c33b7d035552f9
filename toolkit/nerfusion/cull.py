"""Which blocks of a lattice a camera can see at all, judged before anything is unprojected, in the processor's memory: there an operation
on a few numbers is cheap, and the device is not waited for."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.camera import Array
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.volume.topology import BLOCK, Topology

SLACK = 1.25  # balls grow by this much: views see a voxel beside their images, and blocks of the contracted shell are bent


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
