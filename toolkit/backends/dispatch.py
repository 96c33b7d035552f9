"""Which backend computes what: the one place where this is decided.

| backend | runs on | used for |
| --- | --- | --- |
| torch | any device | the reference of everything, which the tests compare the others with; decoders per sample on CUDA |
| numba | CPU | fits, rendering, fusion |
| triton | CUDA, compute capability 7 or newer | fits and rendering with the deferred decoder, fusion, block tables |

`FIELDFUSE_TRITON=0` turns Triton's kernels off. Modules with kernels are imported where they are used, after the functions here have
said that they can be.
"""

from __future__ import annotations

import os
from functools import cache
from importlib import import_module, util
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

OLDEST = 7  # compute capability
FLOATS = (torch.float32, torch.bfloat16, torch.float16)
OTHERS_GO_ON = "thread_local"  # error mode of recording a CUDA graph: other threads (a viewer's) may use the device meanwhile


@cache
def _installed() -> bool:
    return os.environ.get("FIELDFUSE_TRITON", "1") != "0" and util.find_spec("triton") is not None


def can_use_triton(*values: Tensor, dtypes: tuple[torch.dtype, ...] | None = (torch.float32,)) -> bool:
    """Whether Triton's kernels can take all of `values`: they lie on a CUDA device and are of one of `dtypes` (None: any)."""
    return all(value.is_cuda and (dtypes is None or value.dtype in dtypes) for value in values) and _installed()


def can_use_numba(*values: Tensor) -> bool:
    """Whether compiled kernels for the CPU can take all of `values`."""
    return all(value.device.type == "cpu" and value.dtype == torch.float32 for value in values)


def kernels(name: str, *values: Tensor) -> Any:
    """The module `name` of kernels that take `values` where they lie, `backends/numba/` or `backends/triton/`; None: torch computes."""
    backend = "numba" if can_use_numba(*values) else "triton" if can_use_triton(*values) else None
    return None if backend is None else import_module(f"fieldfuse.backends.{backend}.{name}")


def triton_runs_on(device: torch.device) -> bool:
    """Whether Triton's kernels run on `device`: CUDA, on a card of compute capability `OLDEST` or newer."""
    return device.type == "cuda" and _installed() and torch.cuda.get_device_capability(device)[0] >= OLDEST


def choose_engine(engine: str, decoder: str, device: torch.device) -> str:
    """The backend of fits and renderings.

    Args:
        engine: the setting: auto, numba, triton or torch.
        decoder: deferred (one colour a ray) or per_sample (the paper's); Triton has kernels for the first alone.

    Returns:
        numba, triton or torch.
    """
    if device.type == "cpu":
        return "torch" if engine == "torch" else "numba"
    return "triton" if engine in ("auto", "triton") and decoder == "deferred" and triton_runs_on(device) else "torch"


def is_cpu(device: torch.device) -> bool:
    """Whether sizes of results can be read without a wait: on the CPU. On another device a read waits for all that was launched before, so
    that there it is cheaper to compute what is not needed along than to ask how much is."""
    return device.type == "cpu"


def to_device_async(values: NDArray[Any], device: torch.device) -> Tensor:
    """The same numbers on `device`. On CUDA nobody waits for the copy, from pinned memory that PyTorch frees after it."""
    whole = torch.from_numpy(np.ascontiguousarray(values))
    return whole.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else whole.to(device)
