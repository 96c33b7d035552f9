"""The CPU's fast engine: the step of the reference through compiled kernels, on the field's own memory."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

from fieldfuse import memory
from fieldfuse.backends.constants import DIRECTION, STOP
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba import decode, per_sample, train_per_sample, train_rays
from fieldfuse.backends.numba import train_adam as adam
from fieldfuse.backends.numba.train_batch import Batch, Losses, Part, Sums, Tiles, pixels_of
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import NumbaRenderer, decoder_arrays
from fieldfuse.training.losses import Rates
from fieldfuse.training.nonfinite_policy import NotFiniteError, first_broken
from fieldfuse.training.pixels import PixelPool, tile_grid
from fieldfuse.training.start import unseen_harmonics

Array = np.ndarray[Any, Any]
BETAS, EPSILON = (0.9, 0.99), 1e-10  # of the decoder; rows have no first moment
_CONSTANTS = (np.float32(BETAS[0]), np.float32(BETAS[1]), np.float32(EPSILON))


class DeferredDecoder:
    """The deferred decoder's weights as the kernels have them, and each thread's room for a batch."""

    threshold: float | None = None  # of samples that get a gradient; None: as the rates have it

    def __init__(self, decoder: Deferred, threads: int) -> None:
        self.decoder, self.weights = decoder, decode.layers_of(decoder_arrays(decoder))
        self.turned = decode.turned(self.weights, decoder.channels)
        tapes = [decode.make_tape(self.weights, decoder.channels) for _ in range(threads)]
        self.blocks = [train_rays.make_block(tape, decoder.channels) for tape in tapes]
        self.moved = tuple(self.weights)
        self.gradients = [tuple(tape.total) for tape in tapes]
        self.of_direction = self.weights.w1[decoder.channels :][:DIRECTION]

    def gradient_pass(self, thread: int, around: NumbaRenderer, *rest: Any) -> tuple[int, float, int]:
        """See `train_rays.gradient_pass`; `rest` from the pixels to the sums."""
        fixed = (around.space, around.volume, self.weights, self.turned, around.background)
        return train_rays.gradient_pass(*fixed, *rest, self.blocks[thread])

    def turn(self) -> None:
        """Renew the transposed copies of the weights."""
        decode.turn(self.weights, self.turned)

    def write(self) -> None:
        """Put the weights back into the decoder."""
        decode.write_layers(self.weights, self.decoder)


class PerSampleDecoder:
    """The same of the paper's decoder. It gives a density too, and every sample needs it: only what weighs next to nothing is left out."""

    threshold = per_sample.NEGLIGIBLE

    def __init__(self, decoder: PerSample, threads: int) -> None:
        self.decoder, self.weights = decoder, per_sample.net_of(decoder)
        self.scratch = [train_per_sample.make_scratch(self.weights) for _ in range(threads)]
        self.moved = _trained(self.weights)
        self.gradients = [_trained(scratch.total) for scratch in self.scratch]
        self.of_direction = self.weights.w3[len(self.weights.b3) :][:DIRECTION]

    def gradient_pass(self, thread: int, around: NumbaRenderer, *rest: Any) -> tuple[int, float, int]:
        fixed = (around.space, around.volume, self.weights, around.background)
        return train_per_sample.gradient_pass(*fixed, *rest, self.scratch[thread])

    def turn(self) -> None:
        per_sample.turn(self.weights)

    def write(self) -> None:
        per_sample.write_net(self.weights, self.decoder)


def _trained(net: per_sample.Net) -> tuple[Array, ...]:
    return net.w1, net.b1, net.w2, net.b2, net.density, net.density_bias, net.w3, net.b3, net.w4, net.b4


