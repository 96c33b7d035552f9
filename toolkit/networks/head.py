"""From a latent voxel to what the radiance field stores of it: density and features, of local and global volumes alike."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from toolkit.networks.local import AGREEMENT, COLOUR_SCALE

START = -3.0  # log optical thickness of a voxel at the start: thin enough that every voxel along a ray is tried
SCALE = 3.0  # the density output's gain, so that latents of ±1 span fog and walls


class FieldHead(nn.Module):
    """(N, channels) latents in (−1, 1) → (N,) logarithm of a voxel's optical thickness, and (N, features).

    Thickness is counted per voxel, so that the network need not know how large voxels are. The first three features are colour logits.
    """

    def __init__(self, channels: int, hidden: int, features: int) -> None:
        super().__init__()
        first = nn.Linear(channels, hidden)
        nn.init.kaiming_normal_(first.weight, nonlinearity="relu")
        nn.init.zeros_(first.bias)
        self.body = nn.Sequential(first, nn.ReLU())
        self.density = nn.Linear(hidden, 1)
        self.agreement = nn.Linear(channels, 1, bias=False)  # density starts where the views agree
        self.features = nn.Linear(hidden, features)
        self.skip = nn.Linear(channels, features, bias=False)
        nn.init.kaiming_normal_(self.density.weight, nonlinearity="linear")
        nn.init.zeros_(self.density.bias)
        with torch.no_grad():
            self.density.weight.mul_(0.1)
            nn.init.zeros_(self.agreement.weight)
            self.agreement.weight[:, AGREEMENT] = 1.0
            self.features.weight.mul_(0.1)
            nn.init.zeros_(self.features.bias)
            nn.init.zeros_(self.skip.weight)
            self.skip.weight[:, :].fill_diagonal_(1.0)
            self.skip.weight[:3].mul_(COLOUR_SCALE)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.body(latent)
        return self._thickness(latent, hidden), self.features(hidden) + self.skip(latent)

    def thickness(self, latent: Tensor) -> Tensor:
        """The first of the two alone."""
        return self._thickness(latent, self.body(latent))

    def _thickness(self, latent: Tensor, hidden: Tensor) -> Tensor:
        return START + SCALE * (self.density(hidden) + self.agreement(latent)).squeeze(1)
