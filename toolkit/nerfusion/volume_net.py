"""J, the local reconstruction network of NeRFusion (section 3.1, eq. 2): sparse convolutions from evidence to a local volume."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from fieldfuse.backends import dispatch
from fieldfuse.backends.constants import INSIDE
from fieldfuse.nerfusion.block_conv import BlockConv3d, Prepared
from fieldfuse.nerfusion.extras.bounded_outputs import bounded
from fieldfuse.volume.topology import Topology


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
        return bounded(self.learned(rows, topology, seen)) + start

    def learned(self, rows: Tensor, topology: Topology, seen: Tensor) -> Tensor:
        """(M · 512 + 1, channels) what the convolutions give, before it is `held` and added to the start."""
        if not torch.is_grad_enabled() and dispatch.can_use_triton(rows, dtypes=dispatch.FLOATS):
            return self._prepared.convolve([[layer] for layer in self.convolutions if isinstance(layer, BlockConv3d)], rows, topology, seen)
        for number, convolution in enumerate(self.convolutions):
            rows = convolution(rows, topology, seen, number > 0)
        return rows
