"""Semi-global matching (Hirschmüller 2008): costs of planes summed along paths through the image, and the lowest of them."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

F = np.float32
HIGH = F(1e9)
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ONE, TWO = np.uintp(1), np.uintp(2)  # places that cannot be negative need no check


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


@njit(**OPTIONS)
def _go_on(cost: Any, total: Any, at: Any, line: Any, past: Any, own: Any, planes: int, base: Any, most: Any, small: Any) -> Any:
    """One pixel further along a path; equation 13 of the paper.

    Args:
        cost, total: (H · W · D,) of which those of this pixel begin at `at`; the path's are added to `total`.
        line: costs along the path, of the pixel before from `past` on, of this one from `own` on; each with `HIGH` before and after it.
        base: the lowest cost of the pixel before; most: that and the penalty of a step.

    Returns:
        the lowest cost of this pixel.
    """
    lowest = HIGH
    for number in range(planes):
        d = np.uintp(number)
        stay = lesser(line[past + d + ONE], most)
        value = lesser(stay, lesser(line[past + d], line[past + d + TWO]) + small) + cost[at + d] - base
        line[own + d + ONE] = value
        total[at + d] += value
        lowest = lesser(lowest, value)
    return lowest


@njit(**OPTIONS)
def add_paths(cost: Any, grey: Any, way: int, slants: tuple[int, ...], small: float, large: float, soft: float, total: Any) -> None:
    """Add the costs aggregated along some directions to `total` (H · W · D,): along the rows, and from row to row with each of `slants`;
    downwards and to the right, or the other `way`."""
    height, width = grey.shape
    planes = len(cost) // max(height * width, 1)
    room = planes + 2
    # Of each direction two rows, this one and the one before; two pixels of the row's own path; and nothing, from which paths begin.
    single = 2 * len(slants) * width
    lines = np.full((single + 3) * room, HIGH, np.float32)
    lines[(single + 2) * room :] = F(0)
    least = np.zeros((2, len(slants), width), np.float32)
    step, lowest, nothing = F(small), F(0), np.uintp((single + 2) * room)
    for number in range(height):
        y = number if way > 0 else height - 1 - number
        now = number & 1
        for i in range(width):
            x = i if way > 0 else width - 1 - i
            at = np.uintp((y * width + x) * planes)
            own, past, base, jump = np.uintp((single + (i & 1)) * room), nothing, F(0), F(0)
            if i > 0:
                past, base = np.uintp((single + (1 - (i & 1))) * room), lowest
                jump = max(F(large) / (F(1) + abs(grey[y, x] - grey[y, x - way]) / F(soft)), F(1.5) * step)
            lowest = _go_on(cost, total, at, lines, past, own, planes, base, base + jump, step)
            for k in range(len(slants)):
                before = x - way * slants[k]
                own, past, base, jump = np.uintp(((2 * k + now) * width + x) * room), nothing, F(0), F(0)
                if number > 0 and 0 <= before < width:
                    past, base = np.uintp(((2 * k + 1 - now) * width + before) * room), least[1 - now, k, before]
                    jump = max(F(large) / (F(1) + abs(grey[y, x] - grey[y - way, before]) / F(soft)), F(1.5) * step)
                least[now, k, x] = _go_on(cost, total, at, lines, past, own, planes, base, base + jump, step)


@njit(**OPTIONS)
def lowest_plane(total: Any, plane: Any) -> None:
    """The best plane of each pixel between planes: a parabola through three costs."""
    height, width, planes = total.shape
    for y in range(height):
        for x in range(width):
            values = total[y, x]
            least = HIGH
            for d in range(planes):
                least = lesser(least, values[d])
            best = 0
            while best < planes - 1 and values[best] > least:
                best += 1
            offset = F(0)
            if 0 < best < planes - 1:
                low, mid, high = values[best - 1], values[best], values[best + 1]
                bend = low - F(2) * mid + high
                if bend > F(1e-9):
                    offset = min(max(F(0.5) * (low - high) / bend, F(-0.5)), F(0.5))
            plane[y, x] = F(best) + offset