def _flat(arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """Each array as a row of numbers in the same memory, for what treats all of them alike in one call."""
    return tuple(array.reshape(-1) for array in arrays)


class NumbaEngine:
    """A field, its pixels, and the optimiser state of the rows that rays have come to; see `engine.Engine`.

    Memory beside the field: a lattice corner costs 4 bytes and 6 more a thread, and 2 (C + 2) bytes once a gradient has come to it.
    """

    def __init__(self, field: Field, pool: PixelPool, seed: int = 0, threads: int | None = None) -> None:
        self.pool, self.threads = pool, threads or torch.get_num_threads()
        self.generator = np.random.default_rng(seed)
        self.pixels = pixels_of(pool)
        self.met = Tiles(len(pool.pose), tile_grid(pool))
        self.next: Batch | None = None
        kind = DeferredDecoder if isinstance(field.decoder, Deferred) else PerSampleDecoder
        self.decoder: Any = kind(field.decoder, self.threads)  # type: ignore[arg-type]
        self.unseen = unseen_harmonics(field.decoder).numpy()
        self.weights, self.gradients = _flat(self.decoder.moved), [_flat(own) for own in self.decoder.gradients]
        self.first, self.second, self.total = (tuple(np.zeros_like(weight) for weight in self.weights) for _ in range(3))
        self.decoder_steps = 0
        steps = np.arange(1, 2049)
        self.scales = np.concatenate([[1], np.sqrt(1 - BETAS[1] ** steps)]).astype(np.float32)
        self.executor = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self.barrier = threading.Barrier(self.threads)
        self.renew_rows(field)

    def renew_rows(self, field: Field) -> None:
        rows, channels = len(field.density_rows), field.feature_rows.shape[1]
        # Sized for the worst case; the system gives memory only to the part that is written.
        self.rows = adam.Rows(
            index=np.full((rows, self.threads + 1), -1, np.int32),
            bases=np.zeros(self.threads, np.int64),
            records=K.aligned((rows * self.threads, adam.FEATURE + channels), np.uint16, zeroed=True),
            touched=memory.unwritten((self.threads, rows), np.int32),
            density=memory.unwritten((self.threads, rows), np.float32),
            feature=K.aligned((self.threads, rows, channels), np.float32),
        )
        self.given, self.used = [0] * self.threads, [0] * self.threads
        self.marks = np.zeros((self.threads, len(field.occupied)), np.uint16)
        self.go_on_with(field)

    def release(self) -> None:
        del self.rows
        self.marks = np.empty((0, 0), np.uint16)

    def go_on_with(self, field: Field) -> None:
        self.field = field
        self.renderer = NumbaRenderer(field, 1, self.decoder.weights)
        adam.fade(self.marks)

    @property
    def seen(self) -> torch.Tensor:
        """(M · 512,) largest weight that each voxel was seen with."""
        return torch.from_numpy(np.divide(self.marks.max(0) >> 4, np.float32(4095), dtype=np.float32))

    @property
    def visits(self) -> torch.Tensor:
        """(M · 512,) how often samples fell into each voxel (saturating at 15 a thread)."""
        return torch.from_numpy((self.marks & 15).sum(0, dtype=np.int16))

    def sync(self) -> Field:
        self.decoder.write()
        return self.field

    def colours(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        return self.renderer.render(origins, directions)[:, :3]

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:
        batch = self.next
        if batch is None or len(batch.picks) != rays or batch.limit != self.pool.limit:
            batch = self._draw(rays)
        self.next = self._draw(rays)
        return self._step(batch, self.next, rates)

    def step_on(self, picks: Array, jitter: Array, rates: Rates, weights: Array | None = None) -> tuple[float, int]:
        """One step on the pixels `picks` (B,), each counted `weights` (B,) times, with the rays' lattices moved by `jitter` (B,)."""
        weights = np.ones(len(picks), np.float32) if weights is None else weights
        return self._step(Batch(picks, jitter, weights, self.threads), None, rates)

    def _draw(self, rays: int) -> Batch:
        """Random pixels, more of those where the field was wrong lately (`pixels`)."""
        self.met.renew()
        jitter, seed = self.generator.random(rays, np.float32), int(self.generator.integers(2**62))
        return Batch(np.empty(rays, np.int64), jitter, np.empty(rays, np.float32), self.threads, self.pool.limit, seed)

    def _step(self, batch: Batch, following: Batch | None, rates: Rates) -> tuple[float, int]:
        """One step on `batch`; the order of the `following` one is found beside it."""
        space = self.renderer.space
        if not batch.sorted:
            for thread in range(self.threads):
                batch.look(thread, space, self.pixels, self.met)
            batch.sort(self.met)
        threshold = rates.colour_threshold if self.decoder.threshold is None else self.decoder.threshold
        weights = (rates.distortion, rates.opacity, rates.depth, rates.depth_noise, threshold, STOP, rates.slow_within)
        losses = Losses(*(np.float32(weight) for weight in weights))
        shares, met = batch.weights / np.float32(len(batch.picks)), np.empty((len(batch.picks), 3), np.float32)
        results: list[Any] = [None] * self.threads
        step_sizes = np.array([rates.density, rates.feature], np.float32)

        def gradients(thread: int) -> tuple[float, int, str | None]:
            own, rows = batch.part(thread), self.rows
            self._forget(thread)
            part = Part(batch.picks[own], batch.jitter[own], shares[own], met[own])
            sums = Sums(rows.touched[thread], rows.density[thread], rows.feature[thread], rows.index, thread + 1, rows.bases[thread])
            arguments = (self.pixels, part, losses, self.marks[thread], sums)
            self.used[thread], error, looked = self.decoder.gradient_pass(thread, self.renderer, *arguments)
            if following is not None:
                following.look(thread, space, self.pixels, self.met)
            return error, looked, self._broken(thread, error)

        def move(thread: int) -> None:
            of_thread = (thread, self.used[thread], self.given[thread])
            self.given[thread] = adam.adam_pass(
                space.width, self.renderer.volume, self.rows, *of_thread, self.scales, step_sizes, *_CONSTANTS[1:]
            )
            if thread == self.threads - 1:
                self._move_decoder(rates.decoder)
            if thread == 0:
                self.met.remember(batch.tiles, met)
                if following is not None:
                    following.sort(self.met)

        def work(thread: int) -> None:
            results[thread] = gradients(thread)
            if self.executor is not None:
                self.barrier.wait()
            if not any(broken for _, _, broken in results):
                move(thread)

        self._each(work)
        for _, _, broken in results:
            if broken is not None:
                raise NotFiniteError(broken)
        return sum(error for error, _, _ in results), sum(looked for _, looked, _ in results)

    def _forget(self, thread: int) -> None:
        """What `thread` touched in the batch before is touched no more."""
        bases, index = self.rows.bases, self.rows.index
        bases[thread] += self.used[thread]
        if bases[thread] > np.iinfo(np.int32).max - len(index):  # the next batch might not fit into 32 bits
            index[:, thread + 1] = -1
            bases[thread] = 0

    def _broken(self, thread: int, error: float) -> str | None:
        """What is not finite of what `thread` found; all at once first, because that takes a tenth of the time."""
        density, feature = (sums[thread, : self.used[thread]] for sums in (self.rows.density, self.rows.feature))
        weights, gradients = self.weights, self.gradients[thread]
        if math.isfinite(error + adam.magnitude((density, feature.reshape(-1), *weights, *gradients))):
            return None
        named = [("the gradient of the densities", density), ("the gradient of the features", feature)]
        named += [("a weight of the decoder", weight) for weight in weights]
        return first_broken(error, named + [("the gradient of the decoder", gradient) for gradient in gradients])

    def _each(self, work: Callable[[int], None]) -> None:
        """`work(thread)` of all threads, the first of them here; they may wait for each other at the barrier."""
        if self.executor is None:
            work(0)
            return

        def safe(thread: int) -> None:
            try:
                work(thread)
            except BaseException:
                self.barrier.abort()  # else the others would wait for ever
                raise

        self.barrier.reset()
        others = [self.executor.submit(safe, thread) for thread in range(1, self.threads)]
        failed: list[BaseException] = []
        try:
            safe(0)
        except BaseException as own:
            failed.append(own)
        failed += [error for other in others if (error := other.exception()) is not None]  # all are done now
        for cause in sorted(failed, key=lambda one: isinstance(one, threading.BrokenBarrierError)):
            raise cause

    def _move_decoder(self, rate: float) -> None:
        """Adam on the decoder, with the sum of the threads' gradients."""
        self.decoder_steps += 1
        n = self.decoder_steps
        scale = np.float32(rate * np.sqrt(1 - BETAS[1] ** n) / (1 - BETAS[0] ** n))
        total, *others = self.gradients
        for own in others:
            adam.add_dense(total, own, self.total)
            total = self.total
        adam.adam_dense(self.weights, total, self.first, self.second, scale, *_CONSTANTS)
        if self.unseen.any():
            self.decoder.of_direction[self.unseen] = 0
        self.decoder.turn()
