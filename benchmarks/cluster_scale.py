"""`python -m benchmarks.cluster_scale --measured DIR`: what 10,000 captures, and a site of a square kilometre, would take. Simulated.

Measured are the costs of a run of a batch, of a cell and of a pixel (by `benchmarks.batch` and `benchmarks.cells` with `--out DIR`), and
of a task that does nothing and of a report (here; processor time of this process and all of Ray's). Everything else is assumed: the
constants below. Tasks are put on cores as these become free, the machine that starts them takes its time for each, and nodes are lost now
and then.
"""

from __future__ import annotations

import heapq
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import psutil
import typer

from benchmarks.experiment import Experiment, Folder, Row, application, markdown, program, section, show
from fieldfuse.cluster import Link, Task, has_ray, open_workers
from fieldfuse.cluster.tasks import LISTEN
from fieldfuse.errors import InputError
from fieldfuse.files import read_json
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet
from fieldfuse.training.cells.scene import PIXELS_A_CELL
from fieldfuse.volume.topology import BLOCK, MAX_TABLE_CELLS

NOTHING = 2000  # tasks that do nothing, and reports of one task, to see what these cost
NODES = (10, 100, 500)
CORES = 16  # of a node; a run or a cell has one
DAYS_TO_FAILURE = 10.0  # of a node, the mean
AGAIN = 0.5  # of what a task has done when its node is lost is done again: one stage of a run; a cell begins anew, but half-way on average
CAPTURES, CORE_SECONDS, SPREAD = 10_000, 300.0, 0.5  # runs, the median of their work, its deviation in natural logarithms
PICTURES, MEGAPIXELS = 10_000, 2.0  # of the site
SIDE, HEIGHT = 1000.0, 20.0  # metres: the site, and what stands on it
THREADS = 0.6  # of the speed of one thread is that of each of a node's, in the coarse fit
HOUR = 3600.0
TITLES = {
    "what": "",
    "nodes": "nodes",
    "hours": "hours",
    "core_hours": "core hours of work",
    "used": "of all cores' time",
    "lost": "tasks that lost their node",
    "head": "cores that the head needs",
    "remarks": "",
}


def run(
    measured: Annotated[Path, typer.Option(help="Folder with batch.json and cells.json of those benchmarks.")],
    out: Folder = None,
    quiet: Quiet = False,
) -> None:
    """Fit the model to what was measured, and simulate."""
    if not has_ray():
        raise InputError('this benchmark needs the package ray; install it (pip install "fieldfuse[cluster]")')
    progress = make_progress(quiet)
    costs = {**fitted(measured), **of_the_head()}
    plan: list[Row] = [{"what": what, "nodes": count} for what in ROWS for count in NODES]
    experiment = Experiment("cluster_scale", plan, lambda entry: ROWS[entry["what"]](entry["nodes"], costs), table, about={"costs": costs})
    show(section(experiment.conduct(out, progress, 1), table), quiet)


def fitted(folder: Path) -> dict[str, float]:
    """Seconds of a core, beside the work itself, for each run of a batch and for each cell; core seconds, and bytes, of a pixel; and the
    coarse fit's share of a scene's seconds."""
    batch, rows = read_json(folder / "batch.json")["rows"][0], read_json(folder / "cells.json")["rows"]
    cells, whole = ({row["way"]: row for row in rows}[way] for way in ("cells", "one piece"))
    pixels = 1e6 * whole["megapixels"]
    return {
        "run": batch["beside"] / batch["captures"],
        "cell": (cells["seconds"] - cells["budget"]) / cells["cells"],
        "coarse": cells["coarse_seconds"] / cells["budget"],
        "pixel": whole["budget"] / pixels,
        "pixel_bytes": 1e6 * whole["memory_mb"] / pixels,
    }


def talk(reports: int, link: Link) -> None:
    """A task that does nothing but report."""
    for number in range(reports):
        link.report({"done": number, "total": reports})


def of_the_head() -> dict[str, float]:
    """Processor seconds for a task that does nothing, and for a report of one; all that Ray does for it is counted, wherever."""
    with open_workers(cpus=1) as workers:
        for _ in workers.run(talk, [Task("first", 1)]):
            pass  # a worker is there now
        begun = _processor_times()
        for _ in workers.run(talk, [Task(str(number), 0) for number in range(NOTHING)]):
            pass
        between = _processor_times()
        for _ in workers.run(talk, [Task("talking", NOTHING)]):
            pass
        return {"task": _spent(begun, between) / NOTHING, "report": _spent(between, _processor_times()) / NOTHING}


