"""The demo's video goes through frame choice and structure from motion, and the cameras found are the true ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.video import read_video
from fieldfuse.config import CaptureSettings, PosesSettings
from fieldfuse.poses.sfm import find_poses
from fieldfuse.simulate import demo


def aligned(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation and translation that carry (N, 3) `source` to `target` with least squares (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, singular, vt = np.linalg.svd(b.T @ a)
    mirror = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ mirror @ vt
    scale = float((singular * np.diag(mirror)).sum() / (a**2).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


@pytest.mark.slow
def test_every_chosen_frame_is_registered_where_it_was_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "TEXELS", 150)  # as fine as pictures of this size show them
    monkeypatch.setattr(demo, "BOX_TEXELS", 350)
    film = demo.write_demo_video(tmp_path / "demo.mp4", frames=13, size=(384, 288))
    chosen = select_frames(read_video(tmp_path / "demo.mp4"), tmp_path, CaptureSettings())
    found = find_poses(chosen, tmp_path, PosesSettings(max_features=1024), seed=0, threads=1)
    assert len(chosen.frames) >= 11
    assert found.registered == found.total == len(chosen.frames)
    truth = np.stack([film.world_from_camera[int(name.rpartition("_")[2])] for name in found.names])  # frame_000012
    centres = found.world_from_camera[:, :3, 3]
    scale, rotation, translation = aligned(centres, truth[:, :3, 3])
    off = np.linalg.norm(scale * centres @ rotation.T + translation - truth[:, :3, 3], axis=1)
    extent = np.linalg.norm(np.ptp(truth[:, :3, 3], axis=0))
    assert off.max() < 0.01 * extent
    turns = np.einsum("nij,nij->n", rotation @ found.world_from_camera[:, :3, :3], truth[:, :3, :3])
    assert np.rad2deg(np.arccos(np.clip((turns - 1) / 2, -1, 1))).max() < 0.5
    assert np.mean([camera.fx for camera in found.intrinsics]) == pytest.approx(film.intrinsics.fx, rel=0.02)
