"""The CPU's fast engine for the paper's decoder: the step of `step.Optimiser._per_sample` through compiled kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from fieldfuse.backends.numba import train_per_sample as kernels
from fieldfuse.backends.numba.decode_per_sample import Net, make_tape
from fieldfuse.backends.numba.march_per_sample import NEGLIGIBLE
from fieldfuse.backends.numba.render_per_sample import render_pass
from fieldfuse.backends.numba.train_common import Losses
from fieldfuse.nerfusion.decoder import PerSample
from fieldfuse.nerfusion.encoding import DIRECTION
from fieldfuse.render.composite import STOP
from fieldfuse.render.field import Field
from fieldfuse.render.numba_per_sample import net_arrays, turn, write_back
from fieldfuse.training.numba_engine import NumbaOptimiser

Array = np.ndarray[Any, Any]


class NumbaPerSampleOptimiser(NumbaOptimiser):
    """`NumbaOptimiser` with another decoder: rows, their lazy Adam, marks and threads are the same.

    `Rates.colour_threshold` is not used, as in the reference: this decoder gives a density too, and every sample needs it. Only what
    weighs less than NEGLIGIBLE is left out.
    """

    def _take_decoder(self, field: Field) -> None:
        assert isinstance(field.decoder, PerSample)
        self.net = net_arrays(field.decoder)
        self.scratch = [kernels.make_scratch(self.net) for _ in range(self.threads)]

    def _weights(self) -> tuple[Array, ...]:
        return _moved(self.net)

    def _weight_gradients(self, thread: int) -> tuple[Array, ...]:
        return _moved(self.scratch[thread].total)

    def _of_direction(self) -> Array:
        return self.net.w3[len(self.net.b3) :][: DIRECTION]

    def _turn_decoder(self) -> None:
        turn(self.net)

    def _gradients(
        self, thread: int, part: slice, picks: Array, jitter: Array, shares: Array, losses: Losses, met: Array
    ) -> tuple[int, float, int]:
        rows = (self.touched[thread], self.density_sums[thread], self.feature_sums[thread])
        losses = losses._replace(threshold=np.float32(NEGLIGIBLE))
        arguments = (self.pixels, picks[part], jitter[part], shares[part], losses, self.marks[thread], self.index, self.bases, thread, rows)
        given = (self.space, self.volume, self.net, self.background)
        out: tuple[int, float, int] = kernels.gradient_pass(*given, *arguments, self.scratch[thread], met[part])
        return out

    def sync(self) -> Field:
        """The field with the decoder's weights written back."""
        assert isinstance(self.field.decoder, PerSample)
        write_back(self.net, self.field.decoder)
        return self.field

    def colours(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """(B, 3) colours that the field has now."""
        out = np.empty((len(origins), 5), np.float32)
        limits = (np.float32(STOP), np.float32(NEGLIGIBLE))
        given = (self.space, self.volume, self.net, make_tape(self.net), self.background)
        render_pass(*given, origins.contiguous().numpy(), directions.contiguous().numpy(), *limits, out)
        return torch.from_numpy(out[:, :3])


def _moved(net: Net) -> tuple[Array, ...]:
    return net.w1, net.b1, net.w2, net.b2, net.density, net.density_bias, net.w3, net.b3, net.w4, net.b4
