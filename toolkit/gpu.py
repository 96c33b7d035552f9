"""What is different on CUDA: kernels in Triton for what takes hundreds of short operations as tensors, and that asking costs a wait.

Modules with kernels (`networks/gpu`, `*_gpu.py`) are imported when tensors lie there. Everything has a way in tensors beside it, which is
taken where Triton is not installed and which the tests compare with. `FIELDFUSE_TRITON=0` leaves the kernels out.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import util
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

OLDEST = 7  # compute capability
OTHERS_GO_ON = "thread_local"  # while a graph is recorded, other threads (a viewer's) may use the device


@cache
def _there() -> bool:
    return os.environ.get("FIELDFUSE_TRITON", "1") != "0" and util.find_spec("triton") is not None


def there(values: Tensor) -> bool:
    """Whether values of any kind lie where the kernels are."""
    return values.is_cuda and _there()


def runs_kernels(device: torch.device) -> bool:
    """Whether kernels run on `device`: on CUDA, on a card that is no older than Triton's oldest."""
    return device.type == "cuda" and _there() and torch.cuda.get_device_capability(device)[0] >= OLDEST


def fits(*values: Tensor) -> bool:
    """Whether the kernels can take these: float32 on a CUDA device."""
    return all(value.is_cuda and value.dtype == torch.float32 for value in values) and _there()


def takes(values: Tensor) -> bool:
    """Whether the convolution can take rows: on a CUDA device, in any of the numbers that networks compute in."""
    return there(values) and values.dtype in (torch.float32, torch.bfloat16, torch.float16)


def asks_freely(device: torch.device) -> bool:
    """Whether it costs nothing to ask how many there are: true on the CPU. A device of its own works behind the processor, which has to
    wait for the answer; there what is not chosen is computed along, where that is cheaper."""
    return device.type == "cpu"


def pieces(count: int, size: int) -> int:
    """How many pieces of a size cover a count."""
    return -(-count // size)


def power_of_two(least: int) -> int:
    """The smallest one that is not below `least` ≥ 1."""
    return 1 << (least - 1).bit_length()


class _Outbox:
    """Memory that stays in place, from which small things go to a device without anybody waiting for the copy. It is filled round and round
    in two halves, neither of which is written to before the device has read what was there."""

    HALF = 2**20  # bytes

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._memory = torch.empty(2 * self.HALF, dtype=torch.uint8, pin_memory=device.type == "cuda")
        self._bytes = self._memory.numpy()
        self._next = 0
        self._read: list[torch.cuda.Event | None] = [None, None]

    def send(self, values: NDArray[Any]) -> Tensor:
        first = self._room(values.nbytes)
        last = first + values.nbytes
        self._bytes[first:last] = values.reshape(-1).view(np.uint8)
        whole = self._memory[first:last].to(self.device, non_blocking=True)
        return whole.view(_TYPES[values.dtype.char]).view(values.shape)

    def _room(self, size: int) -> int:
        """Where there is room for so many bytes."""
        half = self._next // self.HALF
        if self._next + size > (half + 1) * self.HALF:
            if self._memory.is_pinned():
                event = self._read[half] = torch.cuda.Event()
                event.record()
            half = 1 - half
            if (read := self._read[half]) is not None:
                read.synchronize()
            self._next = half * self.HALF
        first = self._next
        self._next = min(first + size + -size % 16, (half + 1) * self.HALF - 1)
        return first


_TYPES = {"i": torch.int32, "l": torch.int64, "f": torch.float32}


@cache
def _outbox(device: torch.device, _stream: int) -> _Outbox:
    return _Outbox(device)


def sent(values: NDArray[Any], device: torch.device) -> Tensor:
    """The same numbers on a device; on CUDA from memory that stays in place, so that nobody has to wait for the copy."""
    if device.type != "cuda":
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)
    values = np.ascontiguousarray(values)
    if 0 < values.nbytes <= _Outbox.HALF and values.dtype.char in _TYPES:
        index = torch.cuda.current_device() if device.index is None else device.index
        return _outbox(device, torch._C._cuda_getCurrentRawStream(index)).send(values)
    return torch.from_numpy(values).pin_memory().to(device, non_blocking=True)


