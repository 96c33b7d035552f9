"""Surfaces' colours: a bank of procedural textures with mip levels, and the materials that look them up at a metric scale."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.simulate import patterns, textures
from fieldfuse.simulate.atlas import Atlas

Tensor = torch.Tensor

SIZE = 512  # texels of a texture's side
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


class TextureBank(Atlas):
    """Square procedural pictures, sorted by what they can be on.

    Attributes:
        kinds: texture numbers by kind of surface.
    """

    def __init__(self, pictures: list[Array], kinds: dict[str, list[int]]) -> None:
        """Args: pictures: (size, size, 3) sRGB float32 in [0, 1]."""
        super().__init__([np.clip(image, 0, 1).astype(np.float32) ** GAMMA for image in pictures])
        self.kinds = kinds

    def to(self, device: torch.device | str) -> TextureBank:
        if self.texels.device == torch.device(device):
            return self
        moved = copy(self)
        moved._move(device)
        return moved


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
