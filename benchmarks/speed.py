"""`python -m benchmarks.speed`: each part beside a reference loop in the same run, and how many times faster it is.

Beside the microbenchmarks of `speed_cases` these are whole jobs on a small simulated capture: quality over seconds for both engines, and
TSDF frames beside a bare loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from itertools import product
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks import speed_cases
from benchmarks.experiment import Experiment, Folder, Row, application, chosen, markdown, program, section, show
from benchmarks.timing import Case, exponent, once
from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.config import load_settings
from fieldfuse.errors import InputError
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.job import set_threads
from fieldfuse.pipelines.options import Quiet, Threads
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress

FRAMES = 16
WIDTHS = (48, 96)  # of the images; they are 4:3
JOBS, TSDF = "jobs", "tsdf"
CASES: dict[str, Callable[[int, int], Iterable[Case]]] = {  # part → threads, repetitions → cases
    "step": lambda threads, times: speed_cases.step_cases(repetitions=times),
    "growth": lambda threads, times: speed_cases.growth_cases(times),
    "render": lambda threads, times: speed_cases.render_cases(repetitions=times),
    "threads": lambda threads, times: speed_cases.thread_cases(max(threads, 2), repetitions=times),
    "order": lambda threads, times: [speed_cases.order_case(repetitions=times)],
    "lookup": lambda threads, times: [speed_cases.lookup_case(repetitions=times)],
    "convolution": lambda threads, times: [speed_cases.convolution_case(repetitions=times)],
    "keyframe": lambda threads, times: [speed_cases.key_frame_case(repetitions=min(times, 3))],
}
PARTS = (*CASES, TSDF, JOBS)


def speed(
    out: Folder = None,
    threads: Threads = None,
    parts: Annotated[str | None, typer.Option(help=f"Comma-separated part of {','.join(PARTS)}.", show_default=False)] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Repetitions; the best counts.")] = 5,
    budget: Annotated[float, typer.Option(min=0.5, help="Seconds of each whole job.")] = 5,
    quiet: Quiet = False,
) -> None:
    """Time each part beside a reference loop in the same run, and show how many times faster it is."""
    plan = [{"part": part} for part in chosen(parts, PARTS, "--parts")]
    count = threads or os.cpu_count() or 1
    set_threads(count)
    progress = make_progress(quiet)

    def run(entry: Row) -> Row:
        if entry["part"] == TSDF:
            return {TSDF: tsdf_frames()}
        if entry["part"] == JOBS:
            return {JOBS: fit_curves(budget, count, progress)}
        cases = list(CASES[entry["part"]](count, repetitions))
        return {"cases": [case.to_dict() for case in cases], "growth": growth(cases)}

    data = Experiment("speed", plan, run, table).conduct(out, progress, count)
    show(section(data, table), quiet)


def growth(cases: list[Case]) -> dict[str, float]:
    """Exponent of the processor time a unit over the size (the lattice's side, or what the case names), for each kind of case that was
    measured at several sizes."""
    out = {}
    for name in dict.fromkeys(case.name for case in cases):
        same = [case for case in cases if case.name == name]
        if len(same) > 1:
            sizes = [float(case.size.rstrip("³").split()[0]) for case in same]
            out[name] = round(exponent(sizes, [case.ours.processor / case.units for case in same]), 3)
    return out


def demo_views(width: int, frames: int = FRAMES) -> tuple[Views, Scene]:
    """The demo room filmed by hand; every 8th view is held out."""
    from fieldfuse.simulate.demo import demo_scene, hand_held

    height = width * 3 // 4
    camera, poses, room = Intrinsics(width, height, 0.85 * width, 0.85 * width, width / 2, height / 2), hand_held(frames), demo_scene()
    images = [room.picture(camera, pose) for pose in poses]
    views = Views([f"{i:03d}" for i in range(frames)], images, [camera] * frames, poses, np.arange(frames) % 8 == 0)
    centre, half = np.array([0.2, 0.2, 0.6]), np.array([1.6, 1.6, 1.0])
    return views, Scene(Similarity.identity(), centre, half, 2.0, 0.5, 6.0, 0.1, True, True)


def fit_curves(budget: float, threads: int, progress: Progress = SILENT) -> list[Row]:
    """Fit the demo room with each engine at each image size for `budget` seconds.

    Returns:
        a row a job: `engine`, `width`, `steps`, `rays`, `processor_seconds`, final `psnr` and the `timeline` of (seconds, psnr).
    """
    from fieldfuse.training.engine import warm_up
    from fieldfuse.training.fit import fit_field

    settings = load_settings("fast", pairs=[f"budget={budget}", f"threads={threads}", "field.resolution=128"])
    warm_up(settings, progress)
    out: list[Row] = []
    for width, engine in product(WIDTHS, ("numba", "torch")):
        progress.check()
        views, scene = demo_views(width)
        settings.engine, settings.device = engine, "cpu"
        results: list[Any] = []
        spent = once(lambda: results.append(fit_field(views, scene, settings)))  # noqa: B023
        (result,) = results
        row = {"engine": engine, "width": width, "views": int(np.count_nonzero(~views.test)), "budget": budget, "steps": result.steps}
        row |= {"rays": result.rays, "processor_seconds": round(spent.processor, 3), "timeline": result.timeline}
        out.append({**row, "psnr": result.timeline[-1]["psnr"] if result.timeline else None})
    return out


def tsdf_frames(voxel_size: float = 0.02, frames: int = 6, rounds: int = 3) -> dict[str, float] | None:
    """`tsdf_loop.compare_with_bare_loop` on images of a corrugated wall at 320×240; None where Open3D cannot be used."""
    try:
        from benchmarks.tsdf_loop import compare_with_bare_loop
        from fieldfuse.tsdf.volume import DepthFrame
    except (ImportError, OSError):
        return None
    camera = Intrinsics(320, 240, 272.0, 272.0, 160.0, 120.0)
    rows, columns = np.mgrid[:240, :320]
    depth = (1.6 + 0.15 * np.sin(columns / 17) * np.cos(rows / 23)).astype(np.float32)  # not constant, as a room's is not
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


def table(data: Row) -> str:
    """Markdown: a line for each case, then the whole jobs and the exponents of growth."""
    lines, notes = [], []
    for row in data["rows"]:
        for case in row.get("cases", []):
            times = [_time(1e6 * case["ours"][clock] / case["units"], case["unit"]) for clock in ("processor", "wall")]
            lines.append([case["name"], case["size"], *times, f"{case['ratio']:.2f}", case["against"]])
        if row.get(TSDF):
            each = _time(1e6 / row[TSDF]["ours"], "frame")
            size = f"{row[TSDF]['voxel_size']:g}"
            lines.append(["TSDF frame", size, "", each, f"{row[TSDF]['ratio']:.2f}", "a bare VoxelBlockGrid loop"])
        for job in row.get(JOBS, []):
            score = "no held-out pixel" if job["psnr"] is None else f"{job['psnr']:.1f} dB"
            what = f"fit of {job['views']} views {job['width']} wide, {job['engine']}, {job['budget']:g} s"
            notes.append(f"- {what}: {score}, {job['rays']:,} rays\n")
        notes += [f"- {name}: time a unit grows with the size to the power {power:+.2f}\n" for name, power in row.get("growth", {}).items()]
    return "\n".join([markdown(["what", "size", "a unit, processor", "wall", "times faster", "than"], lines), "".join(notes)])


def _time(microseconds: float, unit: str) -> str:
    if microseconds >= 1e4:
        return f"{microseconds / 1e3:.1f} ms a {unit}"
    return f"{microseconds:.3g} µs a {unit}" if microseconds >= 0.1 else f"{microseconds * 1e3:.3g} ns a {unit}"


app = application(speed)
if __name__ == "__main__":
    program(app)
