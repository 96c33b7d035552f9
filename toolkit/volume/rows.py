"""Memory for rows of blocks, of which few are ever written."""

from __future__ import annotations

import math

import torch

from fieldfuse import memory

Tensor = torch.Tensor


def zero_rows(shape: tuple[int, ...], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Tensor:
    """Zeros; on the CPU those that nobody writes take no memory (`memory.pages`)."""
    device, count = torch.device(device), math.prod(shape)
    if device.type != "cpu" or count == 0:
        return torch.zeros(shape, dtype=dtype, device=device)
    return torch.frombuffer(memory.pages(count * dtype.itemsize), dtype=dtype).view(shape)
