"""J, the local reconstruction network of NeRFusion (section 3.1, eq. 2), and the part of R (eq. 5) that the field stores: density and
features, of local and global volumes alike."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from fieldfuse.backends import dispatch
from fieldfuse.backends.constants import INSIDE
from fieldfuse.nerfusion.block_conv import BlockConv3d, Prepared
from fieldfuse.nerfusion.extras.known_terms import COLOUR_SCALE, bounded, soft_bound
from fieldfuse.volume.topology import Topology

START = -0.5  # log optical thickness of a voxel on the surface at the start
SCALE = 3.0  # the density output's gain
CHANGE = 0.5  # most that the learned part may add to what the latent holds, before the gain
STEEP = 2.0  # of the start: latents of ±0.93 are a voxel of exp(−7.6) and one of exp(3.6)


class LocalReconstruction(nn.Module):
    """Per-voxel projection to few channels, then `layers` sparse 3×3×3 convolutions with ReLU between them.

    The views' mean colour is added to the first three outputs, which by convention are the voxel's colour, and the distance behind the
    surface that the plane sweep expects to the fourth, from which the head's density starts: so a local volume carries the images'
    colours and a geometry from the first step on, and the network learns what to change. Without the second, colours alone do not find
    surfaces: a fog of mean colours is a minimum of its own.
    """

    def __init__(self, inputs: int, hidden: int, channels: int, layers: int = 5) -> None:
        super().__init__()
        self.project = nn.Linear(inputs, hidden)
        nn.init.kaiming_normal_(self.project.weight, nonlinearity="relu")
        nn.init.zeros_(self.project.bias)
        widths = [hidden] * layers + [channels]
        self.convolutions = nn.ModuleList(BlockConv3d(a, b) for a, b in pairwise(widths))
        self._prepared = Prepared()
        last = self.convolutions[-1]
        assert isinstance(last, BlockConv3d)
        nn.init.kaiming_normal_(last.weight, nonlinearity="linear")
        with torch.no_grad():
            last.weight.mul_(0.5)  # mostly within tanh's straight part
            last.weight[: INSIDE + 1].mul_(0.1)  # they start as what is added to them

    def forward(self, rows: Tensor, start: Tensor, topology: Topology, seen: Tensor) -> Tensor:
        """Raw local volume, before tanh.

        Args:
            rows: (M · 512 + 1, hidden) projected evidence (`project`, with ReLU), zero where nothing is seen.
            start: (M · 512 + 1, channels) latent mean colours and distance behind the surface, then zeros; zero where nothing is seen.
            seen: (M · 512,) bool.

        Returns:
            (M · 512 + 1, channels), zero where nothing is seen.
        """
        return bounded(self.learned(rows, topology, seen)) + start

    def learned(self, rows: Tensor, topology: Topology, seen: Tensor) -> Tensor:
        """(M · 512 + 1, channels) what the convolutions give, before it is `bounded` and added to the start."""
        if not torch.is_grad_enabled() and dispatch.can_use_triton(rows, dtypes=dispatch.FLOATS):
            return self._prepared.convolve([[layer] for layer in self.convolutions if isinstance(layer, BlockConv3d)], rows, topology, seen)
        for number, convolution in enumerate(self.convolutions):
            rows = convolution(rows, topology, seen, number > 0)
        return rows


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