def _processor_times() -> dict[int, float]:
    this = psutil.Process()
    times = {one.pid: one.cpu_times() for one in (this, *this.children(recursive=True))}
    return {pid: time.user + time.system for pid, time in times.items()}


def _spent(before: dict[int, float], after: dict[int, float]) -> float:
    return sum(seconds - before.get(pid, 0.0) for pid, seconds in after.items())


def simulated(work: list[float], slots: int, before: float, a_task: float) -> tuple[float, int]:
    """Seconds until the last of some tasks ends, and how many lost their node.

    Args:
        work: seconds of each. before: seconds before each on its core. a_task: seconds of the head for each, one after the other.
    """
    random, free, losses, head, end = np.random.default_rng(0), [0.0] * slots, 0, 0.0, 0.0
    for seconds in work:
        head = max(head, free[0]) + a_task
        took, left = before + seconds, random.exponential(DAYS_TO_FAILURE * 24 * HOUR)
        if left < took:
            losses, took = losses + 1, took + AGAIN * left
        end = max(end, done := max(heapq.heappop(free), head) + took)
        heapq.heappush(free, done)
    return end, losses


def many_captures(nodes: int, costs: dict[str, float]) -> Row:
    """`CAPTURES` runs."""
    slots = nodes * CORES
    work = np.random.default_rng(1).lognormal(math.log(CORE_SECONDS), SPREAD, CAPTURES).tolist()
    end, losses = simulated(work, slots, costs["run"], costs["task"])
    reports = min(slots, CAPTURES) / LISTEN * costs["report"]
    return {"hours": end / HOUR, "core_hours": sum(work) / HOUR, "used": sum(work) / (end * slots), "lost": losses, "head": reports}


def large_site(nodes: int, costs: dict[str, float]) -> Row:
    """The site: its coarse fit on one node, then its cells on all."""
    pixels, slots = 1e6 * PICTURES * MEGAPIXELS, nodes * CORES
    count, seconds = round(pixels / PIXELS_A_CELL), pixels * costs["pixel"]
    coarse = costs["coarse"] * seconds / (CORES * THREADS)
    end, losses = simulated([(1 - costs["coarse"]) * seconds / count] * count, slots, costs["cell"], costs["task"])
    voxel = (SIDE**2 * HEIGHT / MAX_TABLE_CELLS) ** (1 / 3) / BLOCK  # the table of blocks is a box
    memory = f"{pixels * costs['pixel_bytes'] / 1e9:.0f} GB of memory"
    remarks = f"{count:,} cells; coarse fit {coarse / HOUR:.1f} h, {memory}; voxels ≥ {100 * voxel:.0f} cm"
    whole, reports = coarse + end, min(slots, count) / LISTEN * costs["report"]
    used = seconds / (whole * slots)
    return {"hours": whole / HOUR, "core_hours": seconds / HOUR, "used": used, "lost": losses, "head": reports, "remarks": remarks}


ROWS = {f"{CAPTURES:,} captures": many_captures, "1 km²": large_site}


def table(data: Row) -> str:
    """Markdown: what was measured, and a line a simulation."""
    costs = data["costs"]
    known = (
        f"Measured: {costs['run']:.2f} s beside each run, {costs['cell']:.2f} s for each cell, of the head {1e3 * costs['task']:.1f} ms "
        f"for a task and {1e3 * costs['report']:.1f} ms for a report, {costs['coarse']:.0%} of a scene's seconds for its coarse fit, "
        f"{1e6 * costs['pixel']:.2f} core seconds and {costs['pixel_bytes']:.1f} MB for a million pixels."
    )
    return known + "\n\n" + markdown(list(TITLES.values()), [[_cell(name, row.get(name, "")) for name in TITLES] for row in data["rows"]])


def _cell(name: str, value: Any) -> str:
    if name == "used":
        return f"{value:.0%}"
    return f"{value:,.1f}" if isinstance(value, float) else str(value)


app = application(run)
if __name__ == "__main__":
    program(app)
