"""Pinhole cameras as tensors, for the networks: a few views at a time, in the working frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toolkit.camera import Array, Intrinsics


@dataclass(frozen=True)
class Cameras:
    """K cameras with OpenCV axes and pixel centres at +0.5.

    Attributes:
        intrinsics: (K, 4) fx, fy, cx, cy in pixels.
        size: (K, 2) width and height in pixels.
        world_from_camera: (K, 4, 4).
    """

    intrinsics: Tensor
    size: Tensor
    world_from_camera: Tensor

    @classmethod
    def of(cls, intrinsics: Sequence[Intrinsics], world_from_camera: Array, device: torch.device | str = "cpu") -> Cameras:
        """From the toolkit's cameras; lenses are not looked at (pictures are undistorted before)."""
        inner = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in intrinsics], dtype=torch.float32, device=device)
        size = torch.tensor([[c.width, c.height] for c in intrinsics], dtype=torch.float32, device=device)
        poses = torch.from_numpy(np.asarray(world_from_camera, dtype=np.float32)).to(device)
        return cls(inner.view(-1, 4), size.view(-1, 2), poses.view(-1, 4, 4))

    @classmethod
    def same_size(cls, intrinsics: Tensor, world_from_camera: Tensor, width: int, height: int) -> Cameras:
        """(K, 4) and (K, 4, 4) of pictures of one size."""
        return cls(intrinsics, intrinsics.new_tensor([width, height]).expand(len(intrinsics), 2), world_from_camera)

    def __len__(self) -> int:
        return len(self.intrinsics)

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> Cameras:
        """Some of the cameras (one stays a bundle of one)."""
        if isinstance(index, int):
            index = [index]
        return Cameras(self.intrinsics[index], self.size[index], self.world_from_camera[index])

    @classmethod
    def together(cls, parts: Sequence[Cameras]) -> Cameras:
        """All of them in one bundle."""
        return cls(
            torch.cat([part.intrinsics for part in parts]),
            torch.cat([part.size for part in parts]),
            torch.cat([part.world_from_camera for part in parts]),
        )

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on another device."""
        return Cameras(self.intrinsics.to(device), self.size.to(device), self.world_from_camera.to(device))

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
