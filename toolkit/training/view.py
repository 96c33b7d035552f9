"""How much a decoder may make of the viewing direction: nothing, the first-order harmonics, or all of them.

The columns of the weights that take the other harmonics are zero and stay zero, so field files, kernels and renderers need to know nothing.
"""

from __future__ import annotations

import torch

from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.nerfusion.encoding import DIRECTION

Tensor = torch.Tensor
HARMONICS = {"none": 0, "low": 4, "full": DIRECTION, "auto": DIRECTION}  # of spherical_harmonics, lowest first


def of_direction(decoder: Deferred | PerSample) -> Tensor:
    """(hidden, 16) the weights that take the direction; a view of the parameter."""
    first = decoder.layers[0] if isinstance(decoder, Deferred) else decoder.colour[0]
    assert isinstance(first, torch.nn.Linear)
    return first.weight.detach()[:, -DIRECTION:]


def limit(decoder: Deferred | PerSample, view: str) -> None:
    """Take away the harmonics that `view` (none | low | full) does not have."""
    of_direction(decoder)[:, HARMONICS[view] :] = 0.0


def blind(decoder: Deferred | PerSample) -> Tensor:
    """(16,) bool: harmonics that the decoder does not see and must not learn to."""
    return (of_direction(decoder) == 0).all(0)
