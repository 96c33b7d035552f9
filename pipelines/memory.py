"""Peak memory of a stage: of this process and of every child that it starts, sampled by a small thread."""

from __future__ import annotations

import threading
from types import TracebackType

import psutil

INTERVAL = 0.2  # seconds between two samples of this process
CHILDREN_EVERY = 3  # samples between two looks at the children, which cost far more


class PeakMemory:
    """Context manager; afterwards `megabytes` is the largest resident memory seen, children included.

    Memory that is shared between parent and children counts once for each of them.
    """

    def __init__(self) -> None:
        self.megabytes = 0.0
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
        resident = self._process.memory_info().rss
        for child in self._process.children(recursive=True) if children else ():
            try:
                resident += child.memory_info().rss
            except psutil.Error:  # it ended in between
                continue
        self.megabytes = max(self.megabytes, resident / 2**20)
