"""Around Adam: the learning rate, clipping, the running average of the weights, and what happens to steps that are not finite."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn

from fieldfuse.nerfusion.training.settings import TrainSettings

SLOWER = 0.5  # of the rate, after each step that is not finite …
SLOWEST = 2.0**-6  # … down to this …
RECOVER = 200  # … and doubled again after so many good steps in a row
MOST = 20  # bad steps in a row after which training gives up: the weights of the last good one are kept


def learning_rate(settings: TrainSettings, step: int) -> float:
    """Linear warm-up, then half a cosine from the full rate to `final` of it at the last step."""
    wanted = settings.optimiser
    if step < wanted.warmup:
        return wanted.rate * (step + 1) / wanted.warmup
    done = (step - wanted.warmup) / max(1, settings.total_steps - wanted.warmup)
    return wanted.rate * (wanted.final + (1 - wanted.final) * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


def clipped(model: nn.Module, most: float) -> float:
    """Scale the gradients down to the norm `most`; answers the norm that they had. Those that are not finite stay as they are: NaN."""
    try:
        return float(torch.nn.utils.clip_grad_norm_(model.parameters(), most, error_if_nonfinite=True))
    except RuntimeError as error:
        if "non-finite" not in str(error):
            raise
        return math.nan


class Average:
    """A ← d A + (1 − d) w after each step; d rises to `decay` over the first steps, so that the start is forgotten.

    A step sees one scene, so its weights carry that scene's noise; their average over the last steps does not (Polyak averaging), and the
    learning rate need not fall for it. A share of the weights at the start can be mixed in: networks that begin with known terms lose some
    of what these do on scenes unlike the training's, and half way between the two is better than either (Wortsman et al., CVPR 2022, for
    fine-tuning in general; docs/model_card.md for what it was worth here).

    Args:
        model: as it is before the first step.
        decay: 0: the newest weights alone; 0.99 averages over about a hundred steps.
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
        if self.values:
            torch._foreach_lerp_(list(self.values.values()), [dict(model.named_parameters())[name] for name in self.values], 1 - decay)

    def load(self, values: Mapping[str, Tensor]) -> None:
        """Go on from a checkpoint's averages; without any, from the weights as they are.

        Raises:
            ValueError: they are not of these networks, or not finite.
        """
        for name, mine in self.values.items() if values else ():
            other = values.get(name)
            if other is None or other.shape != mine.shape or not bool(torch.isfinite(other).all()):
                raise ValueError(f"the average of {name} is missing, of another shape or not finite")
            mine.copy_(other)

    @contextmanager
    def applied(self, model: nn.Module) -> Iterator[None]:
        """The networks with averaged weights and their share of the start, for the time being."""
        newest = {name: value.detach().clone() for name, value in model.named_parameters()} if self.values or self.start else {}
        shown = self.values or newest
        _put(model, {name: value.lerp(self.start[name], self.share) if self.start else value for name, value in shown.items()})
        try:
            yield
        finally:
            _put(model, newest)


@torch.no_grad()
def _put(model: nn.Module, values: Mapping[str, Tensor]) -> None:
    for name, value in model.named_parameters():
        if name in values:
            value.copy_(values[name])


@dataclass
class NonfinitePolicy:
    """Steps whose loss or gradient is not finite are skipped, and the next ones are smaller for a while.

    In checkpoints, so that a resumed run takes the same steps as one that never stopped.
    """

    slower: float = 1.0  # of the scheduled rate
    in_a_row: int = 0  # bad steps since the last good one
    good: int = 0  # good steps since the last bad one, up to the next doubling
    met: int = 0  # bad steps in all
    last: str = ""  # where the newest of them arose

    @property
    def gives_up(self) -> bool:
        """Whether so many steps were bad that the settings cannot work."""
        return self.in_a_row >= MOST

    def well(self) -> None:
        """A step was good."""
        self.in_a_row = 0
        if self.slower < 1:
            self.good += 1
            if self.good >= RECOVER:
                self.slower, self.good = min(1.0, self.slower / SLOWER), 0

    def bad(self, where: str) -> None:
        """A step was bad, and nothing was moved by it."""
        self.met, self.in_a_row, self.good = self.met + 1, self.in_a_row + 1, 0
        self.slower, self.last = max(SLOWEST, self.slower * SLOWER), where

    @classmethod
    def from_dict(cls, data: Any) -> NonfinitePolicy:
        """From what `asdict` gives.

        Raises:
            ValueError: it is something else.
        """
        kinds = {field.name: type(getattr(cls(), field.name)) for field in fields(cls)}
        if not isinstance(data, dict) or data.keys() != kinds.keys() or any(type(data[name]) is not kind for name, kind in kinds.items()):
            raise ValueError("its record of bad steps is not one")
        if not SLOWEST <= data["slower"] <= 1:
            raise ValueError(f"its steps are {data['slower']} of their size")
        return cls(**data)


def where_not_finite(loss: float, parameters: Iterable[tuple[str, nn.Parameter]]) -> str:
    """The loss, or the first parameters whose gradients are not finite and how many there are: the middle of a sentence."""
    if not math.isfinite(loss):
        return "the loss"
    named = [name for name, p in parameters if p.grad is not None and not bool(torch.isfinite(p.grad).all())]
    if not named:
        return "the norm of the gradient"
    more = f" and of {len(named) - 1} more parameters" if len(named) > 1 else ""
    return f"the gradient of {named[0]}{more}"
