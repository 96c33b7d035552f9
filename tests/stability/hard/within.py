"""What a hard case measured, held to its bounds: every number is recorded, and those that miss their bounds fail the test together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Measure:
    """One number of a case: how far something is from its reference, and how far it may be. NaN is never within a bound."""

    quantity: str
    error: float
    bound: float

    @property
    def good(self) -> bool:
        return self.error <= self.bound


@dataclass
class Within:
    """The fixture `within` of a hard case; `title` is "group: case" of the page."""

    title: str = ""
    measures: list[Measure] = field(default_factory=list)
    failure: str = ""  # what the case raised

    def __call__(self, quantity: str, error: float, bound: float) -> None:
        """Record that `error` of `quantity` must be at most `bound`."""
        self.measures.append(Measure(quantity, error, bound))

    def each(self, errors: Mapping[str, float], bound: float = 0.0, others: Mapping[str, float] | None = None, name: str = "{}") -> None:
        """Record all errors, each with `bound` or its own among `others`; `name` has {} where the quantity stands."""
        for quantity, error in errors.items():
            self(name.format(quantity), error, (others or {}).get(quantity, bound))

    @property
    def missed(self) -> list[str]:
        return [measure.quantity for measure in self.measures if not measure.good]

    @property
    def good(self) -> bool:
        return bool(self.measures) and not self.missed and not self.failure

    def check(self) -> None:
        """Fail with all that missed its bound, or if nothing was measured."""
        assert self.measures, "nothing was measured"
        assert not self.missed, "; ".join(f"{m.quantity}: {m.error:.3g} > {m.bound:.3g}" for m in self.measures if not m.good)
