"""A walk through a simulated room with a 360° camera, from photos to a field, beside the same walk with a plain camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fieldfuse as ff
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate
from tests.pipelines.short import steady

WALK = {"kind": "walk", "frames": 16, "fps": 1, "speed": 0.25, "shake": 2}
INSTANTS, LEAST = 16, 1.5  # decibels


def scored(folder: Path, camera: dict[str, Any], output: str, **options: Any) -> tuple[ff.Scene, float]:
    simulate(scene_file({"scene": "room", "seed": 3, "camera": camera, "path": WALK, "output": output}, "test"), folder)
    scene = ff.load(folder, threads=2, effects="off", **options)
    with steady():
        field = ff.fit(scene, budget=12, init="classical")
    return scene, ff.evaluate(field, scene).psnr


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_360_degree_walk_is_as_good_as_one_with_a_plain_camera(tmp_path: Path) -> None:
    """Panoramas without poses or intrinsics; the plain camera, of as many pixels a degree, even with its true ones."""
    _, plain = scored(tmp_path / "plain", {"width": 160, "height": 120, "fov": 65}, "frames")
    scene, around = scored(tmp_path / "around", {"kind": "panorama", "width": 800, "height": 400}, "photos")
    assert scene.poses.registered == 7 * INSTANTS and not scene.poses.missing
    assert around > plain - LEAST
    held = [name.rsplit("_view", 1)[0] for name in scene.test.names]
    assert len(held) == 14 and set(held) == {"000000", "000008"}  # all seven views of two instants
    assert not set(held) & {name.rsplit("_view", 1)[0] for name in scene.train.names}
    places = np.array([camera.world_from_camera[:3, 3] for camera in scene.test.cameras])
    assert np.ptp(places[:7], axis=0).max() < 1e-9
