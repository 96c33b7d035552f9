"""Which blocks of a lattice a few cameras can see at all, judged before anything is unprojected."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import is_cpu, to_device_async
from fieldfuse.camera import Array
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.volume.topology import BLOCK, Topology

SLACK = 1.25  # balls grow by this much: views tell of a voxel beside their pictures, and blocks of the contracted shell are bent


def all_blocks(lattice: Lattice, device: torch.device | str = "cpu") -> Tensor:
    """(M, 3) int32 keys of every block that holds a corner of the space (without a shell: of its box)."""
    space = lattice.space
    line = torch.arange(lattice.resolution // BLOCK + 1, device=device)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    keys = torch.stack([x, y, z], -1).view(-1, 3)
    if space.shell == 0:
        box = torch.tensor(space.box, device=device) + lattice.voxel
        low = keys * (BLOCK * lattice.voxel) - space.extent
        high = low + (BLOCK - 1) * lattice.voxel
        keys = keys[((low <= box) & (high >= -box)).all(1)]
    return keys.int()


def block_balls(lattice: Lattice, keys: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 3) keys → centres (M, 3) and radii (M,) of balls around each block's corners, working frame."""
    offsets = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], device=keys.device) * (BLOCK - 1)
    corners = (keys[:, None].long() * BLOCK + offsets).float() * lattice.voxel - lattice.space.extent
    centre = lattice.space.to_working(corners.mean(1))
    radius = (lattice.space.to_working(corners.view(-1, 3)).view(-1, 8, 3) - centre[:, None]).norm(dim=2).amax(1)
    return centre, radius * SLACK


def visible_blocks(centres: Tensor, radii: Tensor, cameras: Cameras, near: float, far: float) -> Tensor:
    """(M,) bool: a part of the ball lies in at least one camera's frustum between the depths `near` and `far` (never too few)."""
    if not is_cpu(centres.device):
        normals, offsets = (to_device_async(values, centres.device) for values in _planes(cameras.to("cpu"), near, far))
        apart = torch.addmm(offsets, centres, normals.T) + radii[:, None]  # (M, K · 6)
        return (apart > 0).view(len(centres), -1, 6).all(2).any(1)
    local = cameras.local(centres)  # (K, M, 3)
    fx, fy, cx, cy = (value[:, None] for value in cameras.intrinsics.unbind(1))
    width, height = (value[:, None] for value in cameras.size.unbind(1))
    x, y, z = local.unbind(2)
    inside = (z > near - radii) & (z < far + radii)
    # Distance to the four side planes through the camera: n · p with unit normals that point inwards.
    for focal, across, low, high in ((fx, x, -cx, width - cx), (fy, y, -cy, height - cy)):
        inside &= (focal * across - low * z) / (focal**2 + low**2).sqrt() > -radii
        inside &= (high * z - focal * across) / (focal**2 + high**2).sqrt() > -radii
    return inside.any(0)


def visible_at_once(centres: Array, radii: Array, cameras: Cameras, near: float, far: float) -> Array:
    """`visible_blocks` in the processor's memory, where each operation on a few numbers costs more than on all blocks."""
    normals, offsets = _planes(cameras.to("cpu"), near, far)
    apart = centres @ normals.T + offsets + radii[:, None]  # (M, K · 6)
    return np.any(np.all(apart.reshape(len(centres), -1, 6) > 0, axis=2), axis=1)


def _planes(cameras: Cameras, near: float, far: float) -> tuple[Array, Array]:
    """(K · 6, 3) unit normals of the frusta's planes, inwards, working frame, and (K · 6,) offsets: x lies n · x + offset inside.

    Args:
        cameras: on the CPU.
    """
    lens, size, poses = cameras.intrinsics.numpy(), cameras.size.numpy(), cameras.world_from_camera.numpy()
    local = np.zeros((len(lens), 6, 3), np.float32)
    low, high = lens[:, 2:], size - lens[:, 2:]
    for axis in (0, 1):
        local[:, 2 * axis, axis], local[:, 2 * axis, 2] = lens[:, axis], low[:, axis]
        local[:, 2 * axis + 1, axis], local[:, 2 * axis + 1, 2] = -lens[:, axis], high[:, axis]
    local[:, 4, 2], local[:, 5, 2] = 1, -1
    local /= np.linalg.norm(local, axis=2, keepdims=True)
    world = local @ poses[:, :3, :3].transpose(0, 2, 1)
    ends = np.array([0, 0, 0, 0, -near, min(far, 1e30)], np.float32)
    offsets = ends - (world * poses[:, None, :3, 3]).sum(2)
    return world.reshape(-1, 3), offsets.reshape(-1).astype(np.float32)


def frustum(lattice: Lattice, cameras: Cameras, near: float, far: float) -> Topology:
    """The blocks of the lattice in the first camera's frustum."""
    keys = all_blocks(lattice, cameras.intrinsics.device)
    keys = keys[visible_blocks(*block_balls(lattice, keys), cameras[0], near, far)]
    return Topology(keys, bounds=lattice.bounds(keys.device))


def depth_range(lattice: Lattice, topology: Topology, cameras: Cameras) -> tuple[float, float]:
    """Where the blocks begin (0: at the camera) and end along the first camera's axis, working units."""
    if topology.blocks == 0:
        return 1.0, 2.0
    centres, radii = block_balls(lattice, topology.keys)
    depth = cameras[0].local(centres)[0, :, 2]
    return max(float((depth - radii).amin()), 0.0), max(float((depth + radii).amax()), 1e-6)
