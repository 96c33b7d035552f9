"""The CPU's fast engine: the same step as `step.Optimiser`, through compiled kernels, on the field's own memory."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

from fieldfuse import memory
from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba import train_adam as moves
from fieldfuse.backends.numba import train_common as kernels
from fieldfuse.backends.numba import train_decoder, train_rays
from fieldfuse.backends.numba.decode import layers_of, rays_of
from fieldfuse.backends.numba.render_rays import render_pass
from fieldfuse.backends.numba.train_order import Batch, Tiles
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.encoding import DIRECTION
from fieldfuse.render.composite import STOP, THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import decoder_arrays, make_space, make_volume
from fieldfuse.training.finite import broken, refuse
from fieldfuse.training.importance import tile_grid
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Rates
from fieldfuse.training.view import blind

Array = np.ndarray[Any, Any]
BETAS, EPSILON = (0.9, 0.99), 1e-10  # of the decoder; rows have no first moment
_CONSTANTS = (np.float32(BETAS[0]), np.float32(BETAS[1]), np.float32(EPSILON))


def _parts(count: int, size: int = 2**16) -> list[slice]:
    """Slices of so many rows, in turn: what is computed of one at a time takes no memory to speak of."""
    return [slice(begin, begin + size) for begin in range(0, count, size)]


class NumbaOptimiser:
    """A field, its pixels, and the optimiser state of the rows that rays have come to.

    Memory beside the field: a lattice corner costs 4 bytes and 6 more a thread, and 2 (C + 2) bytes once a gradient has come to it.
    """

    def __init__(self, field: Field, pool: PixelPool, seed: int = 0, threads: int | None = None) -> None:
        self.pool, self.threads = pool, threads or torch.get_num_threads()
        self.generator = np.random.default_rng(seed)
        self.pixels = kernels.pixels_of(pool)
        self.met = Tiles(len(pool.pose), tile_grid(pool))
        self.next: Batch | None = None
        self._take_decoder(field)
        self.blind = blind(field.decoder).numpy()
        self.moments = [(np.zeros_like(weight), np.zeros_like(weight)) for weight in self._weights()]
        # As rows of numbers, for what treats all of them alike in one call.
        self.weights = _rows(self._weights())
        self.first, self.second = (_rows(moment) for moment in zip(*self.moments, strict=True))
        self.weight_sums = [_rows(self._weight_gradients(thread)) for thread in range(self.threads)]
        self.weight_total = tuple(np.empty_like(weight) for weight in self.weights)
        self.decoder_steps = 0
        steps = np.arange(1, 2049)
        self.scales = np.concatenate([[1], np.sqrt(1 - BETAS[1] ** steps)]).astype(np.float32)
        self.executor = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self.barrier = threading.Barrier(self.threads)
        self.renew_rows(field)

    def renew_rows(self, field: Field) -> None:
        """Go on with another field of the same decoder: the rows' state starts afresh, the decoder's is kept."""
        self.field = field
        rows, channels = len(field.density_rows), field.feature_rows.shape[1]
        self.index = np.full((rows, self.threads + 1), -1, np.int32)
        self.bases = np.zeros(self.threads, np.int64)
        # Sized for the worst case; the system gives memory only to the part that is written.
        self.records = K.aligned((rows * self.threads, moves.FEATURE + channels), np.uint16, zeroed=True)
        self.given, self.used = [0] * self.threads, [0] * self.threads
        self.touched = memory.unwritten((self.threads, rows), np.int32)
        self.density_sums = memory.unwritten((self.threads, rows), np.float32)
        self.feature_sums = K.aligned((self.threads, rows, channels), np.float32)
        self.marks = np.zeros((self.threads, len(field.occupied)), np.uint16)
        self.go_on_with(field)

    def let_go(self) -> None:
        """Free what belongs to the rows, before finer ones are made beside them; `renew_rows` must follow."""
        self.index = self.touched = np.empty((0, 0), np.int32)
        self.density_sums = np.empty((0, 0), np.float32)
        self.records = np.empty((0, 0), np.uint16)
        self.feature_sums = np.empty((0, 0, 0), np.float32)
        self.marks = np.empty((0, 0), np.uint16)

    def go_on_with(self, field: Field) -> None:
        """Go on with the same rows after pruning; what was seen counts half from now on, so that it is forgotten within a few prunings."""
        self.field = field
        self.space, self.volume = make_space(field), make_volume(field)
        self.background = field.background.numpy().astype(np.float32)
        moves.fade(self.marks)

    @property
    def seen(self) -> torch.Tensor:
        """(M · 512,) largest weight that each voxel was seen with."""
        out = np.empty(self.marks.shape[1], np.float32)
        for part in _parts(len(out)):
            np.divide(self.marks[:, part].max(0) >> 4, 4095, out=out[part])
        return torch.from_numpy(out)

    @property
    def visits(self) -> torch.Tensor:
        """(M · 512,) how often samples fell into each voxel (saturating at 15 a thread)."""
        out = np.empty(self.marks.shape[1], np.int16)
        for part in _parts(len(out)):
            (self.marks[:, part] & 15).sum(0, dtype=np.int16, out=out[part])
        return torch.from_numpy(out)

    @property
    def next_record(self) -> int:
        """Rows that a gradient has come to so far."""
        return sum(self.given)

    def sync(self) -> Field:
        """The field with the decoder's weights written back."""
        assert isinstance(self.field.decoder, Deferred)
        train_decoder.write_layers(self.layers, self.field.decoder)
        return self.field

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:
        """One step on `rays` random pixels. Returns the mean squared colour error and the number of samples that were looked up.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing was moved.
        """
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
        """Random pixels, more of those where the field was wrong lately (`importance`)."""
        self.met.renew()
        jitter, seed = self.generator.random(rays, np.float32), int(self.generator.integers(2**62))
        return Batch(np.empty(rays, np.int64), jitter, np.empty(rays, np.float32), self.threads, self.pool.limit, seed)

    def _step(self, batch: Batch, following: Batch | None, rates: Rates) -> tuple[float, int]:
        """One step on `batch`; the order of the `following` one is found beside it."""
        rays = len(batch.picks)
        if not batch.sorted:
            for thread in range(self.threads):
                batch.look(thread, self.space, self.pixels, self.met)
            batch.sort(self.met)
        picks, jitter = batch.picks, batch.jitter
        weights = (rates.distortion, rates.opacity, rates.depth, rates.depth_noise, rates.colour_threshold, STOP, rates.slow_within)
        losses = kernels.Losses(*(np.float32(weight) for weight in weights))
        shares, met = batch.weights / np.float32(rays), np.empty((rays, 3), np.float32)

        def gradients(thread: int) -> tuple[int, float, int, str | None]:
            part = batch.part(thread)
            self._forget(thread)
            self.used[thread], error, looked = self._gradients(thread, part, picks, jitter, shares, losses, met)
            if following is not None:
                following.look(thread, self.space, self.pixels, self.met)
            return self.used[thread], error, looked, self._broken(thread, error)

        results: list[Any] = [None] * self.threads
        step_sizes = np.array([rates.density, rates.feature], np.float32)

        def move(thread: int) -> None:
            state = (self.space.width, self.volume, self.index, self.bases, self.records)
            sums = (self.touched, self.density_sums, self.feature_sums)
            state_of_thread = (thread, self.used[thread], self.given[thread])
            self.given[thread] = moves.adam_pass(*state, *sums, *state_of_thread, self.scales, step_sizes, *_CONSTANTS[1:])
            if thread == self.threads - 1:
                self._move_decoder(rates.decoder)
            if thread == 0:
                self.met.remember(batch.tiles, met)
                if following is not None:
                    following.sort(self.met)

        def work(thread: int) -> None:
            results[thread] = gradients(thread)
            self._wait()
            if not any(result[3] for result in results):
                move(thread)

        self._each(work)
        refuse(result[3] for result in results)
        return sum(result[1] for result in results), sum(result[2] for result in results)

    def _forget(self, thread: int) -> None:
        """What `thread` touched in the batch before is touched no more."""
        self.bases[thread] += self.used[thread]
        if self.bases[thread] > np.iinfo(np.int32).max - len(self.index):  # the next batch might not fit into 32 bits
            self.index[:, thread + 1] = -1
            self.bases[thread] = 0

    def colours(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """(B, 3) colours that the field has now."""
        out = np.empty((len(origins), 5), np.float32)
        limits = (np.float32(STOP), np.float32(THRESHOLD))
        given = (self.space, self.volume, self.layers, rays_of(self.layers), self.background)
        render_pass(*given, origins.contiguous().numpy(), directions.contiguous().numpy(), *limits, out)
        return torch.from_numpy(out[:, :3])

    def _broken(self, thread: int, error: float) -> str | None:
        """What is not finite of what `thread` found; all at once first, because that takes a tenth of the time."""
        density, feature = (sums[thread, : self.used[thread]] for sums in (self.density_sums, self.feature_sums))
        weights, gradients = self.weights, self.weight_sums[thread]
        if math.isfinite(error + moves.magnitude((density, feature.reshape(-1), *weights, *gradients))):
            return None
        decoder = [("a weight of the decoder", weight) for weight in weights]
        decoder += [("the gradient of the decoder", gradient) for gradient in gradients]
        return broken(error, [("the gradient of the densities", density), ("the gradient of the features", feature), *decoder])

    def _each(self, work: Callable[[int], None]) -> None:
        """`work(thread)` of all threads, the first of them here; they may `_wait` for each other."""
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
        failed += [told for other in others if (told := other.exception()) is not None]  # all are done now
        for cause in sorted(failed, key=lambda one: isinstance(one, threading.BrokenBarrierError)):
            raise cause

    def _wait(self) -> None:
        """Until all threads are here."""
        if self.executor is not None:
            self.barrier.wait()

    def _take_decoder(self, field: Field) -> None:
        """Copy the decoder's weights."""
        assert isinstance(field.decoder, Deferred)
        self.layers, channels = layers_of(decoder_arrays(field.decoder)), field.decoder.channels
        self.turned = train_decoder.turned(self.layers, channels)
        tapes = [train_decoder.make_tape(self.layers, channels) for _ in range(self.threads)]
        self.blocks = [train_rays.make_block(tape, field.feature_rows.shape[1]) for tape in tapes]

    def _weights(self) -> tuple[Array, ...]:
        """What Adam moves of the decoder."""
        return tuple(self.layers)

    def _of_direction(self) -> Array:
        """(16, hidden) weights that take the direction of view."""
        return self.layers.w1[self.field.decoder.channels :][: DIRECTION]

    def _gradients(
        self, thread: int, part: slice, picks: Array, jitter: Array, shares: Array, losses: kernels.Losses, met: Array
    ) -> tuple[int, float, int]:
        """The part of a batch that is `thread`'s → rows touched, its part of the mean squared error, samples looked up."""
        sums = kernels.Gradients(self.touched[thread], self.density_sums[thread], self.feature_sums[thread])
        arguments = (self.pixels, picks[part], jitter[part], shares[part], losses, self.marks[thread], self.index, self.bases, thread)
        given = (self.space, self.volume, self.layers, self.turned, self.background)
        out: tuple[int, float, int] = train_rays.gradient_pass(*given, *arguments, sums, self.blocks[thread], met[part])
        return out

    def _weight_gradients(self, thread: int) -> tuple[Array, ...]:
        """In the order of `_weights`, of the part of the last batch that was `thread`'s."""
        return tuple(self.blocks[thread].tape.total)

    def _turn_decoder(self) -> None:
        """Renew what is kept of the weights a second time."""
        train_decoder.turn(self.layers, self.turned)

    def _move_decoder(self, rate: float) -> None:
        """Adam on the decoder, with the sum of the threads' gradients."""
        self.decoder_steps += 1
        n = self.decoder_steps
        scale = np.float32(rate * np.sqrt(1 - BETAS[1] ** n) / (1 - BETAS[0] ** n))
        total, *others = self.weight_sums
        for own in others:
            moves.add_dense(total, own, self.weight_total)
            total = self.weight_total
        moves.adam_dense(self.weights, total, self.first, self.second, scale, *_CONSTANTS)
        if self.blind.any():
            self._of_direction()[self.blind] = 0
        self._turn_decoder()


def _rows(arrays: Iterable[Array]) -> tuple[Array, ...]:
    """Each array as a row of numbers in the same memory."""
    return tuple(array.reshape(-1) for array in arrays)
