"""The fit of one cell: its region on the finest lattice, with everything else, and the decoder, as the coarse field has them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

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

# Times that cells' lattice is finer than the coarse field's. With 4 the coarse surfaces of neighbours, four voxels thick, hide so much that
# borders have 1.2 dB less (redkitchen), also where neighbours exchange what they have come to.
COARSER = 2
LEAST_BATCH = 512  # rays a step; else so many that a voxel gets as many of them as in a fit of the whole scene


@dataclass(frozen=True)
class CellPlan:
    """What the fit of a cell needs to know of the whole.

    Attributes:
        cell: which one.
        rays_before: that the coarse field was fitted with.
        done_before: share of the whole fit that the coarse field took.
        share: of the scene's pixels that are the cell's: with so much fewer rays it comes as far.
        seconds, steps: of the cell's fit, whichever are spent first; `steps` None: seconds alone.
        slow_within: see `Schedule`.
        trust: see `Schedule`.
        opaque: every ray ends somewhere (captures without alpha).
        seed: of the cell's random numbers.
    """

    cell: int
    rays_before: int
    done_before: float
    share: float
    seconds: float
    steps: int | None
    slow_within: float
    trust: Trust
    opaque: bool
    seed: int


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
    pool: PixelPool,
    settings: Settings,
    plan: CellPlan,
    progress: Progress = SILENT,
    ticks: Callable[[], float] = time.perf_counter,
) -> FittedCell:
    """Refine what a cell owns, and a halo around that, on the pixels of `pool`.

    One thread does it, so equal steps give the same bits wherever the cell is fitted.
    """
    begin, finest = ticks(), COARSER * coarse.resolution
    region = region_mask(coarse, cells, plan.cell, coarse.resolution, finest)
    rest = replace(coarse, occupied=coarse.occupied & ~region)  # whose place the region takes
    current = replace(finer(coarse, region, finest, TorchHost()), outer=rest)
    engine = NumbaEngine(current, pool, plan.seed, threads=1)
    fit = replace(settings.fit, iterations=plan.steps)
    batch = max(LEAST_BATCH, round(settings.fit.max_rays * plan.share))
    schedule = Schedule([finest], plan.seconds, fit, plan.opaque, slow_within=plan.slow_within, trust=plan.trust)
    policy = NonfinitePolicy()
    rays = steps = 0
    while (spent := schedule.position(now := ticks() - begin)) < 1 and not progress.stopping():
        # Of the whole fit, as step sizes fall in one piece; with steps by these alone, so that equal steps give the same bits.
        done = plan.done_before + (1 - plan.done_before) * (spent if plan.steps is None else schedule.position(0))
        if schedule.wants_pruning(done):
            current = pruned(current, visible(current, engine.seen, engine.visits, settings.fit.prune_weight))
            engine.go_on_with(current)
            schedule.prune_every *= 2  # it takes as long as many steps of so few rays, and first does most
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
            progress.update(spent, 1, f"{schedule.resolution}³")
    field = replace(current, outer=None).settled()
    return FittedCell(field, ticks() - begin, steps, rays, progress.stopping())

