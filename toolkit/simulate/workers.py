"""Drawing frames side by side: one thread a frame, results in order, never more in flight than workers need."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def drawing(workers: int | None = None) -> Iterator[Callable[[Callable[[Item], Result], Iterable[Item]], Iterator[Result]]]:
    """A `map` whose calls run on worker threads, each with one torch thread: threads that wait for each other are far slower.

    Args:
        workers: None: one a core, at most 4.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    count = workers or min(os.cpu_count() or 1, 4)
    pool = ThreadPoolExecutor(count)

    def in_order(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    try:
        yield in_order
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(before)
