"""The effects stage of a run: what it decides, what it writes, and that nothing changes where nothing is found or wanted."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.simulated import known_light
from fieldfuse.capture import open_capture
from fieldfuse.capture.prepare import held_out
from fieldfuse.config import load_settings
from fieldfuse.effects.correct import Corrections
from fieldfuse.effects.decide import Decided, asleep, decide, wish
from fieldfuse.errors import InputError
from fieldfuse.pipelines.schemas import Effects, checked
from fieldfuse.pipelines.summary import refined_cameras
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate

SCENE = {
    "scene": "room",
    "seed": 3,
    "side": 1,
    "camera": {"width": 176, "height": 132},
    "path": {"kind": "walk", "fps": 5, "speed": 0.5, "shake": 4},
}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("effects")
    listed = {"clean": (12, []), "drift": (9, ["exposure:strong", "vignetting:strong"])}
    for name, (count, effects) in listed.items():
        scene = {**SCENE, "path": {**SCENE["path"], "frames": count}}
        simulate(scene_file(scene, "test"), root / name, effects=effects, workers=1)
    return {name: root / name for name in listed}


@pytest.fixture(scope="module")
def found(captures: dict[str, Path]) -> Decided:
    """What is decided by itself for the capture whose light drifts."""
    capture = open_capture(captures["drift"])
    return decide(capture, held_out(capture, 8), load_settings().effects)


def test_a_clean_capture_gets_no_correction(captures: dict[str, Path]) -> None:
    capture = open_capture(captures["clean"])
    got = decide(capture, held_out(capture, 8), load_settings().effects)
    assert not any(decision.on for decision in got.decisions)
    assert not got.corrections.geometric and not got.corrections.photometric
    assert got.corrections.on_capture(capture) is capture


def test_drift_and_vignetting_are_corrected_and_off_is_off(captures: dict[str, Path], found: Decided) -> None:
    capture = open_capture(captures["drift"])
    test, got = held_out(capture, 8), found
    on = {decision.finding.effect for decision in got.decisions if decision.on}
    assert on == {"exposure", "vignetting"}
    gains = np.array([got.corrections.gain[frame.name] for frame in capture.frames])
    np.testing.assert_allclose(np.log2(gains[~test]).mean(0), 0, atol=1e-4)
    assert got.corrections.corner == pytest.approx(0.35, abs=0.1)
    without = decide(capture, test, load_settings(pairs=["effects.off=[vignetting]"]).effects)
    assert without.corrections.corner is None and without.corrections.gain


def test_what_is_found_is_what_was_simulated(captures: dict[str, Path], found: Decided) -> None:
    capture = open_capture(captures["drift"])
    got, known = found.corrections, known_light(captures["drift"], capture, held_out(capture, 8))
    off = np.log2([np.divide(got.gain[frame.name], known.gain[frame.name]) for frame in capture.frames])
    assert np.sqrt(np.mean(off**2)) < 0.02 and got.corner == pytest.approx(known.corner, abs=0.02)


def test_seconds_stand_beside_each_effect(captures: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic", time.process_time)  # what else the machine does is in no share
    capture = open_capture(captures["drift"])
    data = decide(capture, held_out(capture, 8), load_settings().effects).to_dict()
    paid = {entry["effect"]: entry["seconds"] for entry in data["effects"]}
    points = data["looked_at"]["points_seconds"]
    assert points > 0.02 and paid["exposure"] > paid["vignetting"] > 0 and paid["poses"] == pytest.approx(paid["distortion"], abs=0.002)
    assert 0.7 * data["seconds"] < points + sum(paid.values()) < 1.02 * data["seconds"] + 0.01
    checked(data, Effects, Path("effects.json"))


def test_blurred_pictures_weigh_less(captures: dict[str, Path], tmp_path: Path) -> None:
    place = Path(shutil.copytree(captures["clean"], tmp_path / "jerk"))
    for name in ("000003.png", "000006.png"):
        path = place / "images" / name
        cv2.imwrite(str(path), cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 2.5))
    capture = open_capture(place)
    test = held_out(capture, 8)
    got = decide(capture, test, load_settings(pairs=["effects=off", "effects.on=[motion_blur]"]).effects)
    weight = {Path(name).stem: value for name, value in got.corrections.weight.items()}
    assert got.decisions[-2].finding.there and not any(frame.name in got.corrections.weight for frame in np.array(capture.frames)[test])
    assert max(weight["000003"], weight["000006"]) < 0.6 * min(weight.get(f"{index:06d}", 1.0) for index in (1, 2, 4, 5, 7, 9, 10, 11))
    assert min(weight.values()) >= 0.1


def test_settings() -> None:
    off = load_settings(pairs=["effects=off"]).effects
    assert asleep(off) and wish(off, "poses") == "off"
    some = load_settings(pairs=["effects=off", "effects.on=[exposure]"]).effects
    assert not asleep(some) and wish(some, "exposure") == "on" and wish(some, "poses") == "off"
    with pytest.raises(InputError, match="did you mean 'exposure'"):
        load_settings(pairs=["effects.on=[exposur]"])
    with pytest.raises(InputError, match="both name"):
        load_settings(pairs=["effects.on=[poses]", "effects.off=[poses]"])


def test_settings_files_may_say_on_and_off_bare(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("effects: {on: [exposure], off: [poses]}\n")
    got = load_settings(file=file).effects
    assert got.on == ["exposure"] and got.off == ["poses"]
    file.write_text("effects: off\n")
    assert load_settings(file=file).effects.mode == "off"


def test_info_prints_the_evidence(captures: dict[str, Path]) -> None:
    from fieldfuse.pipelines.cli import app

    shown = CliRunner().invoke(app, ["info", str(captures["drift"]), "--effects", "--fast", "--quiet"])
    assert shown.exit_code == 0, shown.output
    assert "exposure" in shown.output and "shared points looked at" in shown.output and "s of it for finding these points" in shown.output
    assert not list(captures["drift"].glob("effects.json"))


def test_how_far_given_cameras_were_moved_is_told() -> None:
    """Three cameras of four: moved by 1, 2 and 4 cm, turned by 0, 1 and 2 degrees."""
    given = np.stack([np.eye(4)] * 4)
    given[:, :3, 3] = np.arange(12).reshape(4, 3)
    moved = given[:3].copy()
    moved[:, 0, 3] += (0.01, 0.02, 0.04)
    for index in (1, 2):
        moved[index, :3, :3] = cv2.Rodrigues(np.deg2rad([0.0, index, 0.0]))[0]
    names = ["a", "b", "c", "d"]
    frames = [SimpleNamespace(name=name, world_from_camera=pose) for name, pose in zip(names, given, strict=True)]
    refined = Corrections(poses=dict(zip(names, moved, strict=False)))

    def told(corrections: Corrections, metric: bool = True) -> list[str]:
        capture = SimpleNamespace(frames=frames, metric=metric, has_depth=metric)
        return refined_cameras(SimpleNamespace(corrections=corrections, capture=capture))  # type: ignore[arg-type]

    (text,) = told(refined)
    assert "moved by 2.0 cm and turned by 1.00°" in text and "effects.off=[poses]" in text and "sensor" in text
    by_depth = replace(refined, by_depth=True)
    (text,) = told(by_depth)
    assert "by its pictures and depth:" in text and "sensor" not in text
    assert Corrections.from_dict(by_depth.to_dict()).by_depth and not Corrections.from_dict(refined.to_dict()).by_depth
    (text,) = told(refined, metric=False)
    assert "0.02 of the capture's units" in text and "sensor" not in text
    assert told(Corrections()) == told(Corrections(poses=dict(zip(names, given, strict=True)))) == []
