"""A short fit with and without tells what helps images that it did not see."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.capture import open_capture
from fieldfuse.capture.types import Capture
from fieldfuse.config import Settings, load_settings
from fieldfuse.effects.correct import Corrections
from fieldfuse.training import trial as module
from fieldfuse.training.trial import Trial, same_geometry
from tests.pipelines.made import make_room


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("trial") / "room"
    make_room(folder, 16)
    capture = open_capture(folder)
    return capture.with_frames([replace(frame, split=None) for frame in capture.frames])


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load_settings(pairs=["threads=1", "device=cpu", "field.resolution=32"])


def aside(capture: Capture) -> np.ndarray:
    return np.arange(len(capture.frames)) % 5 == 2


def test_wrong_corrections_score_worse(room: Capture, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RESOLUTION", 32)
    monkeypatch.setattr(module, "STEPS", 160)
    monkeypatch.setattr(module, "LONG_SIDE", 64)
    score = Trial(room, aside(room), settings)
    plain = score(Corrections())
    rng = np.random.default_rng(0)
    gain = {frame.name: tuple(float(2 ** rng.normal(0, 0.7)) for _ in range(3)) for frame in room.frames}
    turned = {}
    for frame in room.frames:
        pose = np.array(frame.world_from_camera)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.12, (1, 3))).as_matrix()[0]
        turned[frame.name] = pose
    toned, moved = score(Corrections(gain=gain)), score(Corrections(poses=turned))  # type: ignore[arg-type]
    assert plain is not None and toned is not None and moved is not None
    assert len(plain) == aside(room).sum()
    assert plain.mean() > toned.mean() + 1 and plain.mean() > moved.mean() + 1
    again = score(Corrections())
    assert again is not None and np.array_equal(plain, again)  # not a matter of how busy the machine is


def test_a_machine_that_is_far_too_slow_tells_nothing(room: Capture, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LONGEST", 0.0)
    assert Trial(room, aside(room), settings)(Corrections()) is None


def test_images_that_cannot_be_read_tell_nothing(room: Capture, settings: Settings) -> None:
    gone = room.with_frames([replace(frame, image=Path("nowhere.png")) for frame in room.frames])
    began = time.monotonic()
    assert Trial(gone, aside(gone), settings)(Corrections()) is None
    assert time.monotonic() - began < 60


def test_cameras_are_compared_by_what_moves_them() -> None:
    assert same_geometry(Corrections(), Corrections(gain={"a": (2.0, 1.0, 1.0)}))
    assert not same_geometry(Corrections(), Corrections(poses={"a": np.eye(4)}))
    assert not same_geometry(Corrections(lens=(0.1, 0.0)), Corrections(lens=(0.2, 0.0)))
