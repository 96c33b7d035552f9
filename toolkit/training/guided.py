"""A fit that knows depth: the capture's own, or, in the first share of its budget, what quick matching of the pictures finds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypedDict, Unpack

from toolkit.capture.types import Views
from toolkit.config import Settings
from toolkit.errors import InputError
from toolkit.poses.scene import Scene
from toolkit.progress import SILENT, Progress
from toolkit.render.field import Field
from toolkit.stereo import quick
from toolkit.training.engine import warm_up
from toolkit.training.fit import DEFAULT_BUDGET, FitResult, fit_field
from toolkit.volume.host import Host


class Begin(TypedDict, total=False):
    """What a fit begins with besides its views; see `fit_field`."""

    host: Host | None
    start: Field | None
    coarse: bool


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

    Not where alpha cuts an object out: silhouettes tell enough there (lego 28.6 dB after 30 s without, 28.4 with matching).
    """
    known = any(depth is not None for depth in views.depths) or views.background is not None
    return settings.fit.depth_from == "auto" and settings.fit.depth > 0 and not known


def fit_guided(
    views: Views,
    scene: Scene,
    settings: Settings,
    progress: Progress = SILENT,
    ticks: Callable[[], float] = time.perf_counter,
    **begin: Unpack[Begin],
) -> FitResult:
    """`fit_field`, with quick matching before it where that is wanted. Its seconds are a part of the budget, and of the timeline.

    What cannot be matched is fitted to colours alone, and `notes` says why.

    Raises:
        Interrupted: the user asked to stop while pictures were matched.
        InputError: as `fit_field`.
    """
    if not wants_matching(views, settings):
        return fit_field(views, scene, settings, progress, ticks=ticks, **begin)
    warm_up(settings, progress)
    quick.warm_up()
    budget, began = settings.fit.budget or DEFAULT_BUDGET, ticks()
    notes: list[str] = []
    try:
        part = Part(progress, 0.0, quick.SHARE * budget, budget)
        known, matched = quick.guided(views, scene.near, scene.far, scene.median_depth, budget, part)
    except InputError as error:
        known, matched = views, None
        notes.append(f"the field was fitted to colours alone: {error}")
    spent = ticks() - began
    rest = replace(settings, fit=replace(settings.fit, budget=max(budget - spent, 0.5 * budget)))
    result = fit_field(known, scene, rest, Part(progress, spent, budget, budget), ticks=ticks, **begin)
    result.timeline = result.after(spent)
    result.seconds += spent
    result.notes = notes + result.notes
    result.matched = None if matched is None else {**matched.to_dict(), "seconds": round(spent, 2)}
    return result
