"""The GRU that fuses a local volume into the global one (NeRFusion, section 3.2, eq. 3).

    z = σ(M_z([H, V]) + log(w / n))      r = σ(M_r([H, V]))
    T = tanh(V_raw + M_t([r ∘ H, V]))
    H' = (1 − z) ∘ H + z ∘ T

H is the global volume, V = tanh(V_raw) the local one, w its weight and n the sum of the weights so far. What differs from the paper are
the two known terms: with M_z = M_t = 0 (the start) this is w V + n H over w + n, the weighted running mean of the local volumes, the
fusion that needs no learning, and z = 1 where nothing was known. A local volume weighs little where its key frame does not see; without
that, each more key frame wrote its ignorance over what others knew. n is capped, so that late frames still count. H stays within (−1, 1)
for ever: it is always a mixture of values of tanh.
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fieldfuse.backends.constants import CHANGE, INSIDE
from fieldfuse.backends.dispatch import is_cpu
from fieldfuse.nerfusion.block_conv import BlockConv3d, Prepared, block_conv3d, computed_in
from fieldfuse.nerfusion.extras.known_terms import bounded
from fieldfuse.nerfusion.lattice import LatentVolume, LocalVolume
from fieldfuse.volume.topology import Topology

LEAST = 1e-3  # of a local volume's weight
MOST = 16  # cap on n


class _Gate(nn.Module):
    """Three sparse convolutions [H, V] → channels; the last starts near zero."""

    def __init__(self, channels: int, hidden: int, layers: int) -> None:
        super().__init__()
        widths = [2 * channels] + [hidden] * (layers - 1) + [channels]
        self.convolutions = nn.ModuleList(BlockConv3d(a, b) for a, b in pairwise(widths))
        last = self.convolutions[-1]
        assert isinstance(last, BlockConv3d)
        with torch.no_grad():
            last.weight.mul_(0.1)

    @property
    def layers(self) -> list[BlockConv3d]:
        return [layer for layer in self.convolutions if isinstance(layer, BlockConv3d)]

    def forward(self, rows: Tensor, topology: Topology, inside: Tensor, begun: Tensor | None = None) -> Tensor:
        """`begun`: what the first convolution gives for `rows`, if that is known already."""
        rows = self.layers[0](rows, topology, inside) if begun is None else begun
        for convolution in self.convolutions[1:]:
            rows = convolution(rows, topology, inside, True)
        return rows


class FusionGRU(nn.Module):
    """One step of the recurrence on the voxels of a local volume."""

    def __init__(self, channels: int, hidden: int, layers: int = 3) -> None:
        super().__init__()
        self.update, self.reset, self.candidate = (_Gate(channels, hidden, layers) for _ in range(3))
        self._gates_prepared, self._candidate_prepared = Prepared(), Prepared()

    def forward(self, state: LatentVolume, local: LocalVolume) -> Tensor:
        """(M · 512 + 1, C) H' on the local volume's blocks, zero where nothing is known there.

        Args:
            state: H and n there, zero where the local volume is unknown.
        """
        topology, inside, h, v = local.topology, local.known, state.rows, local.rows
        known = torch.log(state.count.clamp_max(MOST)) - torch.log(local.weight.clamp_min(LEAST))
        known = F.pad(known, (0, 1), value=-torch.inf)[:, None]  # −∞ where nothing is known: z = 1
        update, reset = self._gates(_beside(h, v), topology, inside)
        z, r = torch.sigmoid(update - known), torch.sigmoid(reset)
        candidate = torch.tanh(local.raw + bounded(self.candidate(_beside(r * h, v), topology, inside)))
        return torch.lerp(h, candidate, z)

    def compiled(self, part: LatentVolume, local: LocalVolume) -> tuple[Tensor, Tensor]:
        """The running mean on all rows of `part` (the global volume on the local one's blocks) and `forward` on blocks near surfaces,
        without gradients, by kernels (float32; convolutions in the numbers of autocast).

        Returns:
            (M · 512 + 1, C), zero outside the local volume, and (M · 512,) weights so far, likewise.
        """
        near_surface = local.near_surface
        if is_cpu(part.rows.device):
            from fieldfuse.backends.numba import gru as on_cpu

            one = on_cpu.Step(local.place[:-1], part, local, LEAST, MOST)
            rows = one.average()
            if near_surface.blocks:
                inside, both = local.known[local.place[:-1]], one.beside()
                update, reset = self._gates(both, near_surface, inside)
                one.forget(reset, both)
                one.update(update, self.candidate(both, near_surface, inside), INSIDE, CHANGE, rows)
            return rows, part.count * local.known + local.weight
        from fieldfuse.backends.triton import volumes as on_cuda

        # Both gates' convolutions go side by side.
        step = on_cuda.Step(part, local, LEAST, MOST)
        rows, count = step.average()
        if near_surface.blocks:
            both, inside = step.beside(computed_in(part.rows))
            gates = self._gates_prepared.convolve(list(zip(self.update.layers, self.reset.layers, strict=True)), both, near_surface, inside)
            step.forget(gates, both)
            candidate = self._candidate_prepared.convolve([[layer] for layer in self.candidate.layers], both, near_surface, inside)
            step.update(gates, candidate, INSIDE, CHANGE, rows)
        return rows, count

    def _gates(self, both: Tensor, topology: Topology, inside: Tensor) -> list[Tensor]:
        """M_z and M_r of [H, V]; their first convolutions are one, which costs as much as either alone."""
        one, other = self.update.layers[0], self.reset.layers[0]
        assert one.bias is not None and other.bias is not None
        weight, bias = torch.cat([one.weight, other.weight]), torch.cat([one.bias, other.bias])
        rows = block_conv3d(both, topology, weight, bias, inside, one.chunk)
        return [gate(both, topology, inside, part) for gate, part in zip((self.update, self.reset), rows.chunk(2, 1), strict=True)]


def _beside(one: Tensor, other: Tensor) -> Tensor:
    """Both rows' channels; without gradients at once in the numbers that convolutions compute in, which is half as much to write."""
    if not torch.is_grad_enabled():
        one, other = one.to(computed_in(one)), other.to(computed_in(other))
    return torch.cat([one, other], 1)


def mean_gate(count: Tensor, weight: Tensor) -> Tensor:
    """(M · 512,) n and w → (M · 512 + 1, 1) the z of the weighted running mean; the last row's is one."""
    weight = weight.clamp_min(LEAST)
    z = weight / (weight + count.clamp_max(MOST))
    return torch.cat([z, z.new_ones(1)])[:, None]


class RunningMean(nn.Module):
    """The fusion without learning, for the ablation: the weighted mean of the local volumes, n capped as in the GRU."""

    def forward(self, state: LatentVolume, local: LocalVolume) -> Tensor:
        """See `FusionGRU.forward`."""
        return torch.lerp(state.rows, local.rows, mean_gate(state.count, local.weight))
