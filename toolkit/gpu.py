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


def sent(values: NDArray[Any], device: torch.device) -> Tensor:
    """The same numbers on a device; on CUDA from memory that stays in place, so that nobody has to wait for the copy."""
    tensor = torch.from_numpy(np.ascontiguousarray(values))
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


class Kernel:
    """A Triton kernel, launched as `kernel[grid](…)`.

    Triton looks at every number and tensor of a launch to know which variant is meant, and asks its hooks: most of what a small launch
    costs. Here a short key finds what the first launch of its kind had compiled, which is then launched directly. Whole numbers are of
    32 bits: a kernel that is given a longer one is compiled for it if it comes first, else refuses it.

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

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        return partial(self._launch, grid)

    def _launch(self, grid: tuple[int, ...], *given: Any, **named: Any) -> None:
        if not self._tensors:  # a place always holds one, or never
            self._tensors = tuple(place for place, value in enumerate(given) if isinstance(value, Tensor))
        device = given[self._tensors[0]].get_device()
        kinds = [given[place].dtype for place in self._tensors]
        ends = [given[place].data_ptr() & 15 for place in self._aligned]
        # By name a launch gives constants and options, in the same order each time; a few give constants by place.
        constants = [given[place] for place in self._constants if place < len(given)]
        key = (device, *kinds, *ends, *constants, *map(type, given), *named.values())
        compiled = self._compiled.get(key)
        if compiled is None:
            compiled = self.jitted[grid](*given, **named)
            if hasattr(compiled, "function"):  # neither the interpreter nor what stands in for it in tests
                self._compiled[key] = compiled
            return
        rest = [named[name] for name in self.names[len(given) :]]
        compiled[(*grid, 1, 1)[:3]](*given, *rest, stream=torch._C._cuda_getCurrentRawStream(device))


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
