"""Adam on the rows that a step touched. `torch.optim.SparseAdam` costs more than everything else in a step; this does not."""

from __future__ import annotations

import torch

Tensor = torch.Tensor


class LazyAdam:
    """State for one (R,) or (R, C) array of rows. Rows without a gradient keep their moments and are not read.

    The bias correction counts a row's own steps, so a row touched for the first time late takes a first step of full size.
    """

    def __init__(self, values: Tensor, betas: tuple[float, float] = (0.9, 0.99), epsilon: float = 1e-10) -> None:
        self.values = values
        self.gradient = torch.zeros_like(values)
        self.first, self.second = torch.zeros_like(values), torch.zeros_like(values)
        self.steps = torch.zeros(len(values), device=values.device)
        self.betas, self.epsilon = betas, epsilon

    def step(self, rows: Tensor, rate: float) -> None:
        """Apply and clear the gradient of `rows` (N,), each listed once."""
        b1, b2 = self.betas
        gradient = self.gradient[rows]
        first = self.first[rows].mul_(b1).add_(gradient, alpha=1 - b1)
        second = self.second[rows].mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
        count = self.steps[rows].add_(1)
        self.first[rows], self.second[rows], self.steps[rows] = first, second, count
        scale1, scale2 = 1 - b1**count, 1 - b2**count
        if gradient.ndim == 2:
            scale1, scale2 = scale1[:, None], scale2[:, None]
        update = first.div_(scale1).div_(second.div_(scale2).sqrt_().add_(self.epsilon))
        self.values.index_add_(0, rows, update, alpha=-rate)
        self.gradient[rows] = 0
