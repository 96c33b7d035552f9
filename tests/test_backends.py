"""Which backend is chosen for what, how kernels are declared, and how numbers get to a device: no GPU is needed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fieldfuse.backends import dispatch
from fieldfuse.nerfusion.store import BlockSlots

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize("modern", [True, False])
def test_the_engine_of_a_device(modern: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "triton_runs_on", lambda device: device.type == "cuda" and modern)
    fast = "triton" if modern else "torch"
    for decoder in ("deferred", "per_sample"):
        assert [dispatch.choose_engine(name, decoder, CPU) for name in ("auto", "numba", "torch")] == ["numba", "numba", "torch"]
        on_cuda = [dispatch.choose_engine(name, decoder, CUDA) for name in ("auto", "triton", "numba", "torch")]
        assert on_cuda == ([fast, fast, "torch", "torch"] if decoder == "deferred" else ["torch"] * 4)


def test_triton_takes_nothing_that_lies_on_the_cpu() -> None:
    assert not dispatch.can_use_triton(torch.zeros(3)) and not dispatch.can_use_triton(torch.zeros(3), dtypes=None)
    assert dispatch.is_cpu(CPU) and not dispatch.is_cpu(CUDA)


def test_numbers_arrive_on_a_device_whatever_their_layout() -> None:
    values = np.arange(24, dtype=np.int64).reshape(4, 6)
    for part in (values, values[:, ::2], values.T, values[:0], values.astype(np.float32)):
        found = dispatch.to_device_async(part, CPU)
        assert np.array_equal(found.numpy(), part) and found.numpy().dtype == part.dtype and found.is_contiguous()


def test_blocks_keep_the_slots_they_once_got() -> None:
    random, slots, expected = np.random.default_rng(0), BlockSlots(np.zeros((0, 3), np.int32)), dict[tuple[int, ...], int]()
    for _ in range(20):
        keys = random.permutation(np.unique(random.integers(-3, 5, (30, 3)), axis=0))
        for key in map(tuple, keys.tolist()):
            expected.setdefault(key, len(expected))
        assert slots.find(keys).tolist() == [expected[key] for key in map(tuple, keys.tolist())]
        assert slots.keys.tolist() == [list(key) for key in expected]



def test_kernels_name_their_aligned_tensors() -> None:
    launch = pytest.importorskip("fieldfuse.backends.triton.launch", reason="needs Triton")

    def add(rows, count, SIZE: tl.constexpr):  # type: ignore[no-untyped-def]  # noqa: F821
        """Never run."""

    assert launch.kernel("rows")(add) is not None
    with pytest.raises(ValueError, match="add has no tensor places"):
        launch.kernel("places")(add)


def test_pieces_and_powers() -> None:
    launch = pytest.importorskip("fieldfuse.backends.triton.launch", reason="needs Triton")
    for count in range(1, 40):
        assert launch.pieces(count, 8) == -(-count // 8)
        assert launch.power_of_two(count) >= count > launch.power_of_two(count) / 2
