"""What the CPU's compiled kernels share: options, constants, the arrays of a field, and prefetching memory.

The kernels themselves, one ray through a sparse field in float32 scalars and short rows: `lookup.py` (lattice values),
`march.py` (samples along a ray), `decode.py` (features to colour).

Everything here has a twin in torch (`render/march.py`, `volume/lookup.py`, `nerfusion/decoder.py`): the reference, which tests compare
with. Compiled functions are cached on disk. Numba turns an `int * float32` and every Python literal into float64, hence explicit F(...).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.options import DefaultOptions
from numba.extending import intrinsic

from fieldfuse.backends import constants

F = np.float32
# Sums may be reordered and multiplications fused; NaN and infinity keep their meaning, so that a broken number is seen.
MATHS = {"contract", "reassoc", "nsz", "arcp", "afn"}
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": MATHS, "error_model": "numpy", "boundscheck": False}
# Of functions that make no arrays of their own, called for each ray or sample: without this every array among their arguments, also those
# in tuples, is counted by an atomic operation when they begin and when they end: a tenth of a profile of the training step.
LEAF: dict[str, Any] = {**OPTIONS, **({"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {})}

INLINE: dict[str, Any] = {**LEAF, "forceinline": True}

ZERO, HALF, ONE, TWO = F(0), F(0.5), F(1), F(2)
START = np.int64(0)  # a number that a function gets: given a Python literal, it would be compiled once more for this very value
SOLID, RAW_MAX, UNITS = F(constants.SOLID), F(constants.RAW_MAX), F(constants.UNITS)
STRETCH = F(constants.MAX_STRETCH)
THIN = F(0.01)  # below this optical thickness 1 - exp(-τ) is taken from its series: the difference would lose digits
THIRD = F(1 / 3)
LINE = 64  # bytes of a cache line
MOST_KEPT = 1024  # samples of one ray whose weight exceeds the threshold: they sum to at most 1
VALUES = 9  # columns of a sample's floats
# AFTER: transmittance behind the sample; ALONG: distance from the camera, working units
X, Y, Z, RAW, TAU, WEIGHT, AFTER, PLACE, ALONG = range(VALUES)


@cast(Any, intrinsic)
def prefetch(context: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of array[index] or array[index, 0]: memory latency is most of what a ray costs.

    Numba has no prefetch of its own. Without this a fit (fox, 320 pixels, one thread) has 21% fewer rays a second.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        view = context.make_array(kind)(context, builder, arguments[0])
        width = cgutils.unpack_tuple(builder, view.shape, kind.ndim)[-1] if kind.ndim == 2 else ir.Constant(ir.IntType(64), 1)
        offset = builder.mul(arguments[1], width)
        pointer = builder.bitcast(builder.gep(view.data, [offset]), ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        shape = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, shape, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@njit(**INLINE)
def to_half(value: Any) -> Any:
    """float32 → uint16: the nearest bfloat16, the even one of two that are as near."""
    bits = F(value).view(np.uint32)
    even = (bits >> np.uint32(16)) & np.uint32(1)
    return np.uint16((bits + even + np.uint32(0x7FFF)) >> np.uint32(16))


@njit(**INLINE)
def of_half(value: Any) -> Any:
    """uint16, a bfloat16 → float32, the same number."""
    return np.uint32(np.uint32(value) << np.uint32(16)).view(np.float32)


def aligned(shape: tuple[int, ...], dtype: Any, zeroed: bool = False) -> np.ndarray[Any, Any]:
    """An array that starts at a cache line, so that a row of 16 floats is one line and not parts of two."""
    count = math.prod(shape) * np.dtype(dtype).itemsize
    raw = (np.zeros if zeroed else np.empty)(count + LINE, np.uint8)
    start = -raw.ctypes.data % LINE
    return raw[start : start + count].view(dtype).reshape(shape)


class Space(NamedTuple):
    """Scalars of a field: see `volume.space.Space` and `march.MarchGrid`."""

    cx: Any
    cy: Any
    cz: Any
    half: Any
    shell: Any
    extent: Any
    bx: Any
    by: Any
    bz: Any
    voxel: Any
    near: Any
    fine: Any  # int
    resolution: Any  # int
    ox: Any  # table origin, ints
    oy: Any
    oz: Any
    width: Any  # tuple with an entry a channel: its length is known to the compiler, which then unrolls


class Outer(NamedTuple):
    """A frozen, coarser field that is sampled where the volume's own voxels are none (`Field.outer`); without one its table is empty."""

    table: Any  # these five as in `Volume`
    bits: Any
    upper: Any
    density: Any
    feature: Any
    ox: Any  # table origin, ints
    oy: Any
    oz: Any
    shrink: Any  # its voxels to one of the volume's, below 1


class Volume(NamedTuple):
    """Arrays of a field, all of them views of the field's own tensors but `bits`, `bricks` and `upper`."""

    table: Any  # (Sz, Sy, Sx) int32 slot or −1
    bricks: Any  # (B, B, B) uint8 distance in bricks to the nearest occupied brick (the outer field's, too), with a margin of one
    bits: Any  # (M, 8) uint64 occupancy, one word a z-slice
    upper: Any  # (M, 8) int32 blocks at +x, +y, +z combinations, bit 0 x, bit 1 y, bit 2 z; M where absent
    density: Any  # (M · 512 + 1,) float32
    feature: Any  # (M · 512 + 1, C) float32
    outer: Any  # Outer


class Decoder(NamedTuple):
    """The deferred decoder's weights, as sums over whichever index the compiler is to vectorise need them.

    Inputs are C mean features and sixteen harmonics: I = C + 16.
    """

    w1: Any  # (I, H)
    w1_out: Any  # (H, I), the same transposed
    b1: Any
    w2: Any  # (H, H)
    w2_out: Any
    b2: Any
    w3: Any  # (3, H)
    b3: Any
