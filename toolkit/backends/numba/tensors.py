"""Tensors as kernels of the networks take them, and work on many rows shared between threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fieldfuse.threads import share, slices

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"reassoc", "contract", "nsz", "arcp"}}
F = np.float32
FEW = 4096  # rows below which threads do not pay
PIECES = 8  # a thread


def array(values: Tensor) -> Any:
    """What a kernel takes; no copy where it lies in memory as it should."""
    return values.detach().contiguous().numpy()


def spread(work: Callable[[slice], Any], count: int) -> None:
    """Do `work` on `count` rows, on as many threads as torch has."""
    threads = torch.get_num_threads() if count >= FEW else 1
    share(work, slices(count, PIECES * threads if threads > 1 else 1), threads)
