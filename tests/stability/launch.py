"""`fieldfuse …` with something going wrong at a chosen moment: `python -m tests.stability.launch JSON run SOURCE --out DIR …`.

JSON: `event` n and `signal` s: send s to this process at its n-th change of a file (open for writing, rename, remove, make a folder).
`ticks`: the clock of the fit advances by so many seconds a look, so that a fit of a given budget makes the same steps on every machine.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import time
from typing import Any

CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir")


def strike_at(count: int, number: int) -> None:
    """Send the signal `number` at the `count`-th change of a file."""
    seen = itertools.count(1)

    def hear(event: str, arguments: tuple[Any, ...]) -> None:
        changes = event in CHANGES
        if event == "open":
            path, _, flags = arguments
            writes = (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            changes = bool(writes) and not str(path).startswith(("/dev/", "/proc/")) and "__pycache__" not in str(path)
        if changes and next(seen) == count:
            os.kill(os.getpid(), number)

    sys.addaudithook(hear)


def steady_clock(tick: float) -> None:
    """`perf_counter` advances by `tick` at each look: what is bounded by seconds is then bounded by steps."""
    looks = itertools.count()
    time.perf_counter = lambda: next(looks) * tick


def main() -> None:
    plan = json.loads(sys.argv[1])
    sys.argv = ["fieldfuse", *sys.argv[2:]]
    if "ticks" in plan:
        steady_clock(plan["ticks"])
    if "event" in plan:
        strike_at(plan["event"], getattr(signal, plan["signal"]))
    from fieldfuse.pipelines.cli import main as command

    command()


if __name__ == "__main__":
    main()
