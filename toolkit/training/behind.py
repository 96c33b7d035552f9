"""The colours behind everything, by direction, from the training pictures (see `render.sky`)."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.camera import pixel_grid, rays
from toolkit.capture.types import Views
from toolkit.networks.encoding import SH, spherical_harmonics
from toolkit.render.sky import SHAPE

Tensor = torch.Tensor
PIXELS = 20_000  # that are looked at of a picture
RIDGE = 1e-4  # beside a mean square of 0.08 of each harmonic over the sphere: directions that nobody filmed must not run away


def sky_behind(views: Views) -> Tensor | None:
    """(9, 3) float32 coefficients; None for captures with alpha, whose background is known.

    Least squares over the training pixels, towards their mean. Everything that was filmed takes part, near or far: what is asked for is
    what most likely lies beside what was seen, and no place of a surface.
    """
    train = np.flatnonzero(~np.asarray(views.test))
    if views.background is not None:
        return None
    square, product = torch.zeros(SHAPE[0], SHAPE[0]).double(), torch.zeros(SHAPE).double()
    harmonic, colour, count = torch.zeros(SHAPE[0]).double(), torch.zeros(SHAPE[1]).double(), 0
    for index in train:
        camera, picture = views.intrinsics[index], views.images[index]
        every = max(1, int(np.sqrt(camera.width * camera.height / PIXELS)))
        chosen = np.zeros((camera.height, camera.width), bool)
        chosen[every // 2 :: every, every // 2 :: every] = True
        mask = views.valid[index] if views.valid else None
        if mask is not None:
            chosen &= np.asarray(mask, bool)
        _, directions, _ = rays(camera, views.world_from_camera[index], pixel_grid(camera.width, camera.height)[chosen.ravel()])
        harmonics = spherical_harmonics(directions).double()
        square += harmonics.T @ harmonics
        colours = torch.from_numpy(picture[chosen].astype(np.float64) / 255)
        product += harmonics.T @ colours
        harmonic += harmonics.sum(0)
        colour += colours.sum(0)
        count += len(directions)
    if count == 0:
        return None
    mean = colour / count
    sky = torch.linalg.solve(square / count + RIDGE * torch.eye(SHAPE[0]).double(), (product - harmonic[:, None] * mean) / count)
    sky[0] += mean / SH[0]
    return sky.float()
