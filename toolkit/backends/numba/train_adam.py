"""What follows the gradients of a step, compiled: lazy Adam on the rows that were touched, Adam on the decoder, and clean-up."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K

ZERO, ONE = K.ZERO, K.ONE
COUNT, DENSITY, FEATURE = 0, 1, 2  # columns of a row's record: steps, and from where on the second moments are
MOST_STEPS = 65535  # that are counted
AHEAD = 8  # rows that are prefetched before they are needed


class Rows(NamedTuple):
    """State of the lattice corners that rays have come to, and all threads' sums over the batch at hand."""

    index: Any  # (M · 512 + 1, threads + 1) int32; column 0 is a corner's Adam record, −1: none yet; others: see `Sums`
    bases: Any  # (threads,) int64
    records: Any  # (K, C + 2) uint16: steps, and second moments of density and features as bfloat16
    touched: Any  # (threads, T) int32
    density: Any  # (threads, T) float32
    feature: Any  # (threads, T, C) float32


@njit(**K.OPTIONS)
def adam_pass(
    width: Any, volume: Any, rows: Any, thread: Any, used: Any, given: Any, scales: Any, rates: Any, b2: Any, epsilon: Any
) -> Any:
    """Lazy Adam (`torch_engine.LazyAdam`) on rows that thread `thread` touched. A row that several touched is moved by the first of them,
    with the sum in their order, so that the result depends on the number of threads alone.

    Args:
        given: how many records this thread has given to rows so far; threads take turns in the order of records, so that none waits for
            another.
        scales: (S,) float32 bias correction sqrt(1 - b2^n) for n steps; the last one beyond.
        rates: (2,) float32 of density and features.

    Returns:
        `given` after this pass.
    """
    channels = len(width)
    density, feature = volume.density, volume.feature
    index, bases, records, touched, density_sums, feature_sums = rows
    c2 = ONE - b2
    threads = index.shape[1] - 1
    for at in range(used):
        if at + 2 * AHEAD < used:
            K.prefetch(index, np.int64(touched[thread, at + 2 * AHEAD]))
        if at + AHEAD < used:
            later = np.int64(touched[thread, at + AHEAD])
            record = np.int64(index[later, 0])
            K.prefetch(records, record)
            K.prefetch(records, record + 1)  # it may begin in one cache line and end in the next
            K.prefetch(feature, later)
            K.prefetch(density, later)
        row = touched[thread, at]
        mine = True
        for other in range(threads):
            if other == thread:
                continue
            twin = np.int64(index[row, other + 1]) - bases[other]
            if twin >= 0:
                if other < thread:
                    mine = False
                    break
                density_sums[thread, at] += density_sums[other, twin]
                for c in range(channels):
                    feature_sums[thread, at, c] += feature_sums[other, twin, c]
        if not mine:
            continue
        place = np.int64(index[row, 0])
        if place < 0:
            place = given * threads + thread
            index[row, 0] = place
            given += 1
        steps = min(int(records[place, COUNT]) + 1, MOST_STEPS)
        scale = scales[min(steps, len(scales) - 1)]
        g = density_sums[thread, at]
        v = b2 * K.of_half(records[place, DENSITY]) + c2 * g * g
        records[place, COUNT], records[place, DENSITY] = np.uint16(steps), K.to_half(v)
        density[row] -= rates[0] * scale * g / (np.sqrt(v) + epsilon)
        step = rates[1] * scale
        for c in range(channels):
            g = feature_sums[thread, at, c]
            v = b2 * K.of_half(records[place, FEATURE + c]) + c2 * g * g
            records[place, FEATURE + c] = K.to_half(v)
            feature[row, c] -= step * g / (np.sqrt(v) + epsilon)
    return given


@njit(**K.OPTIONS)
def adam_dense(values: Any, gradients: Any, first: Any, second: Any, rate: Any, b1: Any, b2: Any, epsilon: Any) -> None:
    """Adam on all of `values`, a tuple of (N,) arrays like the others; the bias correction is part of `rate`."""
    for at in range(len(values)):
        value, gradient, mean, square = values[at], gradients[at], first[at], second[at]
        for i in range(len(value)):
            g = gradient[i]
            mean[i] = b1 * mean[i] + (ONE - b1) * g
            square[i] = b2 * square[i] + (ONE - b2) * g * g
            value[i] -= rate * mean[i] / (np.sqrt(square[i]) + epsilon)


@njit(**K.OPTIONS)
def add_dense(left: Any, right: Any, out: Any) -> None:
    """out = left + right, tuples of (N,) arrays; `out` may be one of the others."""
    for at in range(len(out)):
        one, other, total = left[at], right[at], out[at]
        for i in range(len(total)):
            total[i] = one[i] + other[i]


@njit(**K.OPTIONS)
def fade(marks: Any) -> None:
    """Halve weights and visits of all marks (threads, M · 512)."""
    for thread in range(marks.shape[0]):
        own = marks[thread]
        for row in range(len(own)):
            own[row] = (own[row] >> np.uint16(1)) & np.uint16(0xFFF7) & np.uint16(0x7FFF)


@njit(**K.OPTIONS)
def magnitude(values: Any) -> Any:
    """Sum of the absolute values of a tuple of (N,) float32 arrays: NaN or infinite where one of them is, or where they are huge."""
    total = ZERO
    for at in range(len(values)):
        value = values[at]
        for i in range(len(value)):
            total += abs(value[i])
    return total
