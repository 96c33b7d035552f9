"""A fit that begins by matching pictures: its geometry is better, its budget holds, and it does without where nothing can be matched."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from fieldfuse.camera import Similarity
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings, load_settings
from fieldfuse.errors import Interrupted
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.stereo import fast_mvs, transients
from fieldfuse.training import depth_start
from fieldfuse.training.cells import scene as cells
from fieldfuse.training.fit import LEAST_VIEWS, Begin
from fieldfuse.training.guided import find_moving, fit_guided, looks_for_moving, wants_matching
from tests.stereo.made import FAR, MEDIAN, NEAR, PASSED, corner, with_passer

SCENE = Scene(Similarity.identity(), np.array([0.0, 0.0, 0.0]), np.full(3, 1.5), MEDIAN, NEAR, FAR, 0.0, True, False)


def wanted(*pairs: str) -> Settings:
    small = ["field.resolution=64", "field.channels=8", "field.hidden=16"]
    return load_settings(pairs=["budget=4", *small, "device=cpu", "engine=numba", "threads=1", *pairs])


def steady(step: float = 0.01) -> Callable[[], float]:
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
    guided = fit_guided(views(), SCENE, wanted(), ticks=steady(0.005))
    alone = fit_guided(views(), SCENE, wanted("fit.depth_from=sensor"), ticks=steady(0.005))
    assert alone.matched is None
    assert guided.matched is not None and guided.matched["views"] == 6 and guided.matched["share"] > 0.3
    assert depth_error(guided.field) < 0.6 * depth_error(alone.field)


def test_cells_are_fitted_to_the_depth_that_was_matched(tmp_path: Path) -> None:
    settings = wanted("fit.cells=2")
    result = cells.fit_coarse(views(), SCENE, settings, ticks=steady(0.005))
    assert not any(depth is not None for depth in views().depths)
    plan = cells.write_scene(tmp_path, "key", result, SCENE, settings)
    assert plan.count == 2 and plan.rough
    with safe_open(tmp_path / "pixels-000.safetensors", framework="pt") as file:
        assert float((file.get_tensor("distance") > 0).float().mean()) > 0.3


def test_matching_is_a_part_of_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    now = steady()
    whole, took = fast_mvs.guided, []

    def slow(*given: object, **options: object) -> object:
        took.append([now() for _ in range(100)])  # a second
        return whole(*given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(fast_mvs, "guided", slow)
    result = fit_guided(views(), SCENE, wanted(), ticks=now)
    assert len(took) == 1 and result.matched is not None and 1 <= result.matched["seconds"] < 1.1
    assert 3.9 < result.seconds < 4.2
    assert result.timeline[0]["seconds"] > 1 and result.timeline[-1]["seconds"] == pytest.approx(result.seconds, abs=0.05)


def psnr(field: Field) -> float:
    """Of the held-out view."""
    made, _ = corner()
    shown = render_view(field, made.intrinsics[3], made.world_from_camera[3], make_renderer(field)).rgb
    return float(-10 * np.log10(np.mean(np.square(shown - made.images[3] / np.float32(255)))))


@pytest.mark.parametrize("measured", [False, True])
def test_a_fit_does_without_what_moves(measured: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transients, "FEWEST", 6)
    made, depths, masks = with_passer()
    given = replace(made, test=np.arange(len(made)) == 3, depths=list(depths) if measured else [])
    without = fit_guided(given, SCENE, wanted(), ticks=steady(0.005))
    everything = fit_guided(given, SCENE, wanted("fit.moving=off"), ticks=steady(0.005))
    assert everything.left_out is None
    assert without.left_out is not None and set(without.left_out.masks) == {made.names[index] for index in PASSED}
    assert without.left_out.looked_at == 6 and without.left_out.share == pytest.approx(sum(mask.mean() for mask in masks) / 6, rel=0.35)
    assert psnr(without.field) > psnr(everything.field) + 0.3


def test_held_out_pictures_are_not_looked_at_for_what_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transients, "FEWEST", 6)
    made, _, _ = with_passer()
    views = replace(made, test=np.arange(len(made)) == 4)
    first = fit_guided(views, SCENE, wanted("budget=1"), ticks=steady()).left_out
    other = replace(views, images=[np.zeros_like(image) if index == 4 else image for index, image in enumerate(made.images)])
    second = fit_guided(other, SCENE, wanted("budget=1"), ticks=steady()).left_out
    assert first is not None and second is not None and list(first.masks) == list(second.masks) == [made.names[1]]
    assert np.array_equal(first.masks[made.names[1]], second.masks[made.names[1]])


def test_a_stop_while_looking_for_what_moves_ends_the_fit() -> None:
    class Stopping(Progress):
        def stopping(self) -> bool:
            return True

    result = fit_guided(replace(views(), depths=corner()[1]), SCENE, wanted(), Stopping())
    assert result.interrupted and result.left_out is None and result.steps == 0


def test_what_moves_is_looked_for_where_depth_is_known_and_nothing_is_cut_out() -> None:
    known = replace(views(), depths=corner()[1])
    assert looks_for_moving(known, wanted()) and not looks_for_moving(known, wanted("fit.moving=off"))
    assert not looks_for_moving(replace(known, background=(1.0, 1.0, 1.0)), wanted())
    assert find_moving(known, None, SCENE, 4) is not None and find_moving(known, None, SCENE, 0.2) is None
    assert find_moving(replace(known, matched=True), None, SCENE, 4) is None  # they are too few
    assert find_moving(views(), None, SCENE, 4) is None
    only_held_out = [depth if test else None for depth, test in zip(corner()[1], known.test, strict=True)]
    assert find_moving(replace(known, depths=only_held_out), None, SCENE, 4) is None


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
    assert len(result.notes) == 1 and "colours alone: no two images" in result.notes[0]


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
    assert matching and matching == sorted(matching) and max(matching) <= fast_mvs.SHARE + 1e-9
    fitting = [share for share, note in zip(told.shares, told.notes, strict=True) if "³" in note]
    assert fitting and fitting == sorted(fitting) and fitting[-1] > 0.9 and max(told.shares) < 1.05


def test_a_fit_begins_with_what_is_known_of_depth_within_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    now, whole, begun = steady(), depth_start.depth_start, []

    def slow(*given: object, **options: object) -> Field:
        assert [now() for _ in range(100)]  # a second
        begun.append(whole(*given, **options))  # type: ignore[arg-type]
        return begun[-1]

    monkeypatch.setattr(depth_start, "depth_start", slow)
    measured = replace(views(), depths=corner()[1])
    result = fit_guided(measured, SCENE, wanted("fit.moving=off"), ticks=now)
    assert len(begun) == 1 and 3.9 < result.seconds < 4.2 and result.timeline[0]["seconds"] > 1
    assert depth_error(result.field) < 0.02
    fit_guided(measured, SCENE, wanted("budget=1"), begin=Begin(start=result.field), ticks=now)
    fit_guided(measured, SCENE, wanted("budget=1", "fit.depth=0"), ticks=now)
    fit_guided(views(), SCENE, wanted("budget=1"), ticks=now)  # six pictures were matched: too few
    assert len(begun) == 1


def test_nobody_holds_the_guess_while_its_levels_are_climbed(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, guesses, alive = depth_start.depth_start, [], []

    def watched(*given: object, **options: object) -> Field:
        guess = whole(*given, **options)  # type: ignore[arg-type]
        guesses.append(weakref.ref(guess.feature_rows))
        return guess

    class Looking(Progress):
        def update(self, done: float, total: float, note: str = "") -> None:
            if "³" in note:
                alive.append(guesses[0]() is not None)

    monkeypatch.setattr(depth_start, "depth_start", watched)
    fit_guided(replace(views(), depths=corner()[1]), SCENE, wanted("budget=1", "fit.moving=off"), Looking(), ticks=steady())
    assert alive and not any(alive)


def test_a_guess_leaves_the_coarsest_lattice_sooner_where_validation_views_tell_when_to_and_as_soon_where_none_do() -> None:
    class Levels(Progress):
        def __init__(self) -> None:
            self.seen: list[str] = []

        def update(self, done: float, total: float, note: str = "") -> None:
            self.seen += [note.split(",")[0]] if "³" in note else []

    rough = fit_guided(views(), SCENE, wanted("budget=1", "field.resolution=32"), ticks=steady(0.005)).field
    few = views()
    many = few.subset(np.tile(np.arange(len(few)), -(-LEAST_VIEWS // np.count_nonzero(~few.test))))
    for shown, factor, tick in ((many, 0.7, 0.002), (few, 1.0, 0.005)):
        shares = []
        for begin in (Begin(), Begin(start=rough, coarse=True)):
            told = Levels()
            settings = wanted("fit.depth_from=sensor", "fit.moving=off")
            fit_guided(shown, SCENE, settings, told, begin, steady(tick))
            assert set(told.seen) == {"32³", "64³"}
            shares.append(told.seen.count("32³") / len(told.seen))
        assert shares[1] <= factor * shares[0]
