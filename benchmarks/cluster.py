"""`python -m benchmarks.cluster CAPTURE --out DIR`: cells of one scene on a Ray cluster of two nodes, a core each, on this machine.

Every row is a `fieldfuse run`. Its fit is timed by the clock, so nothing else may run meanwhile. Rows:

- `two workers`: `--cells` with `--budget`, on both nodes;
- `one piece`: without cells, two threads, as many seconds as the row before took;
- `steps, …`: as many steps instead of seconds, so that equal fields are equal bytes: on one node, on two, on two of which one is lost
  while it works and another one joins.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.experiment import Experiment, Row, application, markdown, program, section, show
from fieldfuse.cluster import STORE, has_ray
from fieldfuse.errors import InputError
from fieldfuse.files import read_json, remove
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Out, Quiet

WAYS = ("two workers", "one piece", "steps, one worker", "steps, two workers", "steps, a node lost and one added")
EXACT = ("--set", "fit.depth_from=off", "--set", "fit.moving=off", "--set", "fit.passes=null")  # matching goes by the clock
USUAL = ("--set", "export.formats=[points]", "--quiet")
NODE: dict[str, Any] = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": STORE}
EVERY = 1.0  # seconds between two looks at a run
TITLES = {
    "way": "",
    "psnr": "PSNR",
    "seconds": "seconds of the fit",
    "cells_seconds": "of these, cells",
    "store_mb": "object store, MB",
    "field": "field",
}


def run(
    capture: Annotated[Path, typer.Argument(help="A posed capture.")],
    out: Out,
    budget: Annotated[float, typer.Option(help="Seconds of the fit.")] = 60.0,
    iterations: Annotated[int, typer.Option(help="Steps of the fits that are bounded by steps.")] = 3000,
    count: Annotated[int, typer.Option("--cells", min=2, help="Cells.")] = 8,
    image_size: Annotated[int, typer.Option(help="Long side of the images in pixels.")] = 320,
    quiet: Quiet = False,
) -> None:
    """Fit a capture in cells on a cluster of this machine, and in one piece."""
    if not has_ray():
        raise InputError('this benchmark needs the package ray; install it (pip install "fieldfuse[cluster]")')
    progress = make_progress(quiet)
    plan = [{"capture": capture.name, "image_size": image_size, "cells": count, "budget": budget, "way": way} for way in WAYS]
    bench = Bench(capture, out, ["--image-size", str(image_size), *USUAL], budget, iterations, count)
    show(section(Experiment("cluster", plan, bench.row, table, state=str(iterations)).conduct(out, progress, 2), table), quiet)


@dataclass
class Bench:
    """Runs of one capture."""

    capture: Path
    out: Path
    options: list[str]
    budget: float
    iterations: int
    count: int

    def row(self, entry: Row) -> Row:
        way = entry["way"]
        folder = self.out / way.replace(",", "").replace(" ", "_")
        remove(folder)
        options = [*self.options, "--threads", "2"]
        if way == "one piece":
            seconds = fit_seconds(self.out / "two_workers")
            execute(self.words(folder, [*options, "--budget", str(round(seconds))]))
            return found(folder)
        bound = ["--budget", str(self.budget)]
        if way != "two workers":
            bound = ["--budget", "3600", *EXACT, "--set", f"fit.iterations={self.iterations}"]
        with nodes(1 if way == "steps, one worker" else 2) as cluster:
            words = self.words(folder, [*options, *bound, "--cells", str(self.count), "--address", cluster.address])
            if way != WAYS[-1]:
                execute(words)
                return found(folder)
            with Store(cluster.address) as store:  # only here: to look takes seconds
                execute(words, lambda process: replace_node(process, cluster, folder / "cells"))
            return {**found(folder), "store_mb": store.most}

    def words(self, folder: Path, options: list[str]) -> list[str]:
        return [sys.executable, "-m", "fieldfuse", "run", str(self.capture), "--out", str(folder), *options]


def execute(words: list[str], meanwhile: Callable[[subprocess.Popen[str]], None] | None = None) -> None:
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if meanwhile is not None:
        meanwhile(process)
    _, said = process.communicate()
    if process.returncode:
        raise InputError(f"{' '.join(words[3:6])} ended with exit code {process.returncode}: {said[-500:]}")


@contextmanager
def nodes(count: int) -> Iterator[Any]:
    os.environ.update(RAY_USAGE_STATS_ENABLED="0", RAY_DEDUP_LOGS_SKIP_REGEX=".")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args=NODE)
    try:
        for _ in range(count - 1):
            made.add_node(**NODE)
        yield made
    finally:
        made.shutdown()


def replace_node(process: subprocess.Popen[str], cluster: Any, folder: Path) -> None:
    """Once two cells are fitted, the second node is taken away; a little later another one is added. (Ray adds none from a thread.)"""
    while len(list(folder.glob("cell-*.json"))) < 2:
        if process.poll() is not None:
            return
        time.sleep(EVERY)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    time.sleep(3 * EVERY)
    cluster.add_node(**NODE)


class Store:
    """The most that the cluster's object stores hold while a run is at work, as `ray memory` says."""

    def __init__(self, address: str) -> None:
        self.address, self.most, self._done = address, 0.0, threading.Event()

    def __enter__(self) -> Store:
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        command = [str(Path(sys.executable).parent / "ray"), "memory", "--stats-only", "--address", self.address]
        while not self._done.wait(15 * EVERY):
            said = subprocess.run(command, capture_output=True, text=True, check=False).stdout
            if "Spilled" in said:
                raise InputError(f"Ray's object store was spilled: {said[-300:]}")
            self.most = max([self.most, *(float(size) for size in re.findall(r"Plasma memory usage ([\d.]+) MiB", said))])


def fit_seconds(folder: Path) -> float:
    return float(read_json(folder / "stages" / "field.json")["seconds"])


def found(folder: Path) -> Row:
    cells, plan = folder / "cells", folder / "cells" / "plan.json"
    row = {"psnr": read_json(folder / "report.json")["evaluation"]["field"]["psnr"], "seconds": round(fit_seconds(folder), 1)}
    row["field"] = hashlib.sha256((folder / "field.safetensors").read_bytes()).hexdigest()[:8]
    if plan.is_file():
        row["cells_seconds"] = round(max(path.stat().st_mtime for path in cells.glob("cell-*.json")) - plan.stat().st_mtime, 1)
    return row


def table(data: Row) -> str:
    """Markdown: a line a way."""
    return markdown(list(TITLES.values()), [[_cell(name, row.get(name, "")) for name in TITLES] for row in data["rows"]])


def _cell(name: str, value: Any) -> str:
    return f"{value:.2f} dB" if name == "psnr" else f"{value:g}" if isinstance(value, float) else str(value)


app = application(run)
if __name__ == "__main__":
    program(app)
