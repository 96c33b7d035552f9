"""From a latent voxel to what the radiance field stores of it: density and features, of local and global volumes alike."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fieldfuse.backends.constants import INSIDE
from fieldfuse.nerfusion.extras.bounded_outputs import soft_bound
from fieldfuse.nerfusion.extras.known_terms import COLOUR_SCALE

START = -0.5  # log optical thickness of a voxel on the surface at the start
SCALE = 3.0  # the density output's gain
CHANGE = 0.5  # most that the learned part may add to what the latent says, before the gain
STEEP = 2.0  # of the start: latents of ±0.93 are a voxel of exp(−7.6) and one of exp(3.6)


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
        self.steep = nn.Parameter(torch.tensor(STEEP))  # density rises behind the surface
        self.features = nn.Linear(hidden, features)
        self.skip = nn.Linear(channels, features, bias=False)
        nn.init.kaiming_normal_(self.density.weight, nonlinearity="linear")
        nn.init.zeros_(self.density.bias)
        with torch.no_grad():
            self.density.weight.mul_(0.1)
            self.features.weight.mul_(0.1)
            nn.init.zeros_(self.features.bias)
            nn.init.zeros_(self.skip.weight)
            self.skip.weight[:, :].fill_diagonal_(1.0)
            self.skip.weight[:3].mul_(COLOUR_SCALE)

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Start, gain and most that may be learned of the thickness, for what computes it elsewhere."""
        return START, SCALE, CHANGE

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.body(latent)
        return self._thickness(latent, hidden), self.features(hidden) + self.skip(latent)

    def thickness(self, latent: Tensor) -> Tensor:
        """The first of the two alone."""
        return self._thickness(latent, self.body(latent))

    def _thickness(self, latent: Tensor, hidden: Tensor) -> Tensor:
        learned = soft_bound(self.density(hidden).squeeze(1), CHANGE)
        return START + SCALE * (learned + self.steep * latent[:, INSIDE])
