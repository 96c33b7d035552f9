"""Peak memory of a stage: of this process and of every child that it starts, sampled by a small thread."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Any

import psutil

INTERVAL = 0.2  # seconds between two samples of this process
CHILDREN_EVERY = 3  # samples between two looks at the children, which cost far more


class PeakMemory:
    """Context manager; afterwards `megabytes` is the largest resident memory seen, children included, and `own` the largest without the
    pages of files, those of libraries first of all.

    Memory that is shared between parent and children counts once for each of them in `megabytes`.
    """

    def __init__(self) -> None:
        self.megabytes = self.own = 0.0
        self._stop = threading.Event()
        self._process = psutil.Process()
        self._thread = threading.Thread(target=self._watch, name="peak-memory", daemon=True)

    def __enter__(self) -> PeakMemory:
        self._sample()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()
        self._sample()

    def _watch(self) -> None:
        count = 0
        while not self._stop.wait(INTERVAL):
            count += 1
            self._sample(count % CHILDREN_EVERY == 0)

    def _sample(self, children: bool = True) -> None:
        seen = [self._process.memory_info()]
        for child in self._process.children(recursive=True) if children else ():
            try:
                seen.append(child.memory_info())
            except psutil.Error:  # it ended in between
                continue
        self.megabytes = max(self.megabytes, sum(one.rss for one in seen) / 2**20)
        self.own = max(self.own, sum(own_bytes(one) for one in seen) / 2**20)


def own_bytes(found: Any) -> int:
    """Resident bytes of a process, by psutil, that are pages of no file (and of nothing shared), where the system tells them apart."""
    return int(found.rss - getattr(found, "shared", 0))
