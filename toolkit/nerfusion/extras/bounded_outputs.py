"""Bounds on how far networks may move the surface that is known (not in the paper).

Without them networks paint images right before the cameras of key frames, which explains neighbouring views just as well as surfaces.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fieldfuse.backends.constants import CHANGE, INSIDE


def soft_bound(learned: Tensor, most: float) -> Tensor:
    """What is learned, kept within ± `most` without a kink."""
    return most * torch.tanh(learned / most)


def bounded(learned: Tensor) -> Tensor:
    """(N, channels) learned additions to a latent; that to the distance behind the surface is kept within ± `CHANGE`."""
    return torch.cat([learned[:, :INSIDE], soft_bound(learned[:, INSIDE : INSIDE + 1], CHANGE), learned[:, INSIDE + 1 :]], 1)
