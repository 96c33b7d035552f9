"""A capture survives JSON unchanged."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import FISHEYE, Intrinsics
from fieldfuse.capture import Capture, Frame, open_capture
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.errors import InputError
from tests.capture.layouts import LAYOUTS


def same(one: Capture, two: Capture) -> bool:
    def plain(frame: Frame) -> Frame:
        return replace(frame, world_from_camera=None)

    for a, b in zip(one.frames, two.frames, strict=True):
        if plain(a) != plain(b) or not np.array_equal(a.world_from_camera, b.world_from_camera):
            return False
    if (one.points is None) != (two.points is None) or (one.points is not None and not np.array_equal(one.points, two.points)):
        return False
    return replace(one, frames=(), points=None) == replace(two, frames=(), points=None)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout(tmp_path: Path, layout: str) -> None:
    LAYOUTS[layout][1](tmp_path)
    capture = open_capture(tmp_path)
    text = json.dumps(capture_to_dict(capture), allow_nan=False)
    assert same(capture_from_dict(json.loads(text)), capture)


def test_every_field() -> None:
    camera = Intrinsics(80, 60, 70.5, 71.5, 40.25, 30.75, FISHEYE, (0.1, 0.2, 0.3, 0.4))
    pose = np.vstack([np.random.default_rng(0).normal(size=(3, 4)), [0, 0, 0, 1]])
    frame = Frame("a", Path("/x/a.png"), camera, pose, Path("/x/d.png"), camera.pinhole(), Path("/x/m.png"), "test", 7, 812.25)
    capture = Capture(
        "video",
        Path("/x"),
        (frame, Frame("b", Path("/x/b.png"))),
        True,
        True,
        5000.0,
        True,
        (0.0, 0.6, 0.8),
        pose[:, :3],
        ("w",),
        {"fps": 29.97},
    )
    assert same(capture_from_dict(json.loads(json.dumps(capture_to_dict(capture)))), capture)


BASE = capture_to_dict(Capture("photos", Path("/x"), (Frame("a", Path("/x/a.png"), Intrinsics(8, 6, 7, 7, 4, 3), np.eye(4)),)))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5), lambda inner: st.lists(inner, max_size=3), max_leaves=5
)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(BASE)), JSON)
def test_tampered_captures_are_refused_in_one_way(key: str, value: object) -> None:
    with contextlib.suppress(InputError):
        capture_from_dict({**BASE, key: value})


@pytest.mark.parametrize("data", [{}, [], None, "x", {**BASE, "version": 99}, {k: v for k, v in BASE.items() if k != "frames"}])
def test_what_is_no_capture(data: object) -> None:
    with pytest.raises(InputError, match="run the job again"):
        capture_from_dict(data)
