"""What training does about steps whose loss or gradient is not finite: skip them, say where, and go on with smaller steps for a while."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
from torch import nn

SLOWER = 0.5  # of the rate, after each bad step …
SLOWEST = 2.0**-6  # … down to this …
RECOVER = 200  # … and doubled again after so many good steps in a row
MOST = 20  # bad steps in a row after which training gives up: the weights of the last good one are kept


@dataclass
class Caution:
    """Kept in checkpoints, so that a run that goes on takes the same steps as one that never stopped.

    Attributes:
        slower: of the rate that the schedule asks for.
        in_a_row: bad steps since the last good one.
        good: good steps since the last bad one, up to the next doubling.
        met: bad steps in all.
        last: where the newest of them arose.
    """

    slower: float = 1.0
    in_a_row: int = 0
    good: int = 0
    met: int = 0
    last: str = ""

    @property
    def gives_up(self) -> bool:
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
        self.met += 1
        self.in_a_row += 1
        self.good = 0
        self.slower = max(SLOWEST, self.slower * SLOWER)
        self.last = where

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Caution:
        """What `to_dict` gave.

        Raises:
            ValueError: it was not given by `to_dict`.
        """
        kinds = {field.name: type(getattr(cls(), field.name)) for field in fields(cls)}
        if not isinstance(data, dict) or data.keys() != kinds.keys() or any(type(data[name]) is not kind for name, kind in kinds.items()):
            raise ValueError("its record of bad steps is not one")
        out = cls(**data)
        if not SLOWEST <= out.slower <= 1:
            raise ValueError(f"its steps are {out.slower} of their size")
        return out


def where_not_finite(loss: float, parameters: Iterable[tuple[str, nn.Parameter]]) -> str:
    """The loss, or the first parameters whose gradients are not finite and how many there are: the middle of a sentence."""
    if not math.isfinite(loss):
        return "the loss"
    named = [name for name, p in parameters if p.grad is not None and not bool(torch.isfinite(p.grad).all())]
    if not named:
        return "the norm of the gradient"
    more = f" and of {len(named) - 1} more parameters" if len(named) > 1 else ""
    return f"the gradient of {named[0]}{more}"
