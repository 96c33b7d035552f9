"""Textures of any sizes with their mip levels in one list of texels, sampled between texels and between levels."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from fieldfuse.camera import Array

Tensor = torch.Tensor

LEVELS = 8


class Atlas:
    """Args:
    linear: (h, w, 3) float32 linear pictures in [0, 1], each of any size.
    mirrored: beyond [0, 1] a texture is mirrored; else it is repeated.

    Attributes:
        texels: (total, 4) uint8, square root of linear colour (the fourth is padding: a texel is one 32-bit word).
        table: (LEVELS · count, 3) int64: first texel, width and height of texture t at level l in row l · count + t.
    """

    def __init__(self, linear: list[Array], mirrored: bool = True) -> None:
        self.count, self.mirrored = len(linear), mirrored
        rows, first = [], 0
        for level in range(LEVELS):
            for image in linear:
                height, width = (max(1, size >> level) for size in image.shape[:2])
                rows.append((first, width, height))
                first += width * height
        texels = np.zeros((first, 4), dtype=np.uint8)
        for number, image in enumerate(linear):
            for level in range(LEVELS):
                start, width, height = rows[level * self.count + number]
                if level:
                    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
                texels[start : start + width * height, :3] = np.round(np.sqrt(np.clip(image, 0, 1)) * 255).reshape(-1, 3)
        self.texels = torch.from_numpy(texels)
        self.table = torch.tensor(rows)

    def _move(self, device: torch.device | str) -> None:
        self.texels, self.table = self.texels.to(device), self.table.to(device)

    def sample(self, texture: Tensor, place: Tensor, footprint: Tensor) -> Tensor:
        """(N, 3) linear colour.

        Args:
            texture: (N,) int64.
            place: (N, 2) in texture widths and heights, from the upper left corner.
            footprint: (N,) width of a pixel on the surface in texture widths: textures are blurred to it.
        """
        level = torch.log2((footprint * self.table[texture, 1]).clamp(min=1e-6)).clamp(0, LEVELS - 1 - 1e-3)
        lower = level.floor()
        between = level - lower
        folded = 1 - (torch.remainder(place, 2) - 1).abs() if self.mirrored else torch.remainder(place, 1)  # (N, 2) in [0, 1]
        total = torch.zeros(len(texture), 4, device=place.device)
        for step, share in ((0, 1 - between), (1, between)):
            first, width, height = self.table[(lower.long() + step) * self.count + texture].unbind(1)
            left, right, in_right = self._pair(folded[:, 0], width)
            upper, under, in_under = self._pair(folded[:, 1], height)
            for row, in_row in ((upper, (1 - in_under) * share), (under, in_under * share)):
                start = first + row * width
                for column, in_column in ((left, 1 - in_right), (right, in_right)):
                    total.addcmul_(self.texels[start + column].float().square_(), (in_row * in_column)[:, None])
        return total[:, :3] * (1 / 255**2)

    def _pair(self, place: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The two texels that (N,) places in [0, 1] lie between, and the share of the second."""
        at = place * size - 0.5
        corner = at.floor()
        low = corner.long()
        if self.mirrored:  # what is beyond the border is the border again
            return low.clamp(min=0), torch.minimum(low + 1, size - 1), at - corner
        return torch.remainder(low, size), torch.remainder(low + 1, size), at - corner
