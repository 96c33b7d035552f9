"""How kernels are launched and small things sent to CUDA, with what stands in for a compiled kernel: no device is needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from fieldfuse import gpu
from fieldfuse.nerfusion.store import _Slots


class Jitted:
    """Gives a new variant for each launch that comes to it."""

    def __init__(self) -> None:
        self.slow: list[tuple[Any, ...]] = []
        self.quick: list[tuple[Any, ...]] = []

    def __getitem__(self, grid: tuple[int, ...]) -> Any:
        def launch(*given: Any, **named: Any) -> Any:
            variant = len(self.slow)
            self.slow.append((grid, given, named))
            return Variant(self, variant)

        return launch


class Variant(SimpleNamespace):
    def __init__(self, owner: Jitted, number: int) -> None:
        super().__init__(owner=owner, number=number, function="f", packed_metadata="m")

    def run(self, first: int, second: int, third: int, stream: int, function: str, packed: str, *given: Any) -> None:
        assert (function, packed, given[:3]) == ("f", "m", (None, None, None))
        self.owner.quick.append((self.number, (first, second, third), stream, given[3:]))

    def __getitem__(self, grid: tuple[int, ...]) -> Any:
        return lambda *given, stream: self.owner.quick.append((self.number, grid, stream, given))


@pytest.mark.parametrize("version", ["3.6.0", "9.9"])
def test_a_launch_of_a_known_kind_goes_straight_to_what_was_compiled(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    triton = pytest.importorskip("triton")
    monkeypatch.setattr(triton, "__version__", version)
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda device: 7, raising=False)
    jitted = Jitted()
    kernel = gpu.Kernel(jitted, ("rows", "count", "scale", "SIZE", "MORE"), (3, 4), ("rows",))
    rows = torch.zeros(16)
    kernel[(3,)](rows, 5, 0.5, SIZE=8, MORE=True)
    assert len(jitted.slow) == 1 and not jitted.quick
    kernel[(4, 2)](rows, 6, 0.25, SIZE=8, MORE=True)
    kernel[(1,)](rows, 1, 1.0, 8, True)  # constants by place are another kind of call
    kernel[(1,)](rows, 1, 1.0, 8, True)
    assert len(jitted.slow) == 2
    assert jitted.quick == [(0, (4, 2, 1), 7, (rows, 6, 0.25, 8, True)), (1, (1, 1, 1), 7, (rows, 1, 1.0, 8, True))]
    for given in ((rows.double(), 5, 0.5), (rows, 5, 1), (rows[1:], 5, 0.5)):  # other numbers, another type, another start
        kernel[(1,)](*given, SIZE=8, MORE=True)
    kernel[(1,)](rows, 5, 0.5, SIZE=16, MORE=True)
    kernel[(1,)](rows, 5, 0.5, SIZE=8, MORE=False)
    assert len(jitted.slow) == 7 and len(jitted.quick) == 2


def test_a_triton_that_wants_other_arguments_is_launched_its_own_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda device: 7, raising=False)

    def refuse(*_: Any) -> None:
        raise TypeError("function takes exactly 12 arguments (15 given)")

    monkeypatch.setattr(gpu, "_launcher", lambda compiled: refuse)
    jitted = Jitted()
    kernel = gpu.Kernel(jitted, ("rows", "SIZE"), (1,), ())
    for _ in range(3):
        kernel[(1,)](torch.zeros(4), SIZE=8)
    assert len(jitted.slow) == 3 and not jitted.quick


def test_what_is_sent_arrives_whatever_was_sent_before() -> None:
    class Small(gpu._Outbox):
        HALF = 1024

    outbox, random = Small(torch.device("cpu")), np.random.default_rng(0)
    for count in random.integers(1, 128, 200):
        for kind in (np.int32, np.int64, np.float32):
            values = (1000 * random.random((int(count), 1))).astype(kind)
            found = outbox.send(values)
            assert np.array_equal(found.numpy(), values) and found.numpy().dtype == kind
    whole = np.arange(256, dtype=np.int32)
    for _ in range(3):
        assert np.array_equal(outbox.send(whole).numpy(), whole), "as much as fits into a half"


def test_slots_are_found_by_code() -> None:
    random, slots, expected = np.random.default_rng(0), _Slots(), dict[int, int]()
    for _ in range(20):
        codes = random.permutation(np.unique(random.integers(-50, 500, 30)))
        found, missing = slots.find(codes)
        assert found.tolist() == [expected.get(code, -1) for code in codes.tolist()]
        new = len(expected) + np.arange(len(missing), dtype=np.int32)
        slots.add(codes[missing], new)
        expected.update(zip(codes[missing].tolist(), new.tolist(), strict=True))


def test_pieces_and_powers() -> None:
    for count in range(1, 40):
        assert gpu.pieces(count, 8) == -(-count // 8)
        assert gpu.power_of_two(count) >= count > gpu.power_of_two(count) / 2
