"""Adam on the rows that a step touched. `torch.optim.SparseAdam` costs more than everything else in a step; this does not."""

from __future__ import annotations

import torch

Tensor = torch.Tensor


class LazyAdam:
    """State for one (R,) or (R, C) array of rows. Rows without a gradient keep their moments and are not read.

    There is no first moment: of 0 to 0.9 none fits better than another (`docs/measured/performance.md`), and memory is what an update
    costs. The bias correction counts a row's own steps, so a row touched for the first time late takes a first step of full size. A row's
    moments and its count lie side by side.
    """

    def __init__(self, values: Tensor, decay: float = 0.99, epsilon: float = 1e-10) -> None:
        self.values = values
        self.channels = 1 if values.ndim == 1 else values.shape[1]
        self.state = torch.zeros(len(values), self.channels + 1, device=values.device)  # second moment, steps
        self.decay, self.epsilon = decay, epsilon

    def step(self, rows: Tensor, gradient: Tensor, rate: float) -> None:
        """Move `rows` (N,), each listed once, against their `gradient` (N,) or (N, C)."""
        state = self.state.index_select(0, rows)
        gradient = gradient.reshape(-1, self.channels)
        second, count = state[:, :-1], state[:, -1:]
        second.mul_(self.decay).addcmul_(gradient, gradient, value=1 - self.decay)
        count += 1
        self.state.index_copy_(0, rows, state)
        # rate · g / (sqrt(v / (1 - b2^n)) + ε)
        update = (gradient / second.sqrt().add_(self.epsilon)).mul_(torch.sqrt(1 - self.decay**count) * rate)
        old = self.values.index_select(0, rows)
        self.values.index_copy_(0, rows, old - update.view_as(old))
