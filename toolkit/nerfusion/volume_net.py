"""J, the local reconstruction network of NeRFusion (section 3.1, eq. 2): sparse convolutions from evidence to a local volume."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.block_conv import BlockConv3d, Prepared
from fieldfuse.volume.topology import Topology

COLOUR_SCALE = 4.0  # a latent colour of ±1 is a colour logit of ±4
INSIDE = 3  # the latent that starts as how far behind the surface the voxel lies
MOST = 0.93  # latent colours are kept inside this, so that tanh is not driven to its ends
CHANGE = 0.5  # most that networks may add to the distance behind the surface, before tanh: free space of which the sweep is sure stays so


def within(learned: Tensor, most: float) -> Tensor:
    """What is learned, kept within ± `most` without a kink."""
    return most * torch.tanh(learned / most)


def held(learned: Tensor) -> Tensor:
    """(N, channels) learned additions to a latent; that to the distance behind the surface is kept within ± `CHANGE`.

    Without it networks paint pictures right before the cameras of key frames, which explains neighbouring views just as well as surfaces.
    """
    return torch.cat([learned[:, :INSIDE], within(learned[:, INSIDE : INSIDE + 1], CHANGE), learned[:, INSIDE + 1 :]], 1)


def inside_latent(signed: Tensor) -> Tensor:
    """(N,) signed distances in [−1, 1], positive in front of the surface → p with tanh p = −signed, within what `MOST` allows."""
    return torch.atanh((-signed).clamp(-MOST, MOST))


def colour_latent(colour: Tensor) -> Tensor:
    """(N, 3) RGB in [0, 1] → p with sigmoid(COLOUR_SCALE · tanh p) = colour, within what `MOST` allows."""
    latent = torch.logit(colour, eps=1e-4) / COLOUR_SCALE
    return torch.atanh(latent.clamp(-MOST, MOST))


class LocalReconstruction(nn.Module):
    """Per-voxel projection to few channels, then `layers` sparse 3×3×3 convolutions with ReLU between them.

    The views' mean colour is added to the first three outputs, which by convention are the voxel's colour, and the distance behind the
    surface that the plane sweep expects to the fourth, from which the head's density starts: so a local volume carries the pictures'
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
        return held(self.learned(rows, topology, seen)) + start

    def learned(self, rows: Tensor, topology: Topology, seen: Tensor) -> Tensor:
        """(M · 512 + 1, channels) what the convolutions give, before it is `held` and added to the start."""
        if not torch.is_grad_enabled() and dispatch.can_use_triton(rows, dtypes=dispatch.FLOATS):
            return self._prepared.convolve([[layer] for layer in self.convolutions if isinstance(layer, BlockConv3d)], rows, topology, seen)
        for number, convolution in enumerate(self.convolutions):
            rows = convolution(rows, topology, seen, number > 0)
        return rows
