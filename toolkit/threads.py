"""Work shared between threads by those who come for it.

A thread that was just made, or woken, may start milliseconds late, or on a core where another one is at work (torch's own threads spin for
a while after each operation); fixed shares would wait for it. So the calling thread works too, and each takes the next piece when it is
done with one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count, pairwise
from typing import TypeVar, cast

T = TypeVar("T")
R = TypeVar("R")
MAX_HELPERS = 64  # threads beside the calling one
_helpers = ThreadPoolExecutor(MAX_HELPERS, "helper")  # threads are made when they are first wanted


def share(work: Callable[[T], R], pieces: Sequence[T], threads: int) -> list[R]:
    """`[work(piece) for piece in pieces]` on so many threads, the calling one included.

    Only what lets go of the interpreter (compiled code, NumPy, OpenCV) gains by it. `work` may call it again.

    Raises:
        whatever `work` raises; pieces that nobody has begun are left alone then.
    """
    if threads <= 1 or len(pieces) <= 1:
        return [work(piece) for piece in pieces]
    results: dict[int, R] = {}
    turns = count()
    failed = False

    def help_out() -> None:
        nonlocal failed
        try:
            while (turn := next(turns)) < len(pieces) and not failed:
                results[turn] = work(pieces[turn])
        except BaseException:
            failed = True
            raise

    helpers = [_helpers.submit(help_out) for _ in range(min(threads, len(pieces)) - 1)]
    try:
        help_out()
    finally:
        begun = [helper for helper in helpers if not helper.cancel()]
        errors = [error for helper in begun if (error := helper.exception()) is not None]
    if errors:
        raise errors[0]
    return [results[turn] for turn in range(len(pieces))]


def in_order(work: Callable[[T], R], pieces: Iterable[T], threads: int) -> Generator[R, None, None]:
    """`work` of each piece on so many threads, in their order; no more are begun than the threads need. What is left ends with the
    iterator: close it."""
    with ThreadPoolExecutor(threads) as pool:
        begun: deque[Future[R]] = deque()
        try:
            for piece in pieces:
                begun.append(pool.submit(work, piece))
                if len(begun) > threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def ahead(items: Iterable[T]) -> Generator[T, None, None]:
    """The items, each made on another thread while the one before it is used. That thread ends with the iterator: close it."""
    made, end = iter(items), object()
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, made, end)
        while (item := coming.result()) is not end:
            coming = pool.submit(next, made, end)
            yield cast(T, item)


def slices(length: int, pieces: int) -> list[slice]:
    """`range(length)` in so many parts, as equal as can be; empty ones are left out."""
    cuts = [length * i // pieces for i in range(pieces + 1)]
    return [slice(low, high) for low, high in pairwise(cuts) if high > low]