class Kernel:
    """A Triton kernel, launched as `kernel[grid](…)`.

    Triton looks at every number and tensor of a launch to know which variant is meant, and asks its hooks: most of what a small launch
    costs. Here a short key finds what the first launch of its kind had compiled, which is then launched directly. Whole numbers are of
    32 bits: a kernel that is given a longer one is compiled for it if it comes first, else refuses it (OverflowError).

    Args:
        jitted: the kernel as Triton made it.
        names: of all that it is given, in order.
        constants: places of `tl.constexpr` among them.
        aligned: see `kernel`.
    """

    def __init__(self, jitted: Any, names: Sequence[str], constants: Sequence[int], aligned: Sequence[str]) -> None:
        self.jitted, self.names, self.aligned = jitted, tuple(names), tuple(aligned)
        self._constants = tuple(constants)
        self._aligned = tuple(self.names.index(name) for name in aligned)
        self._tensors: tuple[int, ...] = ()
        self._compiled: dict[Any, Any] = {}
        self._quick = True

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        return partial(self._launch, grid)

    def _launch(self, grid: tuple[int, ...], *given: Any, **named: Any) -> None:
        if not self._tensors:  # a place always holds one, or never
            self._tensors = tuple(place for place, value in enumerate(given) if isinstance(value, Tensor))
        device = given[self._tensors[0]].get_device()
        kinds = [given[place].dtype for place in self._tensors]
        ends = [given[place].data_ptr() & 15 for place in self._aligned]
        # By name a launch gives constants and options, in the same order each time; a few give constants by place.
        count = len(given)
        constants = [given[place] for place in self._constants if place < count]
        key = (device, *kinds, *ends, *constants, *map(type, given), *named.values())
        launch = self._compiled.get(key) if self._quick else None
        if launch is not None:
            first, second, third = (*grid, 1, 1)[:3]
            stream = torch._C._cuda_getCurrentRawStream(device)
            try:
                launch(first, second, third, stream, *given, *[named[name] for name in self.names[count:]])
                return
            except TypeError:  # a Triton that wants other arguments here, before 3.3 say: nothing was launched
                self._quick = False
        compiled = self.jitted[grid](*given, **named)
        if hasattr(compiled, "function"):  # neither the interpreter nor what stands in for it in tests
            self._compiled[key] = _launcher(compiled)


def _launcher(compiled: Any) -> Callable[..., None]:
    """What launches a compiled kernel: given its grid, a stream, and all that it takes."""
    import triton

    if triton.__version__.startswith("3.6."):  # by the way that is inside of what follows, without its hooks
        run, function, packed = compiled.run, compiled.function, compiled.packed_metadata

        def short(first: int, second: int, third: int, stream: int, *given: Any) -> None:
            run(first, second, third, stream, function, packed, None, None, None, *given)

        return short

    def launch(first: int, second: int, third: int, stream: int, *given: Any) -> None:
        compiled[first, second, third](*given, stream=stream)

    return launch


def kernel(*aligned: str) -> Callable[[Callable[..., Any]], Kernel]:
    """A decorator: a Triton kernel that is compiled once for each set of its `tl.constexpr` values and of its tensors' types.

    Triton would compile anew for numbers that are 1 or divisible by 16, and for tensors that do not start at multiples of 16 bytes: in the
    middle of a capture, and for every other training sample.

    Args:
        aligned: tensors that always start there (whole ones, not parts of others), which are then read in larger pieces.
    """
    import triton

    def made(function: Callable[..., Any]) -> Kernel:
        given = inspect.signature(function).parameters
        constants = [place for place, of in enumerate(given.values()) if "constexpr" in str(of.annotation)]
        names = [name for place, name in enumerate(given) if place not in constants]
        if unknown := set(aligned) - set(names):
            raise ValueError(f"{function.__name__} has no tensor {', '.join(sorted(unknown))}")
        jitted = triton.jit(function, do_not_specialize=[name for name in names if name not in aligned])
        return Kernel(jitted, list(given), constants, aligned)

    return made
