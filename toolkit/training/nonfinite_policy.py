"""Steps whose loss or gradient is not finite: found before anything is moved, so that the field is always that of the last good step, and
what a fit does about them: it goes on from there with smaller steps, a few times."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from fieldfuse.errors import InputError
from fieldfuse.render.field import Field
from fieldfuse.training.losses import Rates

Tensor = torch.Tensor
Array = np.ndarray[Any, Any]
MOST = 5  # bad steps of a fit; one more, and it ends with what it has
SLOWER = 0.5  # of the step sizes, after each of them


class NotFiniteError(ArithmeticError):
    """The loss or a gradient of a step is not finite; nothing was moved. The message is where, without a full stop."""


def require_finite(named: Iterable[tuple[str, Tensor]]) -> None:
    """Check tensors, each with its name, in one pass over them all.

    Raises:
        NotFiniteError: naming the first tensor that is not finite.
    """
    named = list(named)
    total = torch.stack([values.detach().sum(dtype=torch.float32) for _, values in named]).sum()
    if bool(torch.isfinite(total)):
        return
    for name, values in named:
        if found := first_broken(0.0, [(name, values.detach().cpu().numpy())]):
            raise NotFiniteError(found)


def first_broken(error: float, named: Iterable[tuple[str, Array]]) -> str | None:
    """What is not finite of a part of a batch: its summed colour error, or the first of the arrays; None: all is well."""
    if not math.isfinite(error):
        return "the colour error is not finite"
    for name, values in named:
        if bad := int((~np.isfinite(values)).sum()):
            return f"{name} is not finite at {bad:,} of {values.size:,} places"
    return None


@dataclass
class NonfinitePolicy:
    """One fit's bad steps.

    Attributes:
        slower: factor of the step sizes.
        met: bad steps so far.
        notes: a sentence on each.
    """

    slower: float = 1.0
    met: int = 0
    notes: list[str] = field(default_factory=list)

    def scaled_rates(self, rates: Rates) -> Rates:
        """The step sizes, smaller after every bad step."""
        if self.slower == 1:
            return rates
        by = self.slower
        return replace(rates, density=by * rates.density, feature=by * rates.feature, decoder=by * rates.decoder)

    def handle(self, error: NotFiniteError, good: int, resolution: int, seconds: float) -> bool:
        """Note where a bad step arose, and make the next ones smaller; False: it was one too many.

        Args:
            good: steps before it.

        Raises:
            InputError: it was one too many, and there was no good step at all.
        """
        self.met += 1
        where = f"step {good + 1:,} of the fit, at {resolution}³ after {seconds:.1f} s: {error}"
        if self.met > MOST:
            if good == 0:
                raise InputError(f"{where}, {self.met} times before any good step; lower fit.rate_density and fit.rate_feature")
            self.notes.append(f"{where}; it was the {self.met}th such step, and the fit ended with the field of the step before")
            return False
        self.slower *= SLOWER
        self.notes.append(f"{where}; the fit went on from the step before with {self.slower:g} of the step sizes")
        return True


def refuse_broken(start: Field) -> None:
    """A field to go on from must be finite, and hold something that rays can come to.

    Raises:
        InputError: it is not, or does not.
    """
    if start.voxels == 0:
        raise InputError("the field to go on from holds no voxel, so no ray would change it; fit it anew with --init classical")
    values = (start.density_rows, start.feature_rows, *start.decoder.parameters())
    if not all(bool(torch.isfinite(value).all()) for value in values):
        raise InputError("the field to go on from holds values that are not finite; fit it anew")
