"""How kernels are compiled and launched."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import triton


def kernel(*aligned: str) -> Callable[[Callable[..., Any]], Any]:
    """`triton.jit` for a kernel that is compiled once for each set of its `tl.constexpr` values and of its tensors' types.

    By default Triton compiles anew for numbers that are 1 or divisible by 16, and for tensors that do not start at multiples of 16 bytes:
    in the middle of a capture, and for every other training sample.

    Args:
        aligned: tensors that always start at such multiples (whole ones, not parts of others), which are then read in larger pieces.

    Raises:
        ValueError: the kernel has no argument of such a name.
    """

    def made(function: Callable[..., Any]) -> Any:
        given = inspect.signature(function).parameters
        names = [name for name, of in given.items() if "constexpr" not in str(of.annotation)]
        if unknown := set(aligned) - set(names):
            raise ValueError(f"{function.__name__} has no tensor {', '.join(sorted(unknown))}")
        return triton.jit(function, do_not_specialize=[name for name in names if name not in aligned])

    return made


def pieces(count: int, size: int) -> int:
    """How many pieces of a size cover a count."""
    return -(-count // size)


def power_of_two(least: int) -> int:
    """The smallest power of two that is at least `least` ≥ 1."""
    return 1 << (least - 1).bit_length()
