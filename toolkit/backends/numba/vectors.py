"""What compiled loops need to be fast and numba's own operations do not give."""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@cast(Any, intrinsic)
def lesser(context: Any, one: Any, other: Any) -> Any:
    """The smaller of two float32 that are numbers.

    `min` means a branch to the compiler, as soon as its result goes into the next turn of a loop, and such loops stay scalar; this is one
    instruction. What it gives where one of them is NaN is not defined.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.FloatType()
        function = builder.module.declare_intrinsic("llvm.minnum", [number], ir.FunctionType(number, [number, number]))
        return builder.call(function, arguments, fastmath=("nnan", "nsz"))

    return types.float32(types.float32, types.float32), generate
