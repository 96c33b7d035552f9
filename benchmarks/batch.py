"""`python -m benchmarks.batch --out DIR`: what `fieldfuse batch` costs beside single runs, and whether it gives the same.

Small simulated captures and a broken one, first as single runs, then as a batch on a pool of this machine, in which the worker of one run
is killed twice. Fits are bounded by steps, so that equal seeds give equal scores however busy the machine is; costs are processor time.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import psutil
import typer

from benchmarks.experiment import Experiment, Row, application, markdown, program, section, show
from fieldfuse.cluster import has_ray
from fieldfuse.errors import InputError
from fieldfuse.files import read_json, remove
from fieldfuse.pipelines.batch_run import MARK, RUN
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Out, Quiet
from fieldfuse.progress import Progress
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate

FILM = {"scene": "table", "camera": {"width": 160, "height": 120}, "path": {"kind": "orbit", "frames": 16}}
OPTIONS = ("--threads", "1", "--init", "classical", "--budget", "600", "--set", "effects=off", "--set", "export.formats=[points]")
FIT = ("--set", "fit.passes=null", "--set", "fit.depth_from=off", "--set", "field.resolution=64")
TIMED = "seconds"  # what entries of scores have in their names that are times
EVERY = 0.1  # seconds between two looks at all processes
DEATHS = 2
TITLES = ("captures", "equal to single runs", "failed, with a sentence", "exit code", "worker killed", "single runs", "Ray and the rest")


def batch(
    out: Out,
    captures: Annotated[int, typer.Option(min=3, max=200, help="Captures, one of which is broken.")] = 24,
    iterations: Annotated[int, typer.Option(min=1, help="Steps of each fit.")] = 4000,
    quiet: Quiet = False,
) -> None:
    """Run captures one by one and as a batch; compare scores and processor time."""
    if not has_ray():
        raise InputError('this benchmark needs the package ray; install it (pip install "fieldfuse[cluster]")')
    progress = make_progress(quiet)
    plan = [{"captures": captures, "iterations": iterations}]

    def run(entry: Row) -> Row:
        return measured(out, entry["captures"], entry["iterations"], progress)

    show(section(Experiment("batch", plan, run, table).conduct(out, progress, 1), table), quiet)


def table(data: Row) -> str:
    return markdown(TITLES, map(_line, data["rows"]))


def _line(row: Row) -> list[str]:
    share = row["beside"] / row["single"]
    beside = f"{row['beside']:.1f} s ({100 * share:.1f}% of the single runs')"
    failed = f"{len(row['failed'])}: {'; '.join(row['failed'])}"
    equal = f"{row['equal']} of {row['captures'] - 1}"
    return [str(row["captures"]), equal, failed, str(row["code"]), f"{row['killed']} times", f"{row['single']:.0f} s", beside]


def measured(out: Path, count: int, iterations: int, progress: Progress) -> Row:
    """Reports that are equal, sentences of failed runs, exit code, and seconds of processor time: `single` of single runs, `beside` of all
    processes of the batch that are no runs, `runs` of those that are (what killed runs had made of a stage is made twice)."""
    sources = [out / "captures" / f"c{number:02d}" for number in range(count)]
    for number, source in enumerate(sources[:-1]):
        progress.update(number, 3 * count, "simulating")
        if not (source / "transforms.json").is_file():
            simulate(scene_file({**FILM, "seed": number}, "the benchmark"), source)
    sources[-1].mkdir(parents=True, exist_ok=True)
    (sources[-1] / "transforms.json").write_text("{", encoding="utf-8")
    options = [*OPTIONS, *FIT, "--set", f"fit.iterations={iterations}"]
    progress.update(count, 3 * count, "single runs")
    remove(out / "single")
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # as many at once as in the batch: cores that are shared make each run dearer
        commands = [["run", str(source), "--out", str(out / "single" / source.name), *options] for source in sources]
        single = sum(pool.map(spent, commands))
    progress.update(2 * count, 3 * count, "batch")
    remove(out / "batch")
    found = whole_batch(["batch", *map(str, sources), "--out", str(out / "batch"), *options], out / "batch" / sources[1].name)
    rows = read_json(out / "batch" / "batch.json")["runs"]
    equal = sum(scores(out / "batch" / source.name) == scores(out / "single" / source.name) for source in sources[:-1])
    failed = [f"{row['name']}: {row['error'].replace(str(out.absolute()), 'OUT')}" for row in rows if row["state"] == "failed"]
    return {"equal": equal, "failed": failed, "single": round(single, 2), **found}


def scores(folder: Path) -> Any:
    """A report's scores, without times; None where there is no report."""
    path = folder / "report.json"
    return {key: value for key, value in read_json(path)["evaluation"]["field"].items() if TIMED not in key} if path.is_file() else None


def spent(words: Sequence[str]) -> float:
    """Processor seconds of a command, with all processes that it starts."""
    process = subprocess.Popen([sys.executable, "-m", "fieldfuse", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, _, usage = os.wait4(process.pid, 0)
    return usage.ru_utime + usage.ru_stime


def whole_batch(words: Sequence[str], victim: Path) -> Row:
    """A batch, with the worker killed twice that makes the run in the folder `victim`."""
    process = subprocess.Popen([sys.executable, "-m", "fieldfuse", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    seconds: dict[tuple[int, float], tuple[bool, float]] = {}  # process → whether it is a run or of one, seconds
    killed: list[int] = []
    watcher = threading.Thread(target=_watch, args=(process.pid, victim, seconds, killed), daemon=True)
    watcher.start()
    said, errors = process.communicate()
    watcher.join(5)
    if "Traceback" in errors or f"{MARK}something unexpected" in errors:
        raise InputError(f"the batch went wrong: {errors[-500:]}")
    runs, beside = (sum(value for is_run, value in seconds.values() if is_run is which) for which in (True, False))
    return {"code": process.returncode, "killed": len(killed), "runs": round(runs, 2), "beside": round(beside, 2), "said": said[-2000:]}


def _watch(pid: int, victim: Path, seconds: dict[tuple[int, float], tuple[bool, float]], killed: list[int]) -> None:
    """Look at all processes of a batch until it ends; kill the worker of one run when that is at work."""
    while psutil.pid_exists(pid):
        try:
            there = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
        except psutil.Error:
            return
        runs: dict[int, bool] = {}
        for one in there:
            try:
                with one.oneshot():
                    command, parent, used = one.cmdline(), one.ppid(), one.cpu_times()
                    runs[one.pid] = RUN in command or runs.get(parent, False)
                    seconds[one.pid, one.create_time()] = (runs[one.pid], used.user + used.system)
                at_work = RUN in command and str(victim.absolute()) in command and (victim / "stages" / "capture.json").is_file()
                if at_work and len(killed) < DEATHS and parent not in killed:
                    os.kill(parent, signal.SIGKILL)
                    killed.append(parent)
            except (psutil.Error, ProcessLookupError):
                continue
        time.sleep(EVERY)


app = application(batch)
if __name__ == "__main__":
    program(app)
