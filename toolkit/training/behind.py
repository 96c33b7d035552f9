"""The colours behind everything, by direction, from the training pictures (see `render.sky`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from fieldfuse.camera import rays
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.encoding import BEHIND, SH, spherical_harmonics
from fieldfuse.render.sky import SHAPE

Tensor = torch.Tensor
PIXELS = 5_000  # that are looked at of a picture
PARTS = 8  # of the pictures in their order, each of which is predicted from the others
# Harmonics and ridge, beside a mean square of 0.08 of each harmonic over the sphere: from the mean colour alone to all of them.
CHOICES = ((1, 0.1), (4, 0.1), (4, 0.01), (4, 0.001), (9, 0.1), (9, 0.01), (9, 0.001), (9, 0.0001))


@dataclass(frozen=True)
class Sums:
    """Over pixels with colours c and harmonics Y of their directions, float64: Σ Y Yᵀ (9, 9), Σ Y cᵀ (9, 3), Σ Y (9,), Σ c (3,)."""

    square: Tensor
    product: Tensor
    harmonic: Tensor
    colour: Tensor
    count: int

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.square + other.square,
            self.product + other.product,
            self.harmonic + other.harmonic,
            self.colour + other.colour,
            self.count + other.count,
        )

    def solved(self, harmonics: int, ridge: float) -> Tensor:
        """(9, 3) coefficients by least squares towards the mean colour; those after the first `harmonics` are zero."""
        mean, kept = self.colour / self.count, slice(harmonics)
        towards = (self.product - self.harmonic[:, None] * mean) / self.count
        sky = torch.zeros(SHAPE).double()
        sky[kept] = torch.linalg.solve(self.square[kept, kept] / self.count + ridge * torch.eye(harmonics).double(), towards[kept])
        sky[0] += mean / SH[0]
        return sky

    def error(self, sky: Tensor) -> float:
        """Σ |Yᵀ sky − c|² over these pixels, less Σ |c|²."""
        return float((sky * (self.square @ sky)).sum() - 2 * (sky * self.product).sum())


def sky_behind(views: Views) -> Tensor | None:
    """(9, 3) float32 coefficients; None for captures with alpha, whose background is known.

    Least squares over the training pixels. Everything that was filmed takes part, near or far: what is asked for is what most likely lies
    beside what was seen, and no place of a surface. How many harmonics there are, and how strongly they are held back, is what predicts
    parts of the pictures best from the others: harmonics that fit what three pictures show run away where nobody looked.
    """
    if views.background is not None:
        return None
    pictures = [sums for sums in (_sums_of(views, int(index)) for index in np.flatnonzero(~np.asarray(views.test))) if sums.count > 0]
    if not pictures:
        return None
    whole = _total(pictures)
    parts = [_total(part) for part in _divided(pictures)]
    if len(parts) < 2:
        return whole.solved(*CHOICES[0]).float()
    # The rest is summed up again and not taken as a difference, which would leave few digits where one part holds nearly everything.
    rests = [_total([*parts[:index], *parts[index + 1 :]]) for index in range(len(parts))]
    errors = [sum(part.error(rest.solved(*choice)) for part, rest in zip(parts, rests, strict=True)) for choice in CHOICES]
    return whole.solved(*CHOICES[int(np.argmin(errors))]).float()


def _sums_of(views: Views, index: int) -> Sums:
    camera, picture = views.intrinsics[index], views.images[index]
    every = max(1, int(np.sqrt(camera.width * camera.height / PIXELS)))
    chosen = np.zeros((camera.height, camera.width), bool)
    chosen[every // 2 :: every, every // 2 :: every] = True
    mask = views.valid[index] if views.valid else None
    if mask is not None:
        chosen &= np.asarray(mask, bool)
    _, directions, _ = rays(camera, views.world_from_camera[index], np.argwhere(chosen)[:, ::-1] + 0.5)
    harmonics = spherical_harmonics(directions, BEHIND).double()
    colours = torch.from_numpy(picture[chosen].astype(np.float64) / 255)
    return Sums(harmonics.T @ harmonics, harmonics.T @ colours, harmonics.sum(0), colours.sum(0), len(directions))


def _total(sums: Iterable[Sums]) -> Sums:
    first, *rest = sums
    for one in rest:
        first = first + one
    return first


def _divided(pictures: list[Sums]) -> list[list[Sums]]:
    """Neighbours stay together: the next picture of a video tells nothing of places that nobody looked at."""
    ends = np.linspace(0, len(pictures), min(PARTS, len(pictures)) + 1).round().astype(int)
    return [pictures[start:end] for start, end in pairwise(ends)]
