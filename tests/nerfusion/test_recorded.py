"""When work is launched and when it is recorded, with what stands in for a CUDA graph: no device is needed."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor

from fieldfuse.nerfusion import recorded
from fieldfuse.nerfusion.recorded import MOST, Recorded


class Graph:
    """Repeats the work on the tensors that it was recorded with."""

    def __init__(self, work: recorded.Work, inputs: list[Tensor], results: tuple[Tensor, ...]) -> None:
        self.work, self.inputs, self.results = work, inputs, results

    def replay(self) -> None:
        for place, value in zip(self.results, self.work(*self.inputs), strict=True):
            place.copy_(value)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What happens, by name."""
    done = list[str]()

    def record(self: Recorded, work: recorded.Work, given: tuple[Tensor, ...]) -> object:
        done.append("recorded")
        inputs = [value.clone() for value in given]
        results = work(*inputs)
        return Graph(work, inputs, results), inputs, results

    monkeypatch.setattr(Recorded, "_record", record)
    return done


def test_the_second_call_for_a_shape_is_recorded_and_later_ones_repeat_it(monkeypatch: pytest.MonkeyPatch) -> None:
    done, keeper = counted(monkeypatch), Recorded()

    def work(one: Tensor, other: Tensor) -> tuple[Tensor, ...]:
        return one + other, one * 2

    given = [(torch.rand(3), torch.rand(3)) for _ in range(5)]
    found = [keeper(work, "sum", *pair) for pair in given]
    assert done == ["recorded"]
    for (one, other), (total, twice) in zip(given, found, strict=True):  # copies: what was given out earlier stays as it was
        assert torch.equal(total, one + other) and torch.equal(twice, one * 2)
    keeper(work, "sum", torch.rand(4), torch.rand(4))
    keeper(work, "other", torch.rand(3), torch.rand(3))
    assert done == ["recorded"], "other shapes and other work begin anew"
    for size in range(10, 10 + MOST):
        keeper(work, "sum", torch.rand(size), torch.rand(size))
    assert len(keeper._made) == MOST


def test_what_cannot_be_recorded_is_launched_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise torch.OutOfMemoryError("no room")

    monkeypatch.setattr(Recorded, "_record", refuse)
    keeper = Recorded()
    for _ in range(4):
        value = torch.rand(3)
        assert torch.equal(keeper(lambda one: (one + 1,), "more", value)[0], value + 1)


def test_a_copy_starts_without_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    counted(monkeypatch)
    keeper = Recorded()
    for _ in range(2):
        keeper(lambda one: (one,), "same", torch.rand(2))
    assert keeper._made and not copy.deepcopy(keeper)._made and not pickle.loads(pickle.dumps(keeper))._made  # noqa: S301
