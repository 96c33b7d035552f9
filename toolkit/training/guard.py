"""What a fit does about steps whose loss or gradient is not finite: it goes on from the last good state with smaller steps, a few times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as default

import torch

from fieldfuse.errors import InputError
from fieldfuse.render.field import Field
from fieldfuse.training.finite import NotFiniteError
from fieldfuse.training.step import Rates

MOST = 5  # bad steps that a fit may meet; one more, and it ends with what it has
SLOWER = 0.5  # of the step sizes, after each of them


@dataclass
class Guard:
    """One fit's bad steps.

    Attributes:
        slower: of the step sizes that are asked for.
        met: bad steps so far.
        notes: a sentence on each.
    """

    slower: float = 1.0
    met: int = 0
    notes: list[str] = default(default_factory=list)

    def eased(self, rates: Rates) -> Rates:
        """The step sizes, smaller after every bad step."""
        if self.slower == 1:
            return rates
        by = self.slower
        return replace(rates, density=by * rates.density, feature=by * rates.feature, decoder=by * rates.decoder)

    def goes_on(self, error: NotFiniteError, good: int, resolution: int, seconds: float) -> bool:
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


def refuse_broken(field: Field) -> None:
    """A field to go on from must be finite, and hold something that rays can come to.

    Raises:
        InputError: it is not, or does not.
    """
    if field.voxels == 0:
        raise InputError("the field to go on from holds no voxel, so no ray would change it; fit it anew with --init classical")
    values = (field.density_rows, field.feature_rows, *field.decoder.parameters())
    if not all(bool(torch.isfinite(value).all()) for value in values):
        raise InputError("the field to go on from holds values that are not finite; fit it anew")
