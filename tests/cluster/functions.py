"""What tests have workers do; workers import it by name."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from fieldfuse.errors import InputError
from fieldfuse.progress import Progress


def invert(number: float, link: Progress) -> float:
    link.update(1, 1, "inverting")
    if number < 0:
        raise InputError(f"{number} is below zero; give another")
    return 1 / number


def die_at_first(argument: tuple[str, int], link: Progress) -> int:
    """Killed as often as wanted, by a count in a file; answers the number of the attempt that was not."""
    path, times = Path(argument[0]), argument[1]
    count = len(path.read_text()) if path.exists() else 0
    path.write_text("x" * (count + 1))
    if count < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return count + 1


def wait_to_stop(path: str, link: Progress) -> str:
    """Until it is to stop; the file says that it has begun."""
    Path(path).touch()
    end = time.monotonic() + 60
    while not link.stopping() and time.monotonic() < end:
        time.sleep(0.05)
    return "stopped" if link.stopping() else "waited in vain"


def where(_: Any, link: Progress) -> int:
    return os.getpid()
