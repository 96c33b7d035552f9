"""The model of time: what it chooses, what it learns, what it remembers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.config import load_settings
from fieldfuse.evaluation import budget as model
from fieldfuse.evaluation.budget import KINDS, Choice, Speed, Work, amounts, choose, effects_work, most_export_seconds, predict, sfm_work
from fieldfuse.evaluation.budget_probe import self_test
from fieldfuse.files import write_json
from fieldfuse.poses.job import MAX_EXHAUSTIVE

UNITS = {"decode": 0.02, "features": 0.1, "ray": 3e-6, "fit": 1e-5, "score": 5.0}
FOX = Work(50, 540, 960, 7, posed=True, depth=False, outlined=False)


def test_more_seconds_give_larger_pictures() -> None:
    sizes = [model.choose(Speed(UNITS), FOX, seconds).image_size for seconds in (15, 30, 60, 120, 600)]
    assert sizes == sorted(sizes) and sizes[0] < sizes[-1] <= 960


def test_what_has_to_be_done_anyway_does_not_make_pictures_small() -> None:
    """105 frames with depth: effects and TSDF take what the fit should have, whatever the pictures' size."""
    units = {"decode": 0.0076, "features": 0.18, "ray": 1.3e-6, "fit": 5e-6, "score": 0.94}
    work = Work(105, 640, 480, 14, True, True, True, effects=True)
    left = 90 * 0.75 - sum(predict(Speed(units), work, Choice(160)).values())
    assert 0 < left < 0.35 * 90
    assert 160 < choose(Speed(units), work, 90.0).image_size <= 320
    assert choose(Speed(units), work, 60.0).image_size == 160  # there are not rays enough for more


def test_a_slower_machine_gets_smaller_pictures() -> None:
    slow = Speed({kind: 6 * value for kind, value in UNITS.items()})
    assert model.choose(slow, FOX, 60).image_size < model.choose(Speed(UNITS), FOX, 60).image_size


def test_a_video_gives_fewer_frames_when_time_is_short() -> None:
    video = Work(150, 1280, 720, 19, posed=False, depth=False, outlined=True, video=True, total=900)
    few, many = (model.choose(Speed(UNITS), video, seconds, 150) for seconds in (60, 2000))
    assert few.max_frames is not None and many.max_frames == 150 and few.max_frames < 150


def test_more_frames_of_a_video_go_before_larger_ones() -> None:
    """The bedroom within two minutes: 75 frames of 640 pixels had 30.2 dB where 50 of 960 had 26.9, both seen at 320."""
    video = Work(150, 848, 364, 19, posed=False, depth=False, outlined=True, video=True, total=600, effects=True)
    chosen = choose(Speed({"decode": 0.0042, "features": 0.19, "ray": 1.3e-6, "fit": 4e-6, "score": 0.81}), video, 117)
    assert chosen.max_frames is not None and chosen.max_frames >= 75 and 320 <= chosen.image_size <= 640


