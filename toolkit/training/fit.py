"""Per-scene optimisation of a sparse voxel field, coarse to fine, within a budget of seconds.

Levels double the lattice; before each step to a finer one, and now and then between, voxels that no training ray saw are removed.
Held-out views are looked at for one purpose: the timeline of their PSNR, whose seconds are not counted and which steers nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from dataclasses import field as default
from typing import Protocol

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.memory import give_back
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.stereo.transients import LeftOut
from fieldfuse.tone import decode, encode
from fieldfuse.training import memory_limits
from fieldfuse.training.background_sh import sky_behind
from fieldfuse.training.engine import Engine, chosen_engine, fit_device, make_engine, warm_up
from fieldfuse.training.levels import NewField, all_places, finer, looked_at, pruned, release_unused, visible
from fieldfuse.training.losses import FINE, ROUGH
from fieldfuse.training.nonfinite_policy import NonfinitePolicy, NotFiniteError, refuse_broken
from fieldfuse.training.pixels import Batch, PixelPool
from fieldfuse.training.schedule import RUNGS, UNTOLD, WIDER, Schedule, most_rays
from fieldfuse.training.start import NEAR, THIN, colour_behind, finest_resolution, levels, new_decoder, possible, space_of
from fieldfuse.volume.host import Host, TorchHost
from fieldfuse.volume.space import Space

DEFAULT_BUDGET = 120.0
TIMELINE_POINTS = 12
TIMELINE_PIXELS = 8192
VALIDATION_PIXELS = 2048
VALIDATION_SHARE = 20  # every n-th training view steers the schedule …
LEAST_VIEWS = 24  # … when there are enough: with few views each of them is worth more than what it would decide
MANY_ROWS = 2**19  # from here on memory of rows that pruning left unused is given back
MANY_VOXELS = 2_000_000  # beyond this a finer level is made only where rays came
HOLD = 0.4  # share of a fit before which cells do not go on from it: their decoder is the one it has then


@dataclass
class FitResult:
    """The fitted field in memory of its own, and how it came to be."""

    field: Field
    timeline: list[dict[str, float]] = default(default_factory=list)  # fitting seconds, held-out PSNR over a fixed sample of pixels
    seconds: float = 0.0
    steps: int = 0
    rays: int = 0
    interrupted: bool = False
    notes: list[str] = default(default_factory=list)  # a sentence on each step that was not finite, and on what it had to do without
    matched: dict[str, float] | None = None  # what was matched before the fit: images, pixels, share with depth, seconds (`guided.py`)
    left_out: LeftOut | None = None  # what the fit did without, since it moves (`guided.py`)
    held_out: list[float] = default(default_factory=list)  # the timeline's last PSNR by held-out view
    views: Views | None = None  # that it was fitted to: with the depth that was matched, without what moves
    done: float = 1.0  # share of the whole fit that this is; less than 1: it ended at `Begin.until`

    def after(self, seconds: float) -> list[dict[str, float]]:
        """The timeline, with so many seconds before it."""
        return [{**point, "seconds": round(seconds + point["seconds"], 3)} for point in self.timeline]


class Clock:
    """Fitting seconds; stands still while something else is measured."""

    def __init__(self, ticks: Callable[[], float]) -> None:
        self.ticks = ticks
        self._spent, self._since = 0.0, ticks()

    def seconds(self) -> float:
        return self._spent + self.ticks() - self._since

    def pause(self) -> None:
        self._spent = self.seconds()

    def go_on(self) -> None:
        self._since = self.ticks()


@dataclass(frozen=True)
class Begin:
    """What a fit begins with besides its views.

    Attributes:
        host: where rows live while they change (`GridHost` puts them into Open3D's hash map); None: plain tensors.
        start: a field to go on from, at its finest level, or what gives it; then no reference to it is held while its levels are climbed.
        coarse: `start` is a first guess and no fitted field: climb from its level to the finest, as from the classical start.
        rungs: share of the budget at which each level ends at the latest, from the first one on; with too few views to keep some aside for
            validation it ends by `UNTOLD`, if that is sooner. None: as fits the start.
        until: voxels a side of a finer level that cells will fit (`training/cells`): where it would begin, the fit ends. Where seconds are
            too few for that level, the fit goes on to its end on the one before.
    """

    host: Host | None = None
    start: Field | Callable[[], Field] | None = None
    coarse: bool = False
    rungs: tuple[float, ...] | None = None
    until: int | None = None


class Shows(Protocol):
    """What gives colours for rays: an engine, or a finished field."""

    def colours(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor: ...


class Sample:
    """PSNR over a fixed random sample of some views' pixels: the mean over views, in the colours of their photos, as the report's table
    counts it."""

    def __init__(self, views: Views, indices: Array, pixels: int, device: torch.device) -> None:
        self.batch: Batch | None = None
        self.factor: Array | None = None  # (P, 3) what was taken out of the pixels' light; None: nothing
        if len(indices):
            some = views.subset(indices)
            pool = PixelPool(replace(some, images=[some.photo(index) for index in range(len(some))]), device)
            pick = torch.randperm(len(pool), generator=torch.Generator().manual_seed(0))[:pixels].to(device)
            self.batch, self.factor = pool.take(pick), _factors(some, *(place.cpu().numpy() for place in pool.seen_at(pick)))

    def psnr(self, engine: Shows) -> float | None:
        """Decibels, the mean over views; None: there are none."""
        each = self.each(engine)
        return float(each.mean()) if len(each) else None

    def each(self, engine: Shows) -> Array:
        """(V,) decibels of each view that has pixels in the sample."""
        if self.batch is None:
            return np.zeros(0)
        shown = engine.colours(self.batch.origins, self.batch.directions)
        if self.factor is not None:  # what was taken out of their images is put back
            shown = torch.from_numpy(encode(decode(shown.detach().cpu().numpy().astype(np.float64)) * self.factor)).to(shown)
        error = (shown - self.batch.colour).square().mean(-1)
        views, pixels = self.batch.view.unique(return_inverse=True, return_counts=True)[1:]
        of_views = torch.zeros(len(pixels), device=error.device).index_add(0, views, error) / pixels
        return np.asarray((-10 * of_views.clamp_min(1e-10).log10()).cpu().numpy())


def _factors(views: Views, view: Array, row: Array, column: Array) -> Array | None:
    """(P, 3) what was taken out of the light of pixels, so that their images are not as they were taken; None: nothing."""
    if all(photo is None for photo in views.photos):
        return None
    out = np.ones((len(view), 3))
    for index, (tone, photo) in enumerate(zip(views.tones, views.photos, strict=True)):
        mine = view == index
        if tone is not None and photo is not None:
            out[mine] = np.broadcast_to(tone.factor(views.intrinsics[index]), photo.shape)[row[mine], column[mine]]
    return out


def fit_field(
    views: Views,
    scene: Scene,
    settings: Settings,
    progress: Progress = SILENT,
    begin: Begin = Begin(),
    ticks: Callable[[], float] = time.perf_counter,
) -> FitResult:
    """Fit a field to the training views.

    Args:
        views: all views; those marked `test` are only measured.
        scene: region of interest, near and far, and whether there is a background, in the same working frame.
        settings: `field`, `fit`, `seed`; `fit.budget` bounds the seconds.
        progress: `stopping()` ends the fit early and keeps what there is.
        ticks: the clock, in seconds, that the budget is counted on; a benchmark beside other work takes `time.process_time`.

    Raises:
        InputError: there is no training view or pixel, the start is not finite or holds nothing, not one step was finite, or there is no
            memory for it.
    """
    device = fit_device(settings)
    train = views.subset(np.flatnonzero(~views.test))
    if len(train) == 0:
        raise InputError("no training view is left; lower --holdout or give more images")
    host = begin.host or TorchHost(device)
    start = begin.start() if callable(begin.start) else begin.start
    torch.manual_seed(settings.seed)
    held_out = Sample(views, np.flatnonzero(views.test), TIMELINE_PIXELS, device)
    aside = np.arange(len(train)) % VALIDATION_SHARE == VALIDATION_SHARE // 2 if len(train) >= LEAST_VIEWS else np.zeros(len(train), bool)
    validation = Sample(train, np.flatnonzero(aside), VALIDATION_PIXELS, device)
    memory_limits.require_start(train, start, settings, device)
    # Views that are kept aside come last, so that joining them is a matter of a limit.
    ordered = train.subset(np.argsort(aside, kind="stable"))
    pool = PixelPool(ordered, device, depth=settings.fit.depth > 0)
    pool.limit = int(pool.starts[np.count_nonzero(~aside)])
    if pool.limit == 0:
        raise InputError("every pixel of the training images is masked away; look at the capture's masks (black is left out)")
    budget = settings.fit.budget or DEFAULT_BUDGET
    warm_up(settings, progress)
    clock = Clock(ticks)
    if start is None:
        current, ladder = _first(views, scene, settings, device, host)
    else:
        refuse_broken(start)
        keep = torch.ones_like(start.occupied)
        current, ladder = finer(start, keep, start.resolution, host), [start.resolution]
        if begin.coarse:
            ladder += [resolution for resolution in _ladder(views, scene, settings)[1] if resolution > start.resolution]
    start = None  # its rows are the host's now
    if begin.until is not None and begin.until > ladder[-1]:
        ladder.append(begin.until)
    engine = make_engine(settings, current, pool)
    rungs = begin.rungs or RUNGS
    plan = Schedule(
        ladder,
        budget,
        settings.fit,
        opaque=views.background is None,
        patient=settings.fit.patience,
        most_rays=most_rays(len(pool), bool(aside.any()), settings.fit.passes),
        slow_within=settings.fit.slow_within * scene.median_depth,
        trust=ROUGH if views.rough else FINE,
        rungs=rungs if aside.any() else tuple(map(min, rungs, UNTOLD)),
        wider=WIDER if chosen_engine(settings, device) == "triton" else 1,
        hold=0.0 if begin.until is None else HOLD,
    )
    softens, radius = len(train) >= LEAST_VIEWS, 0.0
    policy = NonfinitePolicy()
    result = FitResult(current, notes=policy.notes)
    marks = [budget * 0.02 * 50 ** (i / (TIMELINE_POINTS - 1)) for i in range(TIMELINE_POINTS - 1)]

    while (done := plan.position(now := clock.seconds(), result.rays)) < 1 and not progress.stopping():
        if plan.wants_finer(done):
            keep = visible(current, engine.seen, engine.visits, settings.fit.prune_weight)
            growth = (ladder[plan.level + 1] / current.resolution) ** 3
            voxels = int(keep.sum()) * growth
            if voxels > MANY_VOXELS:  # memory is bounded
                came = keep & (engine.visits > 0)
                voxels = int(came.sum()) * growth  # what stays for the sake of holes gets no rays, so it does not decide
                near = looked_at(current, engine.seen, engine.visits, settings.fit.prune_weight)
                keep = keep & near if plan.level == len(ladder) - 2 else came
            # A level that cells fit need not stay small, nor fit into the memory of this machine.
            by_cells = ladder[plan.level + 1] == begin.until
            worth = plan.worth(voxels, plan.rays_left(now, result.rays), bounded=not by_cells)
            if worth and by_cells:
                result.done = done
                break
            if worth and memory_limits.fits(current, keep, plan, settings, policy.notes):
                plan.climb()
                engine.release()
                give_back()
                current = finer(current, keep, plan.resolution, host)
                engine.renew_rows(current)
        elif plan.wants_pruning(done):
            current = pruned(current, visible(current, engine.seen, engine.visits, settings.fit.prune_weight))
            if len(current.occupied) >= MANY_ROWS:
                release_unused(current)
                give_back()
            engine.go_on_with(current)
        if softens and plan.radius(done) != radius:
            radius = plan.radius(done)
            pool.soften(ordered, radius)
        if plan.decided(done):
            pool.limit = len(pool)
        elif plan.wants_look(done) and (psnr := validation.psnr(engine)) is not None:
            plan.look(psnr, done)
        rays = plan.rays
        try:
            engine.step(rays, policy.scaled_rates(plan.rates(done, result.rays)))
        except NotFiniteError as error:
            if policy.handle(error, result.steps, plan.resolution, now):
                continue
            break
        plan.steps += 1
        plan.steps_here += 1
        result.steps += 1
        result.rays += rays
        if marks and now > marks[0]:
            clock.pause()
            marks = [mark for mark in marks if mark > now]
            _measure(result, held_out, engine, now)
            clock.go_on()
        if result.steps % 5 == 0:
            note = f"{plan.resolution}³, {result.timeline[-1]['psnr']:.1f} dB" if result.timeline else f"{plan.resolution}³"
            progress.update(done * budget, budget, note)
    clock.pause()
    result.interrupted = progress.stopping()
    result.seconds = clock._spent
    _measure(result, held_out, engine, result.seconds)
    current = engine.sync()
    engine.release()
    del engine, pool
    give_back()
    packed = current.packed()
    del current  # its rows are the host's
    host.close()
    give_back()
    result.field, result.views = replace(packed(), sky=sky_behind(views)), views
    return result


def _first(views: Views, scene: Scene, settings: Settings, device: torch.device, host: Host) -> tuple[Field, list[int]]:
    """The classical start at the coarsest level, and the resolutions to climb."""
    space, ladder = _ladder(views, scene, settings)
    places = possible(space, ladder[0], all_places(space, ladder[0]), views)
    blank = NewField(space, ladder[0], new_decoder(settings.field).to(device), colour_behind(views).to(device), NEAR * scene.near)
    return blank.on(places, host, THIN, torch.Generator().manual_seed(settings.seed)), ladder


def _ladder(views: Views, scene: Scene, settings: Settings) -> tuple[Space, list[int]]:
    """The space, and its resolutions from coarse to fine."""
    space = space_of(views, scene, settings.field.background)
    train = views.subset(np.flatnonzero(~views.test))
    return space, levels(settings.field.resolution or finest_resolution(space, train, scene))


def _measure(result: FitResult, held_out: Sample, engine: Engine, seconds: float) -> None:
    each = held_out.each(engine)
    if len(each) and np.isfinite(each).all():
        result.held_out = [float(value) for value in each]
        result.timeline.append({"seconds": round(seconds, 3), "psnr": round(float(each.mean()), 4)})
