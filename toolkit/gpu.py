"""What is different on CUDA: kernels in Triton for what takes hundreds of short operations as tensors, and that asking costs a wait.

Modules with kernels (`networks/gpu`, `*_gpu.py`) are imported when tensors lie there. Everything has a way in tensors beside it, which is
taken where Triton is not installed and which the tests compare with. `FIELDFUSE_TRITON=0` leaves the kernels out.
"""

from __future__ import annotations

import os
from functools import cache
from importlib import util

import torch
from torch import Tensor


@cache
def _there() -> bool:
    return os.environ.get("FIELDFUSE_TRITON", "1") != "0" and util.find_spec("triton") is not None


def there(values: Tensor) -> bool:
    """Whether values of any kind lie where the kernels are."""
    return values.is_cuda and _there()


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