@settings(deadline=None)
@given(st.floats(10, 1000), st.integers(4, 400), st.integers(64, 4000), st.integers(64, 4000), st.booleans(), st.booleans(), st.booleans())
def test_there_is_always_a_choice(seconds: float, frames: int, width: int, height: int, depth: bool, outlined: bool, video: bool) -> None:
    work = Work(frames, width, height, frames // 8, posed=not video, depth=depth, outlined=outlined, video=video, total=10 * frames)
    choice = model.choose(Speed(UNITS), work, seconds, frames)
    assert choice.image_size in model.SIZES and (choice.max_frames is not None) == video
    assert all(value > 0 for value in model.predict(Speed(UNITS), work, choice).values())


@given(st.floats(1, 1000), st.floats(1e-7, 1e-3), st.integers(64, 512))
def test_the_lattice_can_be_filled(seconds: float, unit: float, finest: int) -> None:
    found = model.resolution_for(seconds, unit, finest)
    assert 64 <= found <= finest
    if found > 64:
        assert model.SURFACE * found**2 <= model.VOXELS_A_RAY * seconds / unit


def test_exports_fit_into_what_is_left() -> None:
    for seconds in (0.1, 2.0, 10.0, 100.0):
        views, frames = model.exports_for(seconds, 0.3, 0.1)
        assert 12 <= views <= 60 and (frames == 0 or 24 <= frames <= 90)
        assert views == 12 or 0.3 * views + 0.1 * frames <= seconds * 1.01
    assert model.exports_for(100.0, 0.3, 0.1) == (60, 90)
    assert model.exports_for(-5.0, 0.3, 0.1) == (12, 0)


KITCHEN = Work(200, 640, 480, 25, posed=True, depth=True, outlined=True)
FERN = Work(20, 504, 378, 3, posed=True, depth=False, outlined=False)
LEGO = Work(125, 400, 400, 25, posed=True, depth=False, outlined=True, alpha=True)
MACHINES = (
    {"decode": 0.0035, "features": 0.13, "ray": 1.35e-6, "fit": 4.8e-6, "score": 0.51},
    {"decode": 0.0042, "features": 0.19, "ray": 1.25e-6, "fit": 4e-6, "score": 0.8},
)


@pytest.mark.parametrize(
    ("machine", "work", "size", "views", "video", "took"),
    [
        (0, FERN, 480, 12, 0, 10.7),
        (0, FOX, 160, 12, 0, 1.6),
        (0, FOX, 160, 60, 78, 5.9),
        (0, LEGO, 320, 60, 70, 21.9),
        (0, KITCHEN, 160, 12, 0, 2.2),
        (0, KITCHEN, 240, 12, 0, 4.6),
        (1, FOX, 400, 12, 0, 8.4),
        (1, KITCHEN, 240, 29, 90, 12.9),
        (1, replace(FERN, texture=True, page=True), 480, 12, 0, 17.7),
        (1, replace(LEGO, texture=True, page=True), 320, 18, 37, 15.2),
    ],
)
def test_exports_take_what_they_took(machine: int, work: Work, size: int, views: int, video: int, took: float) -> None:
    """Runs that were measured on two machines, by their self-tests alone, before anything is learnt."""
    least = (0.7, 0.8)[machine]
    assert least < most_export_seconds(Speed(MACHINES[machine]), work, Choice(size), views, video) / took < 1.6


def test_runs_teach_the_model() -> None:
    speed = Speed(dict(UNITS))
    first = speed.seconds("views", 10)
    for _ in range(6):
        speed.learn("views", speed.seconds("views", 10), 3 * first)
    assert speed.seconds("views", 10) == pytest.approx(3 * first, rel=0.01)
    speed.learn("scene", 1.0, 1e9)
    assert speed.factors["scene"] == model.FACTOR_RANGE[1]


def test_what_was_learnt_is_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    name = model.signature(1, "cpu")
    assert name == model.signature(1, "cpu") != model.signature(2, "cpu")
    assert model.remembered(name) is None
    model.remember(name, Speed(UNITS, {"views": 2.0}))
    model.remember("another", Speed(UNITS))
    assert model.remembered(name) == Speed(UNITS, {"views": 2.0})
    model.remember(name, None)
    assert model.remembered(name) is None and model.remembered("another") is not None
    for damaged in ([], {name: 3}, {name: {"units": UNITS, "factors": {"views": -1}}}, {name: {"units": {}, "factors": {}}}):
        write_json(model.cache_file(), damaged)
        assert model.remembered(name) is None
    model.cache_file().write_text("not json")
    assert model.remembered(name) is None
    model.remember(name, Speed(UNITS))
    assert model.remembered(name) is not None


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    model.remember("it", Speed(UNITS))
    assert model.remembered("it") is None


def test_the_self_test_measures_every_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.evaluation.budget_probe.SECONDS", 0.05)
    speed = self_test(load_settings("balanced", flags={"device": "cpu"}))
    assert set(speed.units) == set(model.KINDS)
    assert 1e-8 < speed.units["ray"] < 1e-3 and 1e-8 < speed.units["fit"] < 1e-2 and speed.units["features"] > 1e-3


def test_poses_take_what_pictures_pairs_and_their_size_ask_for() -> None:
    unit = 0.132  # of the machine on which these were measured, one thread: width, height, then frames → seconds
    for width, height, measured in ((848, 364, {36: 8.8, 75: 29.4, 100: 48.2}), (720, 1280, {24: 17.4, 50: 36.9, 75: 64.3})):
        video = Work(150, width, height, 19, posed=False, depth=False, outlined=False, video=True, total=1000)
        for frames, seconds in measured.items():
            predicted = unit * sfm_work(video, frames)
            assert seconds / 1.6 < predicted < 1.6 * seconds
            assert amounts(video, Choice(320, frames))["poses"] == sfm_work(video, frames)
    photos = replace(video, video=False)
    assert sfm_work(photos, MAX_EXHAUSTIVE) > 2 * sfm_work(video, MAX_EXHAUSTIVE)  # all pairs are matched …
    assert sfm_work(photos, MAX_EXHAUSTIVE) > sfm_work(photos, MAX_EXHAUSTIVE + 1)  # … of so many, and then those that look alike
    fox = Work(50, 540, 960, 7, posed=False, depth=False, outlined=False)
    assert 1.25 * 40 > unit * sfm_work(fox, 50) > 40 / 1.25  # bare photos, whose matching verifies on a second thread
    assert sfm_work(replace(video, width=3 * 720, height=3 * 1280), 50) < 2 * sfm_work(video, 50)  # it works on 1600 pixels


def test_looking_for_effects_is_modelled_by_pictures() -> None:
    kitchen = replace(KITCHEN, effects=True)
    assert effects_work(kitchen) == 240 and effects_work(kitchen, every=0.0) == 40
    assert effects_work(Work(20, 640, 480, 3, posed=True, depth=False, outlined=False, effects=True), every=0.0) == 17
    assert effects_work(replace(kitchen, posed=False)) == 120  # the points are there already
    assert amounts(kitchen, Choice(320))["effects"] == 40 + model.CORRECTED * 200  # what is likely
    assert amounts(replace(kitchen, effects=False), Choice(320))["effects"] == 0
    speed = Speed(dict.fromkeys(KINDS, 0.1))
    speed.learn("effects", speed.seconds("effects", effects_work(kitchen)), 6.0)
    assert 6.0 < speed.seconds("effects", 240) < 24.0  # a quarter of what was predicted is believed in part


def test_exports_are_given_no_more_than_they_can_use() -> None:
    speed = Speed({**dict.fromkeys(KINDS, 1e-6), "ray": 1e-11})
    little, much = (most_export_seconds(speed, FOX, Choice(240), *counts) for counts in ((12, 0), (60, 90)))
    assert 0 < little < much < 1e3 * little
    megapixels = FOX.pixels(240) / 1e6
    assert much == pytest.approx(1e-6 * (2.3 + (193 + 60 * 29) * megapixels) + 1.2 * 1.2e-11 * 90 * FOX.pixels(240))


def test_finer_depth_of_a_mesh_takes_longer_and_less_than_rendering_it_would() -> None:
    small, finer, rendered = (model.mesh_work(FOX, choice) for choice in (Choice(320), Choice(320, mesh_size=400), Choice(400)))
    assert all(a < b < c for a, b, c in zip(small, finer, rendered, strict=True))
    assert model.mesh_work(FOX, Choice(320, mesh_size=320)) == small
