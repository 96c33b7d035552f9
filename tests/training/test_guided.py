"""A fit that begins by matching pictures: its geometry is better, its budget holds, and it does without where nothing can be matched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from tests.stereo.test_match import FAR, MEDIAN, NEAR, corner
from toolkit.camera import Similarity
from toolkit.capture.types import Views
from toolkit.config import Settings, load_settings
from toolkit.errors import Interrupted
from toolkit.poses.scene import Scene
from toolkit.progress import Progress
from toolkit.render.field import Field
from toolkit.render.image import make_renderer, render_view
from toolkit.stereo import quick
from toolkit.training.guided import fit_guided, wants_matching

SCENE = Scene(Similarity.identity(), np.array([0.0, 0.0, 0.0]), np.full(3, 1.5), MEDIAN, NEAR, FAR, 0.0, True, False)


def wanted(*pairs: str) -> Settings:
    return load_settings(pairs=["budget=4", "field.resolution=64", "device=cpu", "engine=numba", "threads=1", *pairs])


def steady(step: float = 0.005) -> Callable[[], float]:
    """A clock that goes on by as much at every look, so that a fit has as many steps on every machine."""
    looks = count()
    return lambda: next(looks) * step


def views() -> Views:
    made, _ = corner()
    return replace(made, test=np.arange(len(made)) == 3)


def depth_error(field: Field) -> float:
    """Median relative depth error at the held-out view, where light is stopped."""
    made, truth = corner()
    shown = render_view(field, made.intrinsics[3], made.world_from_camera[3], make_renderer(field))
    known = (truth[3] > 0) & (np.asarray(shown.depth) > 0)
    assert known.mean() > 0.5
    return float(np.median(np.abs(np.asarray(shown.depth) - truth[3])[known] / truth[3][known]))


def test_depth_by_matching_makes_geometry_better() -> None:
    guided = fit_guided(views(), SCENE, wanted(), ticks=steady())
    alone = fit_guided(views(), SCENE, wanted("fit.depth_from=sensor"), ticks=steady())
    assert alone.matched is None
    assert guided.matched is not None and guided.matched["views"] == 6 and guided.matched["share"] > 0.3
    assert depth_error(guided.field) < 0.6 * depth_error(alone.field)


def test_matching_is_a_part_of_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    now = steady()
    whole, took = quick.guided, []

    def slow(*given: object, **options: object) -> object:
        took.append([now() for _ in range(200)])  # a second
        return whole(*given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(quick, "guided", slow)
    result = fit_guided(views(), SCENE, wanted(), ticks=now)
    assert len(took) == 1 and result.matched is not None and 1 <= result.matched["seconds"] < 1.1
    assert 3.9 < result.seconds < 4.2
    assert result.timeline[0]["seconds"] > 1 and result.timeline[-1]["seconds"] == pytest.approx(result.seconds, abs=0.05)


def test_only_captures_without_depth_are_matched() -> None:
    made, truth = views(), corner()[1]
    assert wants_matching(made, wanted())
    assert not wants_matching(replace(made, depths=[None, truth[1], *[None] * 5]), wanted())
    for pair in ("fit.depth_from=sensor", "fit.depth_from=off", "fit.depth_from=any", "fit.depth=0"):
        assert not wants_matching(made, wanted(pair))


def test_what_cannot_be_matched_is_fitted_to_colours() -> None:
    made = views()
    here = replace(made, world_from_camera=np.tile(made.world_from_camera[:1], (len(made), 1, 1)))
    result = fit_guided(here, SCENE, wanted("budget=1"), ticks=steady())
    assert result.matched is None and result.steps > 0
    assert len(result.notes) == 1 and "colours alone: no two pictures" in result.notes[0]


def test_it_can_be_stopped_while_matching() -> None:
    class Stopping(Progress):
        def stopping(self) -> bool:
            return True

    with pytest.raises(Interrupted):
        fit_guided(views(), SCENE, wanted(), Stopping())


def test_progress_goes_on_from_matching_to_fitting() -> None:
    class Told(Progress):
        def __init__(self) -> None:
            self.shares: list[float] = []
            self.notes: list[str] = []

        def update(self, done: float, total: float, note: str = "") -> None:
            self.shares.append(done / total)
            self.notes.append(note)

    told = Told()
    fit_guided(views(), SCENE, wanted("budget=1"), told, ticks=steady())
    matching = [share for share, note in zip(told.shares, told.notes, strict=True) if "matched" in note]
    assert matching and matching == sorted(matching) and max(matching) <= quick.SHARE + 1e-9
    fitting = [share for share, note in zip(told.shares, told.notes, strict=True) if "³" in note]
    assert fitting and fitting == sorted(fitting) and fitting[-1] > 0.9 and max(told.shares) < 1.05
