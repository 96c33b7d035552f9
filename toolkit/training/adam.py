"""Adam on the rows that a step touched. `torch.optim.SparseAdam` costs more than everything else in a step; this does not."""

from __future__ import annotations

import torch

Tensor = torch.Tensor


class LazyAdam:
    """State for one (R,) or (R, C) array of rows. Rows without a gradient keep their moments and are not read.

    The bias correction counts a row's own steps, so a row touched for the first time late takes a first step of full size.
    Both moments and the count of a row lie side by side: memory latency is what an update costs.
    """

    def __init__(self, values: Tensor, betas: tuple[float, float] = (0.9, 0.99), epsilon: float = 1e-10) -> None:
        self.values = values
        self.channels = 1 if values.ndim == 1 else values.shape[1]
        self.state = torch.zeros(len(values), 2 * self.channels + 1, device=values.device)  # first moment, second moment, steps
        self.betas, self.epsilon = betas, epsilon

    def step(self, rows: Tensor, gradient: Tensor, rate: float) -> None:
        """Move `rows` (N,), each listed once, against their `gradient` (N,) or (N, C)."""
        b1, b2 = self.betas
        c = self.channels
        state = self.state.index_select(0, rows)
        gradient = gradient.reshape(-1, c)
        first, second, count = state[:, :c], state[:, c : 2 * c], state[:, 2 * c :]
        first.mul_(b1).add_(gradient, alpha=1 - b1)
        second.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
        count += 1
        self.state.index_copy_(0, rows, state)
        # rate · (m / (1 - b1^n)) / (sqrt(v / (1 - b2^n)) + ε)
        scale = torch.sqrt(1 - b2**count) / (1 - b1**count) * rate
        update = (first / second.sqrt().add_(self.epsilon)).mul_(scale)
        old = self.values.index_select(0, rows)
        self.values.index_copy_(0, rows, old - update.view_as(old))
