"""The engine of a fit on CUDA: a step is some thirty launches whose shapes are known beforehand, recorded once and replayed.

What `torch_engine` does with flat lists of samples is done here ray by ray (`backends/triton/march.py` and `train_*.py` beside it);
the decoder's layers are products of matrices. Nothing waits for the GPU but a look at every `LOOK`-th step for what was not finite: such
a step moves nothing.
"""

from __future__ import annotations

import math

import torch
import triton

from fieldfuse.backends.constants import RENEW
from fieldfuse.backends.dispatch import OTHERS_GO_ON
from fieldfuse.backends.triton.march import BEHIND, COUNTS, JITTER, NOTES, RED, TARGET
from fieldfuse.backends.triton.train_adam import RATES, count_step, learn, move, rates_of
from fieldfuse.backends.triton.train_draw import draw
from fieldfuse.backends.triton.train_gradients import inspect, judge, spread
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.encoding import DIRECTION, spherical_harmonics
from fieldfuse.render.field import Field
from fieldfuse.render.march import BRICK
from fieldfuse.render.triton_renderer import Tables, TritonRenderer, buffers_for, launch_composite, launch_walk
from fieldfuse.training.losses import Rates
from fieldfuse.training.nonfinite_policy import NotFiniteError
from fieldfuse.training.pixels import Batch, PixelPool, densities, tile_grid
from fieldfuse.training.start import unseen_harmonics

Tensor = torch.Tensor
SLOTS = 128  # samples of a ray that can get a gradient; lattices so fine that more exceed the threshold come when space is thin no more
LOOK = 16  # steps from one look at what was not finite to the next, after the first, which are all looked at; launches run ahead so far
DECAY, EPSILON = 0.99, 1e-10  # of both optimisers, as in `LazyAdam`; the decoder's first moment:
FIRST = 0.9
ROWS = {"cuda": 64, "cpu": 4096}  # of a program of `move`; Triton's interpreter, which tests use on the CPU, likes few programs


class DecoderState:
    """A decoder's parameters in one row of numbers, with their gradient and Adam's moments."""

    def __init__(self, decoder: Deferred) -> None:
        weights: list[Tensor] = [values for layer in decoder.layers for values in (layer.weight, layer.bias)]
        self.values = torch.cat([p.detach().reshape(-1) for p in weights])
        self.gradient, self.first, self.second = (torch.zeros_like(self.values) for _ in range(3))
        kept = [torch.ones_like(p.detach()) for p in weights]
        kept[0][:, -DIRECTION:][:, unseen_harmonics(decoder)] = 0.0
        self.kept = torch.cat([p.reshape(-1) for p in kept])
        self.parts: list[Tensor] = []
        self.gradients: list[Tensor] = []
        start = 0
        for p in weights:
            own = slice(start, start + p.numel())
            p.data = self.values[own].view_as(p)
            self.parts.append(p.data)
            self.gradients.append(self.gradient[own].view_as(p))
            start += p.numel()


