"""Pinhole cameras as tensors, for the networks: a few views at a time, in the working frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.camera import Array, Intrinsics


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
        lenses = np.array([(c.fx, c.fy, c.cx, c.cy) for c in intrinsics], np.float32)
        sizes = np.array([(c.width, c.height) for c in intrinsics], np.float32)
        return cls(*map(torch.from_numpy, (lenses, sizes, np.asarray(world_from_camera).astype(np.float32)))).to(device)

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
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in ("intrinsics", "size", "world_from_camera")))

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
        return Cameras(*(new.view(old.shape) for new, old in zip(moved, parts, strict=True)), self if on_cpu else None)

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
