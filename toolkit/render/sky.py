"""What pictures show where a field has nothing: a colour for every direction, in harmonics up to degree 2.

Fits composite on one colour, which has no more to say than that nothing is there. Places that no training picture shows are most often
like what was seen in about the same direction, so whole pictures are composited on that.
"""

from __future__ import annotations

import math

import torch

from fieldfuse.nerfusion.encoding import BEHIND, spherical_harmonics

Tensor = torch.Tensor
SHAPE = (BEHIND, 3)
LARGEST = 1e3  # coefficient that a file may hold
CLOSED = 0.999  # opacity from which on nothing shines through that one could see


def sky_colours(sky: Tensor, directions: Tensor) -> Tensor:
    """(9, 3) coefficients, (N, 3) unit vectors → (N, 3) colours in [0, 1]."""
    return (spherical_harmonics(directions, BEHIND) @ sky).clamp(0, 1)


def on_sky(colour: Tensor, opacity: Tensor, directions: Tensor, background: Tensor, sky: Tensor | None) -> Tensor:
    """Colours (N, 3) of rays that were composited on `background` (3,), as they are on `sky`; the same tensor without one.

    Args:
        opacity: (N,) in [0, 1].
        directions: (N, 3) unit vectors.
    """
    if sky is None:
        return colour
    through = (opacity < CLOSED).nonzero().view(-1)
    out = colour.clone()
    out[through] += (1 - opacity[through])[:, None] * (sky_colours(sky, directions[through]) - background)
    return out.clamp(0, 1)


def checked_sky(values: list[list[float]] | None) -> Tensor | None:
    """The coefficients in a file's header, None where it has none.

    Raises:
        ValueError: they are not coefficients of colours.
    """
    if values is None:
        return None
    sky = torch.tensor(values, dtype=torch.float32)
    if tuple(sky.shape) != SHAPE or not math.isfinite(float(sky.abs().sum())) or float(sky.abs().max()) > LARGEST:
        raise ValueError("its sky is not one")
    return sky
