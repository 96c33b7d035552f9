"""Looking at what a step computed before anything is moved by it, so that the field is always that of the last good step."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

Tensor = torch.Tensor
Array = np.ndarray[Any, Any]


class NotFiniteError(ArithmeticError):
    """The loss or a gradient of a step is not finite; nothing was moved. The message says where, without a full stop."""


def check(named: Iterable[tuple[str, Tensor]]) -> None:
    """Look at tensors, each with its name, in one pass over them all.

    Raises:
        NotFiniteError: naming the first tensor that is not finite.
    """
    named = list(named)
    total = torch.stack([values.detach().sum(dtype=torch.float32) for _, values in named]).sum()
    if bool(torch.isfinite(total)):
        return
    for name, values in named:
        bad = int((~torch.isfinite(values)).sum())
        if bad:
            raise NotFiniteError(f"{name} is not finite at {bad:,} of {values.numel():,} places")


def broken(error: float, named: Iterable[tuple[str, Array]]) -> str | None:
    """What is not finite of a part of a batch: its summed colour error, or the first of the arrays; None: all is well."""
    if not math.isfinite(error):
        return "the colour error is not finite"
    for name, values in named:
        if bad := int((~np.isfinite(values)).sum()):
            return f"{name} is not finite at {bad:,} of {values.size:,} places"
    return None


def refuse(found: Iterable[str | None]) -> None:
    """Give up a step when one of the parts of its batch is `broken`.

    Raises:
        NotFiniteError: saying which.
    """
    for text in found:
        if text is not None:
            raise NotFiniteError(text)
