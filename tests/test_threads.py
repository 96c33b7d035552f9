"""Work that threads share: all of it is done, once, also when helpers come late, when it is nested, and when it fails."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.threads import ahead, share, slices


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 40), st.integers(1, 6))
def test_every_piece_is_worked_on_once_and_results_keep_their_order(pieces: int, threads: int) -> None:
    seen: list[int] = []

    def work(piece: int) -> int:
        seen.append(piece)
        return piece * piece

    assert share(work, range(pieces), threads) == [piece * piece for piece in range(pieces)]
    assert sorted(seen) == list(range(pieces))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_no_more_threads_work_than_were_asked_for_and_the_caller_is_one_of_them(threads: int) -> None:
    at_work, most, names, lock = 0, 0, set(), threading.Lock()

    def work(_: int) -> None:
        nonlocal at_work, most
        with lock:
            at_work += 1
            most = max(most, at_work)
            names.add(threading.get_ident())
        time.sleep(0.005)
        with lock:
            at_work -= 1

    share(work, range(12), threads)
    assert most == threads == len(names) and threading.get_ident() in names


def test_nobody_waits_for_a_helper_that_is_late() -> None:
    """One piece takes long; the others are done meanwhile by whoever is free."""
    done: dict[int, int] = {}

    def work(piece: int) -> None:
        time.sleep(0.3 if piece == 0 else 0.001)
        done[piece] = threading.get_ident()

    share(work, range(20), 2)
    assert sum(who == done[0] for who in done.values()) < 3


def test_work_that_shares_its_own_work_comes_to_an_end() -> None:
    def inner(piece: int) -> int:
        return sum(share(lambda k: k, range(piece + 5), 8))

    assert share(inner, range(100), 8) == [sum(range(piece + 5)) for piece in range(100)]


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_an_error_is_told_and_the_rest_is_left_alone(threads: int) -> None:
    begun: list[int] = []

    def work(piece: int) -> None:
        begun.append(piece)
        time.sleep(0.001)
        if piece == 3:
            raise ValueError("no. 3")

    with pytest.raises(ValueError, match=r"no\. 3"):
        share(work, range(1000), threads)
    assert len(begun) < 50
    assert share(str, range(3), threads) == ["0", "1", "2"], "threads are as good as before"


@given(st.integers(0, 1000), st.integers(1, 50))
def test_slices_are_all_of_it_and_about_equal(length: int, pieces: int) -> None:
    parts = slices(length, pieces)
    assert [index for part in parts for index in range(length)[part]] == list(range(length))
    sizes = [part.stop - part.start for part in parts]
    assert not sizes or (min(sizes) > 0 and max(sizes) - min(sizes) <= 1)


def test_items_are_made_ahead_in_order_and_errors_reach_the_caller() -> None:
    made: list[int] = []

    def items(fail: int) -> Iterator[int | None]:
        for item in range(5):
            if item == fail:
                raise ValueError("spoilt")
            made.append(item)
            yield item if item != 2 else None

    assert list(ahead(items(9))) == [0, 1, None, 3, 4]
    assert list(ahead([])) == []
    with closing(ahead(items(9))) as few:
        made.clear()
        assert next(few) == 0
    assert made in ([0], [0, 1])  # no more than one ahead
    with pytest.raises(ValueError, match="spoilt"):
        list(ahead(items(3)))
