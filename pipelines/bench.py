"""`fieldfuse bench …`: how fast this machine is at what Fieldfuse does; and published protocols (see `bench_suite`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse.pipelines.bench_suite import add_suites
from fieldfuse.pipelines.options import Quiet, Threads

if TYPE_CHECKING:
    from fieldfuse.evaluation.speed import Case

app = typer.Typer(help="Benchmarks on this machine.", no_args_is_help=True, add_completion=False, rich_markup_mode=None)
PARTS = ("step", "growth", "render", "threads", "order", "lookup", "convolution", "keyframe", "tsdf", "jobs")


@app.callback()
def _bench() -> None:
    """Benchmarks on this machine."""


@app.command()
def speed(
    to: Annotated[Path | None, typer.Option("--json", help="Write everything to this JSON file.", show_default=False)] = None,
    threads: Threads = None,
    parts: Annotated[str | None, typer.Option(help=f"Comma-separated part of {','.join(PARTS)}.", show_default=False)] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Repetitions; the best counts.")] = 5,
    budget: Annotated[float, typer.Option(min=0.5, help="Seconds of each whole job.")] = 5,
    quiet: Quiet = False,
) -> None:
    """Time each part beside a reference loop in the same run, and say how many times faster it is."""
    from fieldfuse.pipelines.thread_limits import bound_threads

    bound_threads({"flags": {"threads": threads}})
    data = measure(chosen(parts), threads, repetitions, budget, quiet)
    if to is not None:
        from fieldfuse.files import write_json

        write_json(to, data)
    if not quiet:
        show(data)


def chosen(parts: str | None) -> tuple[str, ...]:
    """The parts that are asked for.

    Raises:
        InputError: an unknown one.
    """
    from fieldfuse.errors import InputError

    wanted = PARTS if parts is None else tuple(name.strip() for name in parts.split(",") if name.strip())
    for name in wanted:
        if name not in PARTS:
            raise InputError(f"there is no benchmark {name!r}; known are {', '.join(PARTS)}")
    return wanted


def measure(parts: tuple[str, ...], threads: int | None, repetitions: int, budget: float, quiet: bool) -> dict[str, Any]:
    """Everything as plain data.

    Returns:
        `machine` (kind, versions, threads, load before and after), `cases`, fitted `growth` exponents, `tsdf` and `jobs`.
    """
    import os
    import time

    from fieldfuse.evaluation import speed_cases, speed_growth, speed_jobs
    from fieldfuse.evaluation.speed import machine
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.job import set_threads

    threads = threads or os.cpu_count() or 1
    set_threads(threads)
    data: dict[str, Any] = {"machine": machine(threads), "cases": []}
    makers = {
        "step": lambda: speed_cases.step_cases(repetitions=repetitions),
        "growth": lambda: speed_growth.growth_cases(repetitions=repetitions),
        "render": lambda: speed_cases.render_cases(repetitions=repetitions),
        "threads": lambda: speed_cases.thread_cases(max(threads, 2), repetitions=repetitions),
        "order": lambda: [speed_cases.order_case(repetitions=repetitions)],
        "lookup": lambda: [speed_cases.lookup_case(repetitions=repetitions)],
        "convolution": lambda: [speed_cases.convolution_case(repetitions=repetitions)],
        "keyframe": lambda: [speed_cases.key_frame_case(repetitions=min(repetitions, 3))],
    }
    progress = make_progress(quiet)
    cases: list[Case] = []
    with progress.listening():
        progress.begin("measuring")
        start = time.monotonic()
        for number, part in enumerate(parts):
            progress.check()
            progress.update(number, len(parts), part)
            if part in makers:
                cases.extend(makers[part]())
            elif part == "tsdf":
                data["tsdf"] = speed_jobs.tsdf_frames()
            else:
                data["jobs"] = speed_jobs.fit_curves(budget, threads, progress)
        progress.finish("measuring", time.monotonic() - start, False)
    data["cases"] = [case.to_dict() for case in cases]
    data["growth"] = growth(cases)
    data["machine"]["load_after"] = machine(threads)["load"]
    return data


def growth(cases: list[Case]) -> dict[str, float]:
    """Exponent of the processor time a unit over the size (the lattice's side, or what the case names), for each kind of case that was
    measured at several sizes."""
    from fieldfuse.evaluation.speed import exponent

    out = {}
    for name in dict.fromkeys(case.name for case in cases):
        same = [case for case in cases if case.name == name]
        if len(same) > 1:
            sizes = [float(case.size.rstrip("³").split()[0]) for case in same]
            out[name] = round(exponent(sizes, [case.ours.processor / case.units for case in same]), 3)
    return out


def show(data: dict[str, Any]) -> None:
    """Tables on standard output."""
    from rich.console import Console
    from rich.table import Table

    from fieldfuse.evaluation.words import counted

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("what", "size", "a unit, processor", "wall", "times faster", "than"):
        table.add_column(column, justify="right" if column in ("a unit, processor", "wall", "times faster") else "left", overflow="fold")
    for case in data["cases"]:
        times = [_time(1e6 * case["ours"][clock] / case["units"], case["unit"]) for clock in ("processor", "wall")]
        table.add_row(case["name"], case["size"], *times, f"{case['ratio']:.2f}", case["against"])
    if data.get("tsdf"):
        tsdf = data["tsdf"]
        each = _time(1e6 / tsdf["ours"], "frame")
        table.add_row("TSDF frame", f"{tsdf['voxel_size']:g}", "", each, f"{tsdf['ratio']:.2f}", "a bare VoxelBlockGrid loop")
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=140)
    console.print(table)
    for job in data.get("jobs", []):
        reached = "no held-out pixel" if job["psnr"] is None else f"{job['psnr']:.1f} dB"
        what = f"fit of {job['views']} views {job['width']} wide, {job['engine']}, {job['budget']:g} s"
        console.print(f"{what}: {reached}, {job['rays']:,} rays")
    if data["growth"]:
        console.print(
            "time a unit grows with the size to the power: " + ", ".join(f"{name} {b:+.2f}" for name, b in data["growth"].items())
        )
    about = data["machine"]
    threads = counted(about["threads"], "thread")
    console.print(f"{about['machine']}, {about['cores']} cores, {threads}, load {about['load']} to {about['load_after']}")


def _time(microseconds: float, unit: str) -> str:
    if microseconds >= 1e4:
        return f"{microseconds / 1e3:.1f} ms a {unit}"
    return f"{microseconds:.3g} µs a {unit}" if microseconds >= 0.1 else f"{microseconds * 1e3:.3g} ns a {unit}"


add_suites(app)
