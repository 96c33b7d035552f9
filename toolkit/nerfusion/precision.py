"""The numbers in which the networks compute where nothing is learned: bfloat16 where the processor has instructions for it, else float32.

Convolutions and linear layers alone are meant; volumes, sweeps and the field stay in float32. A processor without such instructions
converts back and forth, and takes longer.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch

AUTO, FLOAT32, BFLOAT16 = "auto", "float32", "bfloat16"


def has_bfloat16(device: torch.device) -> bool:
    """Whether it is known that bfloat16 is faster there: x86 processors that multiply it. (CUDA was not measured.)"""
    if device.type != "cpu":
        return False
    tests = (getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"))
    return any(test is not None and bool(test()) for test in tests)


def computing(precision: str, device: torch.device) -> AbstractContextManager[object]:
    """A context in which networks on `device` compute in this precision.

    Args:
        precision: auto | float32 | bfloat16.
    """
    if precision == FLOAT32 or (precision == AUTO and not has_bfloat16(device)):
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16)
