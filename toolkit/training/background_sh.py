"""The colours behind everything, by direction, from the training images (see `render.sky`)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from fieldfuse.camera import rays
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.encoding import BEHIND, SH, spherical_harmonics

Tensor = torch.Tensor
PIXELS = 5_000  # that are used of an image
PARTS = 8  # of the images in their order, each of which is predicted from the others
# Harmonics and ridge, beside a mean square of 0.08 of each harmonic over the sphere: from the mean colour alone to all of them.
CHOICES = ((1, 0.1), (4, 0.1), (4, 0.01), (4, 0.001), (9, 0.1), (9, 0.01), (9, 0.001), (9, 0.0001))


def sky_behind(views: Views) -> Tensor | None:
    """(9, 3) float32 coefficients; None for captures with alpha, whose background is known.

    Least squares over the training pixels. Everything that was filmed takes part, near or far: wanted is what most likely lies beside what
    was seen, and no place of a surface. How many harmonics there are, and how strongly they are held back, is what predicts parts of the
    images best from the others: harmonics that fit what three images show run away where nobody looked.
    """
    if views.background is not None:
        return None
    products = [_products(views, int(index)) for index in np.flatnonzero(~np.asarray(views.test))]
    products = [one for one in products if one[0, 0] > 0]
    if not products:
        return None
    # Neighbours stay together: the next image of a video tells nothing of places that nobody looked at.
    ends = np.linspace(0, len(products), min(PARTS, len(products)) + 1).round().astype(int)
    parts = [torch.stack(products[start:end]).sum(0) for start, end in pairwise(ends)]
    choice = CHOICES[0]
    if len(parts) > 1:
        # The rest is summed up again and not taken as a difference, which would leave few digits where one part holds nearly everything.
        rests = [torch.stack([*parts[:index], *parts[index + 1 :]]).sum(0) for index in range(len(parts))]
        errors = [sum(_error(part, _solved(rest, *each)) for part, rest in zip(parts, rests, strict=True)) for each in CHOICES]
        choice = CHOICES[int(np.argmin(errors))]
    return _solved(torch.stack(parts).sum(0), *choice).float()


def _products(views: Views, index: int) -> Tensor:
    """(12, 12) float64 Σ v vᵀ over an image's pixels, v their 9 harmonics Y (the first of them a constant) and 3 colours c."""
    camera, image = views.intrinsics[index], views.images[index]
    every = max(1, int(np.sqrt(camera.width * camera.height / PIXELS)))
    chosen = np.zeros((camera.height, camera.width), bool)
    chosen[every // 2 :: every, every // 2 :: every] = True
    mask = views.valid[index] if views.valid else None
    if mask is not None:
        chosen &= np.asarray(mask, bool)
    _, directions, _ = rays(camera, views.world_from_camera[index], np.argwhere(chosen)[:, ::-1] + 0.5)
    values = torch.cat([spherical_harmonics(directions, BEHIND).double(), torch.from_numpy(image[chosen].astype(np.float64) / 255)], 1)
    return values.T @ values


def _solved(products: Tensor, harmonics: int, ridge: float) -> Tensor:
    """(9, 3) coefficients by least squares towards the mean colour; those after the first `harmonics` are zero."""
    mean = products / (products[0, 0] / SH[0] ** 2)
    square, kept, colour = mean[:BEHIND, :BEHIND], slice(harmonics), mean[0, BEHIND:] / SH[0]
    towards = mean[:BEHIND, BEHIND:] - square[:, :1] / SH[0] * colour
    sky = torch.zeros(BEHIND, 3, dtype=torch.float64)
    sky[kept] = torch.linalg.solve(square[kept, kept] + ridge * torch.eye(harmonics).double(), towards[kept])
    sky[0] += colour / SH[0]
    return sky


def _error(products: Tensor, sky: Tensor) -> float:
    """Σ |Yᵀ sky − c|² over these pixels, less Σ |c|²."""
    return float((sky * (products[:BEHIND, :BEHIND] @ sky)).sum() - 2 * (sky * products[:BEHIND, BEHIND:]).sum())
