"""What the simulator knows about light: canonical pictures, exact corrections, and fits that are scored against them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.evaluation import effects_fits, effects_plan, effects_switch
from fieldfuse.evaluation.effects_plan import Planned, drifting, film
from fieldfuse.evaluation.effects_truth import canonical_capture, known_light
from fieldfuse.pipelines.bench_effects import switched_table
from fieldfuse.progress import Progress
from fieldfuse.tone import Tone
from tests.pipelines.short import steady

DRIFT = (("exposure", "medium"), ("vignetting", "medium"))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"WIDTH": 80, "HEIGHT": 60, "FRAMES": 9}.items():
        monkeypatch.setattr(effects_plan, name, value)


def picture(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def test_ten_drifting_captures() -> None:
    planned = drifting(7)
    assert [one.seed for one in planned] == list(range(7, 17)) and len({one.name for one in planned}) == 10
    assert {strength for one in planned for _, strength in one.effects} == {"medium", "strong"}
    assert all([effect for effect, _ in one.effects] == ["exposure", "vignetting"] for one in planned)
    assert len({one.scene for one in planned[:5]}) == 5 == len({one.scene for one in planned[5:]})


@pytest.mark.usefixtures("small")
def test_exact_corrections_bring_the_pictures_to_the_canonical_ones(tmp_path: Path) -> None:
    place = film(Planned("drift", "room", 6, DRIFT), tmp_path)
    capture = open_capture(place)
    test = held_out(capture, 8)
    known = known_light(place, capture, test)
    gains = np.array([known.gain[frame.name] for frame in capture.frames])
    np.testing.assert_allclose(np.log(gains[~test]).mean(0), 0, atol=1e-12)
    assert known.corner == 0.62
    right = canonical_capture(place, capture, test)
    for index, (before, after) in enumerate(zip(capture.frames, right.frames, strict=True)):
        if not test[index]:
            assert before == after
            continue
        camera = before.intrinsics
        assert camera is not None
        corrected, lost = Tone(known.gain[before.name], known.corner).undone(picture(before.image), camera)
        dark = ~lost if lost is not None else np.ones(corrected.shape[:2], dtype=bool)
        off = np.abs(corrected.astype(int) - picture(after.image))[dark]
        assert np.percentile(off, 95) <= 3 and np.abs(picture(before.image).astype(int) - picture(after.image)).mean() > 5
    stamps = [frame.image.stat().st_mtime_ns for frame in right.frames]
    again = canonical_capture(place, capture, test)
    assert [frame.image.stat().st_mtime_ns for frame in again.frames] == stamps


@pytest.mark.usefixtures("small")
def test_without_effects_of_light_the_canonical_picture_is_the_picture(tmp_path: Path) -> None:
    place = film(Planned("lens", "street", 7, (("distortion", "medium"), ("background", "weak"))), tmp_path)
    capture = open_capture(place)
    test = held_out(capture, 8)
    assert known_light(place, capture, test) == effects_fits.Corrections()
    right = canonical_capture(place, capture, test)
    for index in np.flatnonzero(test):
        np.testing.assert_array_equal(picture(capture.frames[index].image), picture(right.frames[index].image))


@pytest.mark.usefixtures("small")
def test_blur_and_noise_are_not_in_the_canonical_picture(tmp_path: Path) -> None:
    blurred, plain = (
        film(Planned(name, "room", 8, effects), tmp_path) for name, effects in (("b", (("motion_blur", "strong"),)), ("p", ()))
    )
    assert 8 % 3 == 2  # this seed comes with noise
    capture = open_capture(blurred)
    right = canonical_capture(blurred, capture, held_out(capture, 8))
    sharp = picture(right.frames[0].image).astype(int)
    assert np.abs(sharp - picture(open_capture(plain).frames[0].image)).mean() < 3
    assert np.abs(sharp - picture(capture.frames[0].image)).mean() > 3


@pytest.mark.usefixtures("small")
def test_fits_are_scored_against_canonical_pictures_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned = [Planned("drift", "room", 6, (("exposure", "strong"), ("vignetting", "strong")))]
    with steady(0.005):
        data = effects_fits.compared(planned, tmp_path, 0.7, ("all_off", "known"))
    mean = data["mean"]
    assert mean["known"]["canonical"] > mean["all_off"]["canonical"] + 2
    assert mean["known"]["effects_seconds"] < 0.2 * mean["auto"]["effects_seconds"]  # nothing is looked for
    monkeypatch.setattr(effects_fits, "fit_with", None)  # nothing is fitted twice
    assert effects_fits.compared(planned, tmp_path, 0.7, ("all_off", "known")) == data
    with pytest.raises(TypeError):
        effects_fits.compared(planned, tmp_path, 0.8, ("all_off", "known"))


@pytest.mark.usefixtures("small")
def test_of_a_fit_that_is_stopped_nothing_is_kept(tmp_path: Path) -> None:
    class Stopped(Progress):
        fitting = False

        def update(self, done: float, total: float, note: str = "") -> None:
            self.fitting = self.fitting or "³" in note

        def stopping(self) -> bool:
            return self.fitting

    with pytest.raises(Interrupted):
        effects_fits.compared([Planned("plain", "room", 7, ())], tmp_path, 3, (), Stopped())
    assert not list(tmp_path.rglob("fits/*"))


def test_switched_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict] = []

    def fit(capture: object, settings: effects_fits.Settings, progress: object, found: object = None) -> dict:
        assert found == ("looked at" if settings.effects.on else None)
        asked.append({"mode": settings.effects.mode, "on": settings.effects.on, "field": settings.field, "seed": settings.seed})
        return {"psnr": 20.0 + settings.seed, "psnr_corrected": 21.0, "seconds": 3.0}

    monkeypatch.setattr(effects_switch, "fit_with", fit)
    monkeypatch.setattr(effects_switch, "open_capture", lambda path: path)
    monkeypatch.setattr(effects_switch, "held_out", lambda capture, holdout: np.zeros(3, bool))
    monkeypatch.setattr(effects_switch, "survey", lambda capture, *rest, **more: looked.append(capture) or "looked at")
    looked: list[Path] = []
    captures = {"a": tmp_path / "x", "b": tmp_path / "y"}
    data = effects_switch.switched(captures, tmp_path / "kept", 2, 64, seeds=2)
    assert looked == list(captures.values())  # once each
    assert len(asked) == len(data["each"]) == 2 * 2 * len(effects_switch.SWITCHES)
    alone = [one for one in asked if one["on"]]
    assert all(one["mode"] == "off" and len(one["on"]) == 1 for one in alone) and len(alone) == 4 * len(effects_switch.ALONE)
    assert {one["field"].background for one in asked} == {"auto", "on", "off"} and {one["field"].view for one in asked} == {"auto", "none"}
    assert data["mean"]["a"]["auto"]["psnr"] == pytest.approx(20.5)
    lines = switched_table(data)
    assert lines[0] == "| switched | a | b |" and "| no view | 20.50 / 21.00 | 20.50 / 21.00 |" in lines
    effects_switch.switched(captures, tmp_path / "kept", 2, 64, seeds=2)
    assert len(asked) == len(data["each"])
    some = effects_switch.switched(captures, tmp_path / "kept", 2, 64, modes=("auto", "poses"))
    assert list(some["mean"]["b"]) == ["auto", "poses"] and len(asked) == len(data["each"])
    with pytest.raises(InputError, match="no switch 'pose'"):
        effects_switch.switched(captures, tmp_path / "kept", 2, 64, modes=("pose",))
