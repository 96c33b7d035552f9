"""Simulated captures for benchmarks of effects: their plan, what they hide, canonical images and exact corrections of light."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import simulated
from benchmarks.simulated import EFFECTS, STRENGTHS, Planned, canonical_capture, film, known_light, plan, plan_drifting
from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out
from fieldfuse.effects.correct import Corrections
from fieldfuse.tone import Tone

DRIFT = (("exposure", "medium"), ("vignetting", "medium"))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"WIDTH": 80, "HEIGHT": 60, "FRAMES": 9}.items():
        monkeypatch.setattr(simulated, name, value)


def picture(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def test_ten_drifting_captures() -> None:
    planned = plan_drifting(7)
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
    assert known_light(place, capture, test) == Corrections()
    right = canonical_capture(place, capture, test)
    for index in np.flatnonzero(test):
        np.testing.assert_array_equal(picture(capture.frames[index].image), picture(right.frames[index].image))


def test_sixty_captures_clean_alone_and_pairs() -> None:
    planned = plan(5)
    assert len(planned) == 60 and [one.seed for one in planned] == list(range(5, 65))
    assert Counter(len(one.effects) for one in planned) == {0: 12, 1: 24, 2: 24}
    alone = {one.effects[0] for one in planned if len(one.effects) == 1}
    assert alone == {(effect, strength) for effect in EFFECTS for strength in STRENGTHS}
    assert all(strength != "weak" for one in planned if len(one.effects) == 2 for _, strength in one.effects)
    assert len({frozenset(effect for effect, _ in one.effects) for one in planned}) == 1 + 8 + 24


@pytest.mark.usefixtures("small")
def test_captures_hide_their_lens_and_true_poses(tmp_path: Path) -> None:
    planned = Planned("both", "room", 7, (("distortion", "strong"), ("poses", "strong")))
    place = film(planned, tmp_path)
    listed = json.loads((place / "transforms.json").read_text())
    assert listed["camera_model"] == "PINHOLE" and "k1" not in listed
    about = json.loads((place / "planned.json").read_text())
    assert about["effects"] == {"distortion": "strong", "poses": "strong"}
    before = (place / "transforms.json").stat().st_mtime_ns
    assert film(planned, tmp_path) == place and (place / "transforms.json").stat().st_mtime_ns == before
    right = film(Planned("right", "room", 7, (("distortion", "strong"),)), tmp_path)
    given, true = (
        np.array([frame.world_from_camera for frame in open_capture(folder).frames], dtype=np.float64) for folder in (place, right)
    )
    cosine = (np.einsum("fij,fij->f", given[:, :3, :3], true[:, :3, :3]) - 1) / 2
    degrees = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    assert 0.3 < np.sqrt(np.mean(degrees**2)) < 1.6 and np.abs(given[:, :3, 3] - true[:, :3, 3]).max() > 0.005
