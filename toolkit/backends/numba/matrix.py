"""Products of small matrices inside compiled loops, in registers: what a decoder costs when it is used at every sample.

With plain loops instead a fit with the deferred decoder (fox, 320 pixels, one thread) has 25% fewer rays a second.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from fieldfuse.backends.numba.common import OPTIONS

TILE = 4  # rows of a result that are summed at a time: each load of the right factor serves them all
LANES = 16  # and columns: widths are multiples of this


@cast(Any, intrinsic)
def _tile(
    context: Any,
    left: Any,
    left_at: Any,
    left_row: Any,
    left_step: Any,
    right: Any,
    right_at: Any,
    right_step: Any,
    count: Any,
    out: Any,
    out_at: Any,
    out_row: Any,
    add: Any,
) -> Any:
    """out[r, c] = Σ_k left[r, k] right[k, c] for TILE rows and LANES columns; with `add` the old value is kept and added to.

    Places are offsets in elements: left_at + r · left_row + k · left_step, right_at + k · right_step + c, out_at + r · out_row + c.
    The compiler keeps the sums in vector registers, which it does not do for loops over arrays: it cannot prove that they do not overlap.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a0, a_row, a_step, b0, b_step, n, c0, c_row, adding = (arguments[i] for i in (1, 2, 3, 5, 6, 7, 9, 10, 11))
        a, b, c = (context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in (0, 4, 8))
        vector, index = ir.VectorType(ir.FloatType(), LANES), ir.IntType(64)

        def place(base: Any, offset: Any) -> Any:
            return builder.bitcast(builder.gep(base, [offset]), vector.as_pointer())

        sums = [cgutils.alloca_once(builder, vector) for _ in range(TILE)]
        outs = [builder.add(c0, builder.mul(c_row, index(row))) for row in range(TILE)]
        for total in sums:
            builder.store(ir.Constant(vector, [0.0] * LANES), total)
        with builder.if_then(builder.trunc(adding, ir.IntType(1))):
            for total, at in zip(sums, outs, strict=True):
                builder.store(builder.load(place(c, at), align=4), total)
        lane0, everywhere = ir.IntType(32)(0), ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        with cgutils.for_range(builder, n) as loop:
            values = builder.load(place(b, builder.add(b0, builder.mul(loop.index, b_step))), align=4)
            at = builder.add(a0, builder.mul(loop.index, a_step))
            for row, total in enumerate(sums):
                factor = builder.load(builder.gep(a, [builder.add(at, builder.mul(a_row, index(row)))]), align=4)
                spread = builder.insert_element(ir.Constant(vector, ir.Undefined), factor, lane0)
                spread = builder.shuffle_vector(spread, ir.Constant(vector, ir.Undefined), everywhere)
                product = builder.fmul(spread, values, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
        for total, at in zip(sums, outs, strict=True):
            builder.store(builder.load(total), place(c, at), align=4)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(left, whole, whole, whole, right, whole, whole, whole, out, whole, whole, types.boolean), generate


@njit(**OPTIONS)
def product(left: Any, first: Any, rows: Any, right: Any, out: Any) -> None:
    """out[first + r, :J] = left[first + r, :I] @ right (I, J) for r < rows, rounded up to whole tiles.

    All C-contiguous float32; J is a multiple of LANES, and `left` and `out` have room for the last tile and at least I and J columns.
    """
    inner, columns = right.shape
    left_row, out_row = left.shape[1], out.shape[1]
    for row in range(first, first + rows, TILE):
        for column in range(0, columns, LANES):
            _tile(left, row * left_row, left_row, 1, right, column, columns, inner, out, row * out_row + column, out_row, False)


@njit(**OPTIONS)
def add_outer(left: Any, right: Any, rows: Any, out: Any) -> None:
    """out (I, J) += left[:rows, :I]ᵀ @ right[:rows, :J]: the gradient of a layer's weights. I is a multiple of TILE, J of LANES."""
    inner, columns = out.shape
    left_row, right_row = left.shape[1], right.shape[1]
    for row in range(0, inner, TILE):
        for column in range(0, columns, LANES):
            _tile(left, row, 1, left_row, right, column, right_row, rows, out, row * columns + column, columns, True)
