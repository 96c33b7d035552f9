"""Splat files as an independent viewer draws them, beside our own renders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.render.splat_files import save_splats
from fieldfuse.render.splats import Splats

from .made import SPLAT_CAMERA, SPLAT_POSE, some_splats
from .viewers import modules, spark

LENS = SPLAT_CAMERA.scaled(8 * SPLAT_CAMERA.width, 8 * SPLAT_CAMERA.height)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["ply", "spz"])
def test_spark_draws_what_we_draw(suffix: str, tmp_path: Path) -> None:
    modules()
    splats, behind = Splats(some_splats(200, 1), np.zeros(3)), (0.2, 0.3, 0.5)
    (tmp_path / "site").mkdir()
    path = tmp_path / "site" / f"splat.{suffix}"
    save_splats(path, splats)
    # Spark shows places as the file has them: those of .spz are right, up and back, those of .ply right, down and forward.
    turn = np.diag([1.0, -1.0, -1.0, 1.0]) if suffix == "spz" else np.eye(4)
    theirs = spark(path, LENS, turn @ SPLAT_POSE, behind, tmp_path).astype(np.float64)
    ours = 255 * splats.render(LENS, SPLAT_POSE, np.array(behind)).rgb
    assert 10 * np.log10(255**2 / np.square(theirs - ours).mean()) > 40
