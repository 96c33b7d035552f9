"""Whole jobs on a small simulated capture: quality over seconds for both engines, and TSDF frames beside a bare loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.config import load_settings
from fieldfuse.errors import InputError
from fieldfuse.evaluation.speed import once
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress

FRAMES = 16
SIZES = (48, 96)  # width of the pictures; they are 4:3


def demo_views(width: int, frames: int = FRAMES) -> tuple[Views, Scene]:
    """The demo room filmed by hand; every 8th view is held out."""
    from fieldfuse.simulate.demo import demo_scene, hand_held

    height = width * 3 // 4
    camera, poses, room = Intrinsics(width, height, 0.85 * width, 0.85 * width, width / 2, height / 2), hand_held(frames), demo_scene()
    pictures = [room.picture(camera, pose) for pose in poses]
    views = Views([f"{i:03d}" for i in range(frames)], pictures, [camera] * frames, poses, np.arange(frames) % 8 == 0)
    centre, half = np.array([0.2, 0.2, 0.6]), np.array([1.6, 1.6, 1.0])
    return views, Scene(Similarity.identity(), centre, half, 2.0, 0.5, 6.0, 0.1, True, True)


def fit_curves(budget: float, threads: int, progress: Progress = SILENT) -> list[dict[str, Any]]:
    """Fit the demo room with each engine at each picture size for `budget` seconds.

    Returns:
        a row a job: `engine`, `width`, `steps`, `rays`, `processor_seconds`, final `psnr` and the `timeline` of (seconds, psnr).
    """
    from fieldfuse.training.engine import warm_up
    from fieldfuse.training.fit import fit_field

    settings = load_settings("fast", pairs=[f"budget={budget}", f"threads={threads}", "field.resolution=128"])
    warm_up(settings, progress)
    out: list[dict[str, Any]] = []
    for width in SIZES:
        views, scene = demo_views(width)
        for engine in ("numba", "torch"):
            progress.check()
            settings.engine, settings.device = engine, "cpu"
            results: list[Any] = []
            spent = once(lambda: results.append(fit_field(views, scene, settings)))  # noqa: B023
            result = results[0]
            out.append(
                {
                    "engine": engine,
                    "width": width,
                    "views": int(np.count_nonzero(~views.test)),
                    "budget": budget,
                    "steps": result.steps,
                    "rays": result.rays,
                    "processor_seconds": round(spent.processor, 3),
                    "psnr": result.timeline[-1]["psnr"] if result.timeline else None,
                    "timeline": result.timeline,
                }
            )
    return out


def tsdf_frames(voxel_size: float = 0.02, frames: int = 6, rounds: int = 3) -> dict[str, float] | None:
    """`tsdf.benchmark.compare_with_bare_loop` on pictures of a plane at 320×240; None where Open3D cannot be used."""
    try:
        from fieldfuse.tsdf.benchmark import compare_with_bare_loop
        from fieldfuse.tsdf.frames import DepthFrame
    except (ImportError, OSError):
        return None
    camera = Intrinsics(320, 240, 272.0, 272.0, 160.0, 120.0)
    rows, columns = np.mgrid[:240, :320]
    # A corrugated wall: depth that is not constant, as a room's is not.
    depth = (1.6 + 0.15 * np.sin(columns / 17) * np.cos(rows / 23)).astype(np.float32)
    colour = np.stack([columns % 256, rows % 256, (rows + columns) % 256], 2).astype(np.uint8)
    shown = []
    for index in range(frames):
        pose = np.eye(4)
        pose[0, 3] = 0.03 * index
        shown.append(DepthFrame(depth, colour, camera, camera, pose))
    try:
        return compare_with_bare_loop(shown, voxel_size, 3.0, rounds)
    except InputError:
        return None
