"""Seconds paid, by effect."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

POINTS = "points"  # finding and matching what pictures share, which all effects are told from


class Paid:
    """Adds up the wall-clock seconds spent on each effect. What is tried for several at once is split evenly between them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def by(self, *effects: str) -> Iterator[None]:
        """Counts what is done inside; calls must not be nested."""
        began = time.monotonic()
        try:
            yield
        finally:
            share = (time.monotonic() - began) / len(effects)
            for effect in effects:
                self.seconds[effect] = self.seconds.get(effect, 0.0) + share

    def of(self, effect: str) -> float:
        """Seconds, to the millisecond."""
        return round(self.seconds.get(effect, 0.0), 3)
