"""Both optimisers of a step on CUDA: lazy Adam on the rows that it touched, Adam on the decoder; `torch_engine.py` is the reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import triton
import triton.language as tl

if TYPE_CHECKING:
    from fieldfuse.training.losses import Rates

# Where kernels find the step sizes and the weights of the losses.
R_DENSITY, R_FEATURE, R_DECODER, R_DISTORTION, R_OPACITY, R_DEPTH, R_NOISE, R_SLOW = (tl.constexpr(v) for v in range(8))
RATES = 8


def rates_of(rates: Rates) -> list[float]:
    """What kernels read of `rates`, each in its place."""
    steps = [rates.density, rates.feature, rates.decoder]
    return [*steps, rates.distortion, rates.opacity, rates.depth, rates.depth_noise, rates.slow_within]


@triton.jit(do_not_specialize=["rows"])
def move(
    density, feature, g_density, g_feature, second_density, second_feature, steps, touched, bad, rates,
    rows, log_decay, decay, epsilon,
    C: tl.constexpr, P: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Lazy Adam on the rows that were touched (`LazyAdam.step`), and their gradients back to zero. Nothing is moved where `bad` says so."""
    row = tl.program_id(0) * B + tl.arange(0, B)
    there = tl.load(touched + row, mask=row < rows, other=0) != 0
    if tl.max(there.to(tl.int32), 0) > 0:
        channel = tl.arange(0, P)
        good = (row * 0 + tl.load(bad)) == 0
        both = there[:, None] & (channel < C)[None, :]
        at = row[:, None].to(tl.int64) * C + channel[None, :]
        moved, all_moved = there & good, both & good[:, None]
        step = tl.load(steps + row, mask=there, other=0.0) + 1
        unbias = tl.sqrt(1 - tl.exp2(step * log_decay))
        one = tl.load(g_density + row, mask=there, other=0.0)
        second = decay * tl.load(second_density + row, mask=there, other=0.0) + (1 - decay) * one * one
        change = one / (tl.sqrt(second) + epsilon) * unbias * tl.load(rates + R_DENSITY)
        tl.store(density + row, tl.load(density + row, mask=there, other=0.0) - change, mask=moved)
        tl.store(second_density + row, second, mask=moved)
        tl.store(steps + row, step, mask=moved)
        many = tl.load(g_feature + at, mask=both, other=0.0)
        seconds = decay * tl.load(second_feature + at, mask=both, other=0.0) + (1 - decay) * many * many
        changes = many / (tl.sqrt(seconds) + epsilon) * (unbias * tl.load(rates + R_FEATURE))[:, None]
        tl.store(feature + at, tl.load(feature + at, mask=both, other=0.0) - changes, mask=all_moved)
        tl.store(second_feature + at, seconds, mask=all_moved)
        tl.store(g_density + row, tl.zeros([B], tl.float32), mask=there)  # not 0 · g, which may be NaN
        tl.store(g_feature + at, tl.zeros([B, P], tl.float32), mask=both)
        tl.store(touched + row, tl.zeros([B], tl.uint8), mask=there)


@triton.jit(do_not_specialize=["size"])
def learn(
    values, gradient, first, second, kept, state, bad, rates, size, log_first, log_second, epsilon, B: tl.constexpr,
):  # fmt: skip
    """Adam on the decoder (`torch.optim.Adam`), whose weights where `kept` is 0 stay as they are."""
    place = tl.program_id(0) * B + tl.arange(0, B)
    on = place < size
    if tl.load(bad) == 0:
        step = tl.load(state + 1).to(tl.float32) + 1
        decay, square_decay = tl.exp2(log_first), tl.exp2(log_second)
        g = tl.load(gradient + place, mask=on, other=0.0)
        m = decay * tl.load(first + place, mask=on, other=0.0) + (1 - decay) * g
        v = square_decay * tl.load(second + place, mask=on, other=0.0) + (1 - square_decay) * g * g
        size_of = tl.load(rates + R_DECODER) / (1 - tl.exp2(step * log_first))
        change = size_of * m / (tl.sqrt(v) / tl.sqrt(1 - tl.exp2(step * log_second)) + epsilon)
        tl.store(first + place, m, mask=on)
        tl.store(second + place, v, mask=on)
        tl.store(values + place, tl.load(values + place, mask=on, other=0.0) - change * tl.load(kept + place, mask=on, other=0.0), mask=on)


@triton.jit
def count_step(state, bad, failed):
    """The numbers of the next step, and of good and of bad steps so far."""
    broken = tl.load(bad)
    tl.store(state, tl.load(state) + 1)
    tl.store(state + 1, tl.load(state + 1) + (broken == 0).to(tl.int64))
    tl.store(failed, tl.load(failed) + (broken != 0).to(tl.int32))
    tl.store(bad, broken * 0)
