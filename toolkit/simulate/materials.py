"""Surfaces' colours: a bank of procedural textures with mip levels, and the materials that look them up at a metric scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch

from toolkit.camera import Array
from toolkit.simulate import patterns, textures

Tensor = torch.Tensor

SIZE = 512  # texels of a texture's side
LEVELS = 8  # mip levels: down to 4 × 4
GAMMA = 2.2  # what the procedural pictures are stored in
PLAIN = "plain"  # the texture that is white all over

MAKERS: dict[str, tuple[Callable[[np.random.Generator, int], Array], int]] = {  # and how many of each a bank holds
    "planks": (patterns.planks, 5),
    "bricks": (patterns.bricks, 4),
    "tiles": (patterns.tiles, 5),
    "cloth": (patterns.cloth, 6),
    "books": (patterns.books, 3),
    "ground": (patterns.ground, 4),
    "plaster": (patterns.plaster, 4),
    "paper": (patterns.paper, 4),
    "posters": (patterns.posters, 4),
    "terrazzo": (lambda rng, size: textures.terrazzo(rng, size, size), 3),
    "carton": (lambda rng, size: textures.carton(rng, size, size), 8),
    "marble": (lambda rng, size: textures.marble(rng, size, size), 4),
    "picture": (lambda rng, size: textures.picture(rng, size, size), 8),
}


class TextureBank:
    """Square textures of one size, all mip levels in one list of texels.

    Attributes:
        texels: (total, 4) uint8, square root of linear colour (the fourth is padding: a texel is one 32-bit word).
        kinds: texture numbers by kind of surface.
    """

    def __init__(self, pictures: list[Array], kinds: dict[str, list[int]]) -> None:
        """Args: pictures: (size, size, 3) sRGB float32 in [0, 1], one size, a power of two of at least 128."""
        self.kinds, self.count, self.size = kinds, len(pictures), pictures[0].shape[0]
        levels = []
        linear: list[Array] = [np.clip(image, 0, 1).astype(np.float32) ** GAMMA for image in pictures]
        for level in range(LEVELS):
            side = self.size >> level
            if level:
                linear = [cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA) for image in linear]
            levels += [np.round(np.sqrt(image) * 255).astype(np.uint8).reshape(-1, 3) for image in linear]
        flat = np.concatenate(levels)
        self.texels = torch.from_numpy(np.pad(flat, ((0, 0), (0, 1))))
        first, sides = 0, []
        for level in range(LEVELS):
            sides.append((first, self.size >> level))
            first += self.count * (self.size >> level) ** 2
        self.starts = torch.tensor([start for start, _ in sides])  # (LEVELS,)

    def to(self, device: torch.device | str) -> TextureBank:
        if self.texels.device == torch.device(device):
            return self
        moved = object.__new__(TextureBank)
        moved.kinds, moved.count, moved.size = self.kinds, self.count, self.size
        moved.texels, moved.starts = self.texels.to(device), self.starts.to(device)
        return moved

    def sample(self, texture: Tensor, place: Tensor, footprint: Tensor) -> Tensor:
        """(N, 3) linear colour of textures (N,) at places (N, 2) in texture widths, mirrored beyond [0, 1].

        Args:
            footprint: (N,) width of a pixel on the surface in texture widths; textures are blurred to it (trilinear).
        """
        level = torch.log2((footprint * self.size).clamp(min=1e-6)).clamp(0, LEVELS - 1 - 1e-3)
        lower = level.floor()
        between = level - lower
        folded = 1 - (torch.remainder(place, 2) - 1).abs()  # (N, 2) in [0, 1]
        rows, weights = [], []
        for step, share in ((0, 1 - between), (1, between)):
            number = lower.long() + step
            side = torch.bitwise_right_shift(torch.full_like(number, self.size), number)
            at = folded * side[:, None] - 0.5
            corner = at.floor()
            part = at - corner
            first = self.starts[number] + texture * side * side
            low = corner.long().clamp(min=0)
            high = torch.minimum(corner.long() + 1, side[:, None] - 1)
            for v, in_v in ((low[:, 1], 1 - part[:, 1]), (high[:, 1], part[:, 1])):
                start = first + v * side
                for u, in_u in ((low[:, 0], 1 - part[:, 0]), (high[:, 0], part[:, 0])):
                    rows.append(start + u)
                    weights.append(in_u * in_v * share)
        total = torch.zeros(len(texture), 4, device=place.device)
        for row, weight in zip(rows, weights, strict=True):
            root = self.texels[row].float()
            total.addcmul_(root.square_(), weight[:, None])
        return total[:, :3] * (1 / 255**2)


@lru_cache(maxsize=2)
def texture_bank(seed: int = 0, size: int = SIZE) -> TextureBank:
    """The bank that procedural scenes share (about a second to make, once a process). Another seed gives other pictures."""
    pictures, kinds = [np.ones((size, size, 3), dtype=np.float32)], {PLAIN: [0]}
    for number, (kind, (maker, count)) in enumerate(MAKERS.items()):
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
