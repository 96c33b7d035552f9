"""Adam on the rows that a step touched, and on whole weights. `torch.optim.SparseAdam` costs more than everything else in a step; this
does not."""

from __future__ import annotations

from collections.abc import Iterable

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


class Adam:
    """`torch.optim.Adam` on whole weights, the same to the bit on the CPU. Torch's own imports its compiler: 1.6 s of a fit."""

    def __init__(self, values: Iterable[Tensor], betas: tuple[float, float], epsilon: float) -> None:
        self.values, self.betas, self.epsilon = list(values), betas, epsilon
        self.moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in self.values]
        self.steps = [0] * len(self.values)

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move the weights against their gradients; those without one stay."""
        for index, (value, (first, second)) in enumerate(zip(self.values, self.moments, strict=True)):
            if value.grad is None:
                continue
            self.steps[index] += 1
            unbiased = [1 - beta ** self.steps[index] for beta in self.betas]
            first.lerp_(value.grad, 1 - self.betas[0])
            second.mul_(self.betas[1]).addcmul_(value.grad, value.grad, value=1 - self.betas[1])
            value.addcdiv_(first, (second.sqrt() / unbiased[1] ** 0.5).add_(self.epsilon), value=-rate / unbiased[0])

    def forget(self) -> None:
        """Drop the gradients."""
        for value in self.values:
            value.grad = None
