"""A fit with known depth and without what moves: both are found in the first share of its budget.

Depth is the capture's own, or what quick matching of the images finds. With it, images can be held against each other, and the fit
begins with it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.memory import give_back
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo import fast_mvs, transients
from fieldfuse.stereo.transients import LeftOut
from fieldfuse.training import depth_start
from fieldfuse.training.engine import fit_device, warm_up
from fieldfuse.training.fit import DEFAULT_BUDGET, Begin, Clock, FitResult, fit_field
from fieldfuse.training.schedule import GUESSED, PARTLY, RUNGS


class Part(Progress):
    """The progress of a part of some work, from `low` to `high` of its `total` units."""

    def __init__(self, whole: Progress, low: float, high: float, total: float) -> None:
        self.whole, self.low, self.high, self.total = whole, low, high, total

    def update(self, done: float, total: float, note: str = "") -> None:
        self.whole.update(self.low + (self.high - self.low) * done / max(total, 1e-9), self.total, note)

    def stopping(self) -> bool:
        return self.whole.stopping()


def wants_matching(views: Views, settings: Settings) -> bool:
    """Whether a fit of these views begins with matching: no depth is known, and the settings leave it to us (`fit.depth_from=auto`).

    Not where alpha cuts an object out: silhouettes are enough there (lego 28.6 dB after 30 s without, 28.4 with matching).
    """
    known = any(depth is not None for depth in views.depths) or views.background is not None
    return settings.fit.depth_from == "auto" and settings.fit.depth > 0 and not known


def looks_for_moving(views: Views, settings: Settings) -> bool:
    """Whether pixels that show what moves are looked for: the settings do not forbid it, and alpha cuts nothing out."""
    return settings.fit.moving == "auto" and views.background is None


def fit_guided(
    views: Views,
    scene: Scene,
    settings: Settings,
    progress: Progress = SILENT,
    begin: Begin = Begin(),  # noqa: B008 (frozen)
    ticks: Callable[[], float] = time.perf_counter,
) -> FitResult:
    """`fit_field`, with quick matching before it where that is wanted, without what moves, and, unless `begin` has a start, from what is
    known of depth. The seconds of all three are a part of the budget, and of the timeline. A start that is a guess (`coarse`) is gone on
    from in steps of its own, unless `begin` has others.

    What cannot be matched is fitted to colours alone, with the reason in `notes`.

    Raises:
        Interrupted: the user asked to stop while images were matched.
        InputError: as `fit_field`.
    """
    if begin.coarse and begin.rungs is None:
        begin = replace(begin, rungs=GUESSED)
    matching = wants_matching(views, settings)
    if not (matching or looks_for_moving(views, settings) or depth_start.starts_by_depth(views, settings)):
        return fit_field(views, scene, settings, progress, begin, ticks)
    warm_up(settings, progress)
    fast_mvs.warm_up()
    depth_start.warm_up()
    budget, clock = settings.fit.budget or DEFAULT_BUDGET, Clock(ticks)
    notes: list[str] = []
    known, matched, matched_for = views, None, 0.0
    if matching:
        try:
            part = Part(progress, 0.0, fast_mvs.SHARE * budget, budget)
            known, matched = fast_mvs.guided(views, scene.near, scene.far, scene.median_depth, budget, part)
        except InputError as error:
            notes.append(f"the field was fitted to colours alone: {error}")
        matched_for = clock.seconds()
    left_out = None
    if looks_for_moving(views, settings):
        with contextlib.suppress(Interrupted):  # the fit ends at once as well then, and keeps what there is
            left_out = find_moving(known, matched, scene, budget, progress)
    left_out = None if left_out is None else replace(left_out, seconds=clock.seconds() - matched_for)
    shown = known if left_out is None else left_out.without(known)
    if begin.start is None and depth_start.starts_by_depth(shown, settings):
        first = depth_start.depth_start(shown, scene, settings, fit_device(settings))
        rungs = RUNGS if first.resolution == depth_start.RESOLUTION_KNOWN else PARTLY
        begin = replace(begin, start=[first].pop, coarse=True, rungs=rungs)  # once it is taken no reference is left here
        del first
    give_back()  # what images, costs and votes took
    spent = clock.seconds()
    rest = replace(settings, fit=replace(settings.fit, budget=max(budget - spent, 0.5 * budget)))
    result = fit_field(shown, scene, rest, Part(progress, spent, budget, budget), begin, ticks)
    result.timeline = result.after(spent)
    result.seconds += spent
    result.notes = notes + result.notes
    result.matched = None if matched is None else {**matched.to_dict(), "seconds": round(matched_for, 2)}
    result.left_out = left_out
    return result


def find_moving(
    views: Views, matched: fast_mvs.Matched | None, scene: Scene, budget: float, progress: Progress = SILENT
) -> LeftOut | None:
    """What moves in the training images of `views`, by the depth that was `matched`, or by their own; None: no depth is known, by
    matching of too few images, or they are too many for a fit of `budget` seconds.

    Raises:
        Interrupted: the user asked to stop.
    """
    training = np.flatnonzero(~views.test)
    some, side = views.subset(training), transients.plan(len(training), budget)
    telling = sum(depth is not None for depth in some.depths)
    if side is None or telling < (transients.FEWEST if views.matched else 1):
        return None
    at = {int(index): place for place, index in enumerate(training)}
    found = None if matched is None else {at[index]: one for index, one in matched.depths.items()}
    depths, cameras = transients.depths_at(some, side, found)
    masks = transients.moving(some, depths, cameras, scene.median_depth, not views.matched, progress)
    return LeftOut.of(some.names, transients.bounded(masks))