class TritonEngine:
    """A field under optimisation on CUDA; see `engine.Engine`."""

    EAGER = 2  # steps of a new shape before it is recorded: kernels are compiled and libraries made ready

    def __init__(self, field: Field, pool: PixelPool, seed: int = 0, record: bool = True) -> None:
        assert isinstance(field.decoder, Deferred)
        self.pool, self.seed, self.device = pool, seed, field.device
        self.record = record and field.device.type == "cuda"
        self.decoder = DecoderState(field.decoder)
        self.high, self.wide = tile_grid(pool)
        self.tile_error = torch.zeros(len(pool.pose) * self.high * self.wide, device=self.device)
        self.tile_density = torch.ones_like(self.tile_error)
        self.state = torch.zeros(2, dtype=torch.int64, device=self.device)  # steps, good steps
        self.bad, self.failed = (torch.zeros(1, dtype=torch.int32, device=self.device) for _ in range(2))
        self.limit = torch.zeros(1, dtype=torch.int64, device=self.device)
        self.total = torch.zeros(1, device=self.device)
        self.rates = torch.zeros(RATES, device=self.device)
        self._staged = [torch.zeros(RATES, pin_memory=self.device.type == "cuda") for _ in range(2 * LOOK)]
        self._seen_bad, self._limit, self.steps = 0, -1, 0
        self.renew_rows(field)

    def renew_rows(self, field: Field) -> None:
        self.field, self.tables = field, Tables(field)
        rows, channels, device = len(field.density_rows), field.feature_rows.shape[1], self.device
        self.g_density, self.second_density, self.touch_steps = (torch.zeros(rows, device=device) for _ in range(3))
        self.g_feature, self.second_feature = (torch.zeros(rows, channels, device=device) for _ in range(2))
        self.touched = torch.zeros(rows, dtype=torch.uint8, device=device)
        self.seen, self.visits = (torch.zeros(len(field.occupied), device=device) for _ in range(2))
        self._shape, self._made = 0, 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def release(self) -> None:
        self._graph, nothing = None, torch.zeros(0, device=self.device)
        self.g_density = self.second_density = self.touch_steps = self.g_feature = self.second_feature = nothing
        self.touched = self.seen = self.visits = nothing
        del self.tables

    def go_on_with(self, field: Field) -> None:
        self.field = field
        self.tables.renew(field)
        self.seen.mul_(0.5)
        self.visits.mul_(0.5)

    def colours(self, origins: Tensor, directions: Tensor) -> Tensor:
        return TritonRenderer(self.field, len(origins), self.tables)(origins, directions).colour

    def sync(self) -> Field:
        return self.field

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:
        """One step on `rays` random pixels. The mean squared error is that of the last look; samples are not counted (0).

        Raises:
            NotFiniteError: one of the last steps was not finite, and moved nothing.
        """
        if self.steps % RENEW == 0:
            self.tile_density.copy_(densities(self.tile_error))
        if self._limit != self.pool.limit:
            self._limit = self.pool.limit
            self.limit.fill_(self._limit)
        self._stage(rates)
        self._room_for(rays)
        if self._graph is not None:
            self._graph.replay()
        elif self.record and self._made >= self.EAGER:
            self._capture(rays)
        else:
            self._draw(rays)
            self._learn(rays, remember=True)
            self._made += 1
        self.steps += 1
        return (self._look() if self.steps <= LOOK or self.steps % LOOK == 0 else math.nan), 0

    def step_on(self, batch: Batch, rates: Rates, jitter: Tensor) -> float:
        """One step on rays that are given, with jitter (B,), → their mean squared error."""
        count = len(batch.origins)
        self._stage(rates)
        self._room_for(count)
        rays = self.buffers[0]
        rays[:3], rays[3:RED], rays[RED:COUNTS] = batch.origins.T, batch.directions.T, batch.colour.T
        rays[COUNTS] = (1.0 if batch.weight is None else batch.weight) / count
        rays[TARGET] = 0.0 if batch.distance is None else batch.distance
        rays[JITTER] = jitter
        rays[BEHIND:] = self.field.background[:, None]
        self.inputs[:, self.field.feature_rows.shape[1] :] = spherical_harmonics(batch.directions)
        self._learn(count, remember=False)
        return self._look()

    def _room_for(self, rays: int) -> None:
        """Buffers for steps of so many rays."""
        if rays == self._shape:
            return
        channels, device = self.field.feature_rows.shape[1], self.device
        self._shape, self._made, self._graph = rays, 0, None
        self.buffers = buffers_for(rays, NOTES, SLOTS, device)
        self.tiles = torch.zeros(rays, dtype=torch.int32, device=device)
        self.inputs = torch.zeros(rays, channels + DIRECTION, device=device)
        self.g_logits = torch.zeros(rays, 3, device=device)

    def _stage(self, rates: Rates) -> None:
        """The step sizes, to where the kernels read them."""
        staged = self._staged[self.steps % len(self._staged)]
        for place, value in enumerate(rates_of(rates)):
            staged[place] = value
        self.threshold = rates.colour_threshold
        self.rates.copy_(staged, non_blocking=True)

    def _capture(self, rays: int) -> None:
        """Record a step, and take it."""
        graph = torch.cuda.CUDAGraph()
        torch.cuda.synchronize()
        with torch.cuda.graph(graph, capture_error_mode=OTHERS_GO_ON):
            self._draw(rays)
            self._learn(rays, remember=True)
        self._graph = graph
        graph.replay()

    def _draw(self, rays: int) -> None:
        pool = self.pool
        draw[(triton.cdiv(rays, 128),)](
            *(self.buffers[0], self.tiles, self.inputs, self.state),
            *(pool.colour, pool.places, pool.starts, pool.distance, pool.camera, pool.pose, self.tile_density, self.field.background),
            *(self.limit, rays, rays, self.inputs.shape[1], self.field.feature_rows.shape[1], len(pool.pose)),
            *(self.high, self.wide, self.seed * 1_000_003 % 2**31),
            SOME=len(pool.places) > 0,
            KNOWN=len(pool.distance) > 0,
            B=128,
        )

    @torch.no_grad()
    def _learn(self, rays: int, remember: bool) -> None:
        """Everything after the draw."""
        self._differentiate(rays, remember)
        self._move()

    def _differentiate(self, rays: int, remember: bool) -> None:
        """Gradients of rows and decoder, and what was not finite of them."""
        field, buffers, channels = self.field, self.buffers, self.field.feature_rows.shape[1]
        around, cells, notes, counts, sums = buffers
        launch_walk(field, self.tables, buffers, (self.seen, self.visits), rays, self.threshold, SLOTS)
        launch_composite(field, self.tables, buffers, self.inputs, rays, SLOTS)
        w1, b1, w2, b2, w3, b3 = self.decoder.parts
        g1, h1, g2, h2, g3, h3 = self.decoder.gradients
        one = torch.addmm(b1, self.inputs, w1.T).relu_()
        two = torch.addmm(b2, one, w2.T).relu_()
        logits = torch.addmm(b3, two, w3.T).add_(self.inputs[:, :3])
        self.total.zero_()
        judge[(triton.cdiv(rays, 128),)](
            *(around, sums, logits, self.g_logits, self.tiles, self.tile_error, self.total, self.rates, rays, rays),
            REMEMBER=remember,
            B=128,
        )
        torch.mm(self.g_logits.T, two, out=g3)
        torch.sum(self.g_logits, 0, out=h3)
        behind = torch.ops.aten.threshold_backward(self.g_logits @ w3, two, 0)
        torch.mm(behind.T, one, out=g2)
        torch.sum(behind, 0, out=h2)
        behind = torch.ops.aten.threshold_backward(behind @ w2, one, 0)
        torch.mm(behind.T, self.inputs, out=g1)
        torch.sum(behind, 0, out=h1)
        g_inputs = behind @ w1[:, :channels]
        spread[(triton.cdiv(rays, 32),)](
            *(around, cells, notes, counts, sums, self.inputs, g_inputs, self.g_logits, field.feature_rows, self.tables.lookup),
            *(self.g_density, self.g_feature, self.touched, self.bad, self.rates),
            *(rays, rays, self.inputs.shape[1], field.topology.zero_row, BRICK / (field.fine * field.resolution)),
            C=channels,
            P=triton.next_power_of_2(channels),
            SLOTS=SLOTS,
            B=32,
            num_warps=1,
        )
        inspect[(1,)](self.decoder.gradient, self.total, self.bad, len(self.decoder.gradient), B=1024)

    def _move(self) -> None:
        """Both optimisers' steps, unless something was not finite."""
        field, channels, rows = self.field, self.field.feature_rows.shape[1], self.field.topology.zero_row
        many = ROWS[self.device.type]
        move[(triton.cdiv(max(rows, 1), many),)](
            *(field.density_rows, field.feature_rows, self.g_density, self.g_feature, self.second_density, self.second_feature),
            *(self.touch_steps, self.touched, self.bad, self.rates, rows, math.log2(DECAY), DECAY, EPSILON),
            C=channels,
            P=triton.next_power_of_2(channels),
            B=many,
        )
        state = self.decoder
        learn[(triton.cdiv(len(state.values), 256),)](
            *(state.values, state.gradient, state.first, state.second, state.kept, self.state, self.bad, self.rates),
            *(len(state.values), math.log2(FIRST), math.log2(DECAY), EPSILON),
            B=256,
        )
        count_step[(1,)](self.state, self.bad, self.failed)

    def _look(self) -> float:
        """The last step's mean squared error.

        Raises:
            NotFiniteError: a step since the last look was not finite.
        """
        failed, error = int(self.failed), float(self.total)
        if failed > self._seen_bad:
            self._seen_bad = failed
            self.seen.nan_to_num_(0.0)
            raise NotFiniteError("the colour error or a gradient is not finite")
        return error
