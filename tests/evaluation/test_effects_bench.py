"""What the detection of effects is measured on, and how it is counted."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import open_capture
from fieldfuse.evaluation import effects_fits, effects_plan
from fieldfuse.evaluation.effects_bench import Looked, confusion
from fieldfuse.evaluation.effects_plan import EFFECTS, STRENGTHS, Planned, film, plan
from fieldfuse.pipelines.bench_effects import fits_table, table
from tests.pipelines.short import steady


def test_sixty_captures_clean_alone_and_pairs() -> None:
    planned = plan(5)
    assert len(planned) == 60 and [one.seed for one in planned] == list(range(5, 65))
    assert Counter(len(one.effects) for one in planned) == {0: 12, 1: 24, 2: 24}
    alone = {one.effects[0] for one in planned if len(one.effects) == 1}
    assert alone == {(effect, strength) for effect in EFFECTS for strength in STRENGTHS}
    assert all(strength != "weak" for one in planned if len(one.effects) == 2 for _, strength in one.effects)
    assert len({frozenset(effect for effect, _ in one.effects) for one in planned}) == 1 + 8 + 24


def looked(true: dict[str, str], *found: str) -> Looked:
    return Looked("a", "room", true, found, {}, 1.0)


def test_weak_ones_are_neither_right_nor_wrong() -> None:
    got = confusion(
        [
            looked({}),
            looked({}, "poses"),
            looked({"exposure": "weak"}, "exposure"),
            looked({"exposure": "medium", "poses": "strong"}, "exposure"),
            looked({"vignetting": "strong"}, "vignetting"),
        ]
    )
    assert got["precision"] == pytest.approx(2 / 3) and got["recall"] == pytest.approx(2 / 3)
    assert got["clean"] == 2 and got["clean_without_alarm"] == 1
    assert got["effects"]["poses"] == {
        "weak": {"captures": 0, "found": 0},
        "medium": {"captures": 0, "found": 0},
        "strong": {"captures": 1, "found": 0},
        "none": {"captures": 4, "found": 1},
    }
    lines = table(got)
    assert "| exposure | 1 of 1 | 1 of 1 | 0 of 0 | 0 of 3 |" in lines and "precision 66.7%, recall 66.7%" in lines[-1]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"WIDTH": 80, "HEIGHT": 60, "FRAMES": 9}.items():
        monkeypatch.setattr(effects_plan, name, value)


@pytest.mark.usefixtures("small")
def test_captures_do_not_tell_their_lens_or_true_poses(tmp_path: Path) -> None:
    planned = Planned("both", "room", 7, (("distortion", "strong"), ("poses", "strong")))
    place = film(planned, tmp_path)
    told = json.loads((place / "transforms.json").read_text())
    assert told["camera_model"] == "PINHOLE" and "k1" not in told
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


@pytest.mark.usefixtures("small")
def test_fits_in_every_mode(tmp_path: Path) -> None:
    planned = [Planned("plain", "room", 7, ())]
    with steady(0.005):
        data = effects_fits.compared(planned, tmp_path, 0.5, ("all_off", "all_on"))
    only = data["each"][0]
    assert only["found"] == only["auto"]["on"] and only["all_off"]["on"] == [] and only["all_off"]["effects_seconds"] == 0
    assert only["all_on"]["effects_seconds"] > 0 and only["all_on"]["psnr"] > 8
    assert data["mean"]["auto"]["psnr"] == pytest.approx(only["auto"]["psnr"])
    lines = fits_table(data)
    assert lines[0].startswith("| capture | found | auto, dB | all off, dB | all on, dB |") and lines[-1].startswith("| mean |")
