"""The fit of one cell: its region on finer and finer lattices, with everything else, and the decoder, as the coarse field has them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from fieldfuse.config import Settings
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.training.cells.partition import Cells, region_mask
from fieldfuse.training.levels import finer, pruned, visible
from fieldfuse.training.losses import Trust
from fieldfuse.training.nonfinite_policy import NonfinitePolicy, NotFiniteError
from fieldfuse.training.numba_engine import NumbaEngine
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.schedule import Schedule
from fieldfuse.volume.host import TorchHost

CLIMB = (0.5,)  # of a cell's seconds, at which it goes to the finest lattice: that of a fit in one piece has less than half, too
LEAST_BATCH = 512  # rays a step; else so many that a voxel gets as many of them as in a fit of the whole scene


@dataclass(frozen=True)
class CellPlan:
    """What the fit of a cell needs to know of the whole.

    Attributes:
        resolution: of its finest lattice, the coarse field's times a power of two.
        rays_before: that the coarse field was fitted with.
        share: of the scene's pixels that are the cell's: with so much fewer rays it comes as far.
        seconds, steps: of the whole fit, whichever are spent first; None: the other.
        begin, end: shares of these at which this part of it begins and ends: between parts, neighbours exchange what they have.
        slow_within: see `Schedule`.
        trust: see `Schedule`.
        opaque: every ray ends somewhere (captures without alpha).
        seed: of the cell's random numbers.
        threads: that fit it. The result is the same bit for bit for the same number of steps and threads.
    """

    resolution: int
    rays_before: int
    share: float
    seconds: float | None
    steps: int | None
    slow_within: float
    trust: Trust
    opaque: bool
    seed: int
    begin: float = 0.0
    end: float = 1.0
    threads: int = 1


@dataclass(frozen=True)
class FittedCell:
    """A cell's field with its halo, and how it came to be."""

    field: Field
    seconds: float
    steps: int
    rays: int
    interrupted: bool = False


def fit_cell(
    coarse: Field,
    cells: Cells,
    cell: int,
    pool: PixelPool,
    settings: Settings,
    plan: CellPlan,
    progress: Progress = SILENT,
    ticks: Callable[[], float] = time.perf_counter,
    start: Field | None = None,
) -> FittedCell:
    """Refine what cell `cell` owns, and a halo around that, on the pixels of `pool`.

    Args:
        start: the region on the finest lattice, to go on from; None: the coarse field's.
    """
    host, begin = TorchHost(), ticks()
    if start is None:
        ladder = [coarse.resolution * 2]
        while ladder[-1] < plan.resolution:
            ladder.append(ladder[-1] * 2)
        start = finer(coarse, region_mask(coarse, cells, cell, coarse.resolution, ladder[0]), ladder[0], host)
    else:
        ladder = [start.resolution]
    current = _surrounded(start, coarse, cells, cell)
    engine = NumbaEngine(current, pool, plan.seed, plan.threads)
    budget = plan.seconds or 1e9
    fit = replace(settings.fit, iterations=plan.steps)
    schedule = Schedule(ladder, budget, fit, plan.opaque, slow_within=plan.slow_within, trust=plan.trust, rungs=CLIMB)
    schedule.steps = 0 if plan.steps is None else round(plan.begin * plan.steps)
    ago = 0.0 if plan.seconds is None else plan.begin * plan.seconds
    policy = NonfinitePolicy()
    rays = steps = 0
    batch = max(LEAST_BATCH, round(settings.fit.max_rays * plan.share))
    while (done := schedule.position(ago + (now := ticks() - begin))) < plan.end and not progress.stopping():
        if not schedule.finest and done > schedule.deadline():  # however few steps that were: all cells come to the same lattice
            keep = visible(current, engine.seen, engine.visits, settings.fit.prune_weight)
            schedule.climb()
            keep &= region_mask(current, cells, cell, coarse.resolution, schedule.resolution)
            engine.release()
            current = _surrounded(finer(current, keep, schedule.resolution, host), coarse, cells, cell)
            engine.renew_rows(current)
        elif schedule.wants_pruning(done):
            current = pruned(current, visible(current, engine.seen, engine.visits, settings.fit.prune_weight))
            engine.go_on_with(current)
        whole = plan.rays_before + int(rays / max(plan.share, 1e-6))
        rates = replace(policy.scaled_rates(schedule.rates(done, whole)), decoder=0.0)
        try:
            engine.step(batch, rates)
        except NotFiniteError as error:
            if policy.handle(error, steps, schedule.resolution, now):
                continue
            break
        schedule.steps += 1
        schedule.steps_here += 1
        steps += 1
        rays += batch
        if steps % 20 == 0:
            progress.update(done, 1, f"cell {cell + 1} of {cells.count}, {schedule.resolution}³")
    if not schedule.finest:  # stopped, or broken, before that
        current = finer(current, torch.ones_like(current.occupied), plan.resolution, host)
    field = replace(current, outer=None).settled()
    return FittedCell(field, ticks() - begin, steps, rays, progress.stopping())


def _surrounded(field: Field, coarse: Field, cells: Cells, cell: int) -> Field:
    """The field of a cell with the coarse one around it, which has no voxel where the cell's region is."""
    rest = coarse.occupied & ~region_mask(coarse, cells, cell, coarse.resolution, field.resolution)
    return replace(field, outer=replace(coarse, occupied=torch.as_tensor(rest)))
