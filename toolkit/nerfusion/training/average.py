"""The running average of the weights along a training run: what is validated and shipped.

A step sees one scene, so its weights carry that scene's noise; their average over the last steps does not (Polyak averaging), and the
learning rate need not fall for it. A share of the weights at the start can be mixed in: networks that begin with known terms lose some of
what these do on scenes unlike the training's, and half way between the two is better than either (Wortsman et al., CVPR 2022, for
fine-tuning in general; docs/model_card.md for what it was worth here).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class Average:
    """A ← d A + (1 − d) w after each step; d rises to `decay` over the first steps, so that the start is forgotten.

    Args:
        model: as it is before the first step.
        decay: 0 keeps the newest weights alone; 0.99 averages over about a hundred steps.
        start: share of the weights before the first step in what is applied.
    """

    def __init__(self, model: nn.Module, decay: float, start: float = 0.0) -> None:
        self.decay, self.share = decay, start
        now = {name: value.detach().clone() for name, value in model.named_parameters()}
        self.start = now if start > 0 else {}
        self.values: dict[str, Tensor] = {name: value.clone() for name, value in now.items()} if decay > 0 else {}

    @torch.no_grad()
    def update(self, model: nn.Module, step: int) -> None:
        """Take in the weights after step number `step`, counted from 0."""
        decay = min(self.decay, (1 + step) / (10 + step))
        now = [(self.values[name], value) for name, value in model.named_parameters() if name in self.values]
        if now:
            torch._foreach_lerp_([mine for mine, _ in now], [value for _, value in now], 1 - decay)

    def load(self, values: Mapping[str, Tensor]) -> None:
        """Go on from a checkpoint's averages; without any, from the weights as they are.

        Raises:
            ValueError: they are not of these networks, or not finite.
        """
        if not self.values or not values:
            return
        for name, mine in self.values.items():
            other = values.get(name)
            if other is None or other.shape != mine.shape or not bool(torch.isfinite(other).all()):
                raise ValueError(f"the average of {name} is missing, of another shape or not finite")
            mine.copy_(other)

    @contextmanager
    def applied(self, model: nn.Module) -> Iterator[None]:
        """The networks with averaged weights and their share of the start, for the time being."""
        kept = {name: value.detach().clone() for name, value in model.named_parameters()} if self.values or self.start else {}
        shown = self.values or kept
        _put(model, {name: value.lerp(self.start[name], self.share) if self.start else value for name, value in shown.items()})
        try:
            yield
        finally:
            _put(model, kept)


@torch.no_grad()
def _put(model: nn.Module, values: Mapping[str, Tensor]) -> None:
    for name, value in model.named_parameters():
        if name in values:
            value.copy_(values[name])
