"""Stages where memory is short: each takes less, or refuses with what it needs and what is free."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.tsdf.scenes import CAMERA
from tests.tsdf.test_frames import written
from toolkit import memory
from toolkit.camera import Similarity
from toolkit.config import PosesSettings, TsdfSettings
from toolkit.errors import InputError
from toolkit.evaluate.selftest.fits import texture, views_of
from toolkit.poses import sfm
from toolkit.tsdf.fuse import fuse_capture
from toolkit.tsdf.stereo import stereo_depths
from toolkit.tsdf.volume import BYTES_PER_BLOCK, TsdfVolume


def allow(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(memory, "available", lambda: memory.SPARE + free)


def test_a_sensors_surface_becomes_coarser_and_what_was_asked_for_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = written(tmp_path, CAMERA)
    usual = fuse_capture(capture, Similarity.identity())
    allow(monkeypatch, 2 * usual.blocks * BYTES_PER_BLOCK // 3)
    less = fuse_capture(capture, Similarity.identity())
    assert usual.voxel_size < less.voxel_size < 3 * usual.voxel_size and less.blocks <= less.max_blocks < usual.blocks
    assert len(less.mesh(0.5).vertices) > 100
    with pytest.raises(InputError, match=r"GB for the TSDF, and .* GB are allowed; use tsdf\.voxel_size="):
        fuse_capture(capture, Similarity.identity(), settings=TsdfSettings(voxel_size=usual.voxel_size))


def test_a_volume_takes_half_of_what_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, 2000 * BYTES_PER_BLOCK)
    assert TsdfVolume(0.1, 3.0).max_blocks == 1000
    assert TsdfVolume(0.1, 3.0, max_bytes=7 * BYTES_PER_BLOCK).max_blocks == 7


def test_matching_and_finding_poses_are_refused_before_they_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, 2**18)
    with pytest.raises(InputError, match=r"matching pictures .* needs about .* GB of memory and 0\.1 GB is free"):
        stereo_depths(views_of(texture), 1.0, 6.0, 3.0)
    capture = written(tmp_path, CAMERA)
    monkeypatch.setattr(sfm, "plan", lambda *given: pytest.fail("the job began"))
    with pytest.raises(InputError, match=r"finding features in 0\.0 million pixels needs about .* is free; lower poses\.image_size"):
        sfm.find_poses(capture, tmp_path / "out", PosesSettings(), threads=2)


def test_fewer_workers_look_for_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = written(tmp_path, CAMERA)
    each = sfm.SIFT_BYTES * CAMERA.width * CAMERA.height
    asked: list[int] = []

    class Enough(Exception):
        pass

    def plan(capture: object, folder: object, settings: object, seed: int, threads: int) -> None:
        asked.append(threads)
        raise Enough

    monkeypatch.setattr(sfm, "plan", plan)
    for free in (8 * each, int(2.5 * each), each):
        allow(monkeypatch, free)
        with pytest.raises(Enough):
            sfm.find_poses(capture, tmp_path / "out", PosesSettings(), threads=4)
    assert asked == [4, 2, 1]
    assert sfm._pixels(capture, 80) == 80 * 60 and np.isclose(each, 300 * sfm._pixels(capture, 10_000))
