"""Surfaces' colours: a bank of procedural textures with mip levels, and the materials that look them up at a metric scale."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.simulate import textures

Tensor = torch.Tensor

LEVELS = 8  # of a texture's mip levels
SIZE = 512  # texels of a texture's side
GAMMA = 2.2  # of the procedural textures
PLAIN = "plain"  # the texture that is white all over

# How many of each a bank holds, and metres that one copy of a texture covers, from and to
MAKERS: dict[str, tuple[Callable[[np.random.Generator, int], Array], int, tuple[float, float]]] = {
    "planks": (textures.planks, 5, (0.9, 1.6)),
    "bricks": (textures.bricks, 4, (1.2, 2.2)),
    "tiles": (textures.tiles, 5, (0.8, 1.8)),
    "cloth": (textures.cloth, 6, (0.5, 1.2)),
    "books": (textures.books, 3, (0.8, 1.2)),
    "ground": (textures.ground, 4, (1.0, 2.5)),
    "plaster": (textures.plaster, 4, (1.5, 3.0)),
    "paper": (textures.paper, 4, (0.8, 1.6)),
    "posters": (textures.posters, 4, (1.6, 2.6)),
    "terrazzo": (lambda rng, size: textures.terrazzo(rng, size, size), 3, (1.2, 2.4)),
    "carton": (lambda rng, size: textures.carton(rng, size, size), 8, (0.35, 0.7)),
    "marble": (lambda rng, size: textures.marble(rng, size, size), 4, (0.5, 1.2)),
    "picture": (lambda rng, size: textures.picture(rng, size, size), 8, (0.6, 1.2)),
}
WIDTHS = {PLAIN: (1.0, 1.0)} | {kind: widths for kind, (_, _, widths) in MAKERS.items()}


class Atlas:
    """Args:
    linear: (h, w, 3) float32 linear images in [0, 1], each of any size.
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


class TextureBank(Atlas):
    """Square procedural textures, sorted by what they can be on.

    Attributes:
        kinds: texture numbers by kind of surface.
    """

    def __init__(self, pictures: list[Array], kinds: dict[str, list[int]]) -> None:
        """Args: pictures: (size, size, 3) sRGB float32 in [0, 1]."""
        super().__init__([np.clip(image, 0, 1).astype(np.float32) ** GAMMA for image in pictures])
        self.kinds = kinds

    def with_pictures(self, pictures: list[Array]) -> TextureBank:
        """The bank with (h, w, 3) sRGB pictures more, of any size; they are numbered on from `count`."""
        more = Atlas([np.clip(image, 0, 1).astype(np.float32) ** GAMMA for image in pictures])
        joined = copy(self)
        joined.texels, joined.count = torch.cat([self.texels, more.texels.to(self.texels.device)]), self.count + more.count
        shifted = more.table + torch.tensor([len(self.texels), 0, 0])
        rows = [part for level in zip(self.table.cpu().split(self.count), shifted.split(more.count), strict=True) for part in level]
        joined.table = torch.cat(rows).to(self.table.device)
        return joined

    def to(self, device: torch.device | str) -> TextureBank:
        if self.texels.device == torch.device(device):
            return self
        moved = copy(self)
        moved.texels, moved.table = self.texels.to(device), self.table.to(device)
        return moved


@lru_cache(maxsize=2)
def texture_bank(seed: int = 0, size: int = SIZE) -> TextureBank:
    """The bank that procedural scenes share (about a second to make, once a process). Another seed gives others."""
    pictures, kinds = [np.ones((size, size, 3), dtype=np.float32)], {PLAIN: [0]}
    for number, (kind, (maker, count, _)) in enumerate(MAKERS.items()):
        rng = np.random.default_rng([seed, 77, number])
        kinds[kind] = list(range(len(pictures), len(pictures) + count))
        pictures += [maker(rng, size).astype(np.float32) for _ in range(count)]
    return TextureBank(pictures, kinds)


@dataclass(frozen=True)
class Material:
    """One surface: a texture at a metric scale, tinted, with a gloss."""

    texture: int = 0
    width: float = 1.0  # metres that one copy of the texture covers
    offset: tuple[float, float] = (0.0, 0.0)  # in texture widths
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)  # linear factors
    gloss: float = 0.0  # strength of highlights, where the scene has them
    sharpness: float = 30.0  # exponent of highlights


class Materials:
    """All materials of a scene as tensors."""

    def __init__(self, items: list[Material], device: torch.device | str = "cpu") -> None:
        self.items = items
        self.texture = torch.tensor([m.texture for m in items], device=device)  # (M,)
        self.width = torch.tensor([m.width for m in items], device=device)
        self.offset = torch.tensor([m.offset for m in items], device=device)  # (M, 2)
        self.tint = torch.tensor([m.tint for m in items], device=device)  # (M, 3)
        self.gloss = torch.tensor([m.gloss for m in items], device=device)
        self.sharpness = torch.tensor([m.sharpness for m in items], device=device)

    def albedo(self, bank: TextureBank, number: Tensor, place: Tensor, footprint: Tensor) -> Tensor:
        """(N, 3) linear reflectance of materials (N,) at places (N, 2) metres; `footprint` (N,) metres."""
        width = self.width[number]
        colour = bank.sample(self.texture[number], place / width[:, None] + self.offset[number], footprint / width)
        return (colour * self.tint[number]).clamp_(max=0.95)
