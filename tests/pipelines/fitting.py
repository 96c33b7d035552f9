"""`fieldfuse …` as a process of its own that tells when its fit is under way: `python -m tests.pipelines.fitting FILE run …`.

FILE is made when the fit has looked at its clock `LOOKS` times; the clock is a steady one (`steady`).
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from unittest import mock

from fieldfuse.training.fit import Clock
from tests.pipelines.short import steady

LOOKS = 20


def main() -> None:
    told = Path(sys.argv[1])
    sys.argv = ["fieldfuse", *sys.argv[2:]]
    looks, plain = itertools.count(1), Clock.seconds

    def seconds(self: Clock) -> float:
        if next(looks) == LOOKS:
            told.touch()
        return plain(self)

    with steady(), mock.patch.object(Clock, "seconds", seconds):
        from fieldfuse.pipelines.cli import main as command

        command()


if __name__ == "__main__":
    main()
