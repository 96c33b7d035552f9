"""Microbenchmarks: what one unit of work takes, beside a reference loop in the same run, so that the machine cancels out of the ratio."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import torch


@dataclass(frozen=True)
class Timed:
    """Best of several repetitions: seconds of wall clock and of processor (all threads) for `units`."""

    wall: float
    processor: float


@dataclass(frozen=True)
class Case:
    """One row of the result.

    Attributes:
        name: what is done; size: of what.
        unit, units: what is counted, and how many of them one repetition holds.
        ours, reference: times of a repetition.
        against: what the reference is.
        clock: which time the ratio is of: processor (the work) or wall (whether threads help).
        counts: operations, which are the same on every machine.
    """

    name: str
    size: str
    unit: str
    units: int
    ours: Timed
    reference: Timed
    against: str
    clock: str = "processor"
    counts: dict[str, float] = field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """How many times faster than the reference."""
        return float(getattr(self.reference, self.clock) / max(getattr(self.ours, self.clock), 1e-9))

    def to_dict(self) -> dict[str, Any]:
        per_unit = {
            f"{clock}_microseconds_a_{self.unit.replace(' ', '_')}": round(1e6 * getattr(self.ours, clock) / self.units, 4)
            for clock in ("wall", "processor")
        }
        return {**asdict(self), **per_unit, "ratio": round(self.ratio, 3)}


def once(work: Callable[[], Any]) -> Timed:
    """Time one call."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return Timed(time.perf_counter() - wall, time.process_time() - processor)


def compare(ours: Callable[[], Any], reference: Callable[[], Any], repetitions: int = 5) -> tuple[Timed, Timed]:
    """Best times of two pieces of work done in turns, after each has run once unmeasured; a busy machine so slows both alike."""
    ours()
    reference()
    times: tuple[list[Timed], list[Timed]] = ([], [])
    for turn in range(repetitions):
        for which in (0, 1) if turn % 2 == 0 else (1, 0):
            times[which].append(once((ours, reference)[which]))
    first, second = (Timed(min(t.wall for t in part), min(t.processor for t in part)) for part in times)
    return first, second


@contextmanager
def pinned(threads: int) -> Iterator[None]:
    """Torch with so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def exponent(sizes: list[float], costs: list[float]) -> float:
    """b of cost = a · size^b, least squares in the logarithms."""
    import numpy as np

    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
