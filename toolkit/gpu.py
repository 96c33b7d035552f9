"""What is different on CUDA: kernels in Triton for what takes hundreds of short operations as tensors, and that asking costs a wait.

Modules with kernels (`networks/gpu`, `*_gpu.py`) are imported when tensors lie there. Everything has a way in tensors beside it, which is
taken where Triton is not installed and which the tests compare with. `FIELDFUSE_TRITON=0` leaves the kernels out.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from functools import cache
from importlib import util
from typing import Any

import torch
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


def kernel(*aligned: str) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: a Triton kernel that is compiled once for each set of its `tl.constexpr` values and of its tensors' types.

    Triton would compile anew for numbers that are 1 or divisible by 16, and for tensors that do not start at multiples of 16 bytes: in the
    middle of a capture, and for every other training sample.

    Args:
        aligned: tensors that always start there (whole ones, not parts of others), which are then read in larger pieces.
    """
    import triton

    def made(function: Callable[..., Any]) -> Any:
        given = inspect.signature(function).parameters
        names = [name for name, of in given.items() if "constexpr" not in str(of.annotation)]
        if unknown := set(aligned) - set(names):
            raise ValueError(f"{function.__name__} has no tensor {', '.join(sorted(unknown))}")
        out = triton.jit(function, do_not_specialize=[name for name in names if name not in aligned])
        out.aligned = aligned
        return out

    return made
