"""`fieldfuse batch SOURCE… --out DIR`: many captures, each an ordinary run, on this machine or on those of a Ray cluster."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse import __version__
from fieldfuse.errors import FieldfuseError, InputError, Interrupted, OutputError
from fieldfuse.pipelines.options import RUN, ClusterOptions, Options, Out, bound_threads, show, takes, words

if TYPE_CHECKING:
    from fieldfuse.cluster import Message, Outcome, Task, Workers
    from fieldfuse.pipelines.batch_plan import Planned
    from fieldfuse.pipelines.batch_show import Display, Row

Sources = Annotated[
    list[Path], typer.Argument(help="Captures, or lists of them (.csv): a column source, name, and options of run.", show_default=False)
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be run, and what it takes; start nothing.")]
PAGE_EVERY = 2.0  # seconds between two versions of the page, or
PAUSES = 20  # times as long as it takes to write one: of 10,000 runs that is a second
MOST_UPLOAD = 2 * 2**30  # bytes of a capture that is sent
GB = 1e9
RESTING = {"stage": None, "share": None, "left": None}  # of a run that is not at work


@takes(RUN)
def batch(sources: Sources, out: Out, cluster: ClusterOptions, dry_run: DryRun = False, *, options: Options) -> None:
    """Run many captures, on this machine or on a Ray cluster, each into a run folder of its own in --out, with one page for all.

    All options of run are passed on. Run the same command again after an interruption: what is finished is not run again.
    """
    bound_threads({"flags": {"threads": 1}})  # of this process, which only waits
    from fieldfuse.cluster import open_workers
    from fieldfuse.pipelines.batch_plan import estimated, plan
    from fieldfuse.pipelines.folder import is_run_folder

    if is_run_folder(out):
        raise InputError(f"{out} is the folder of one run; choose another --out, in which each run gets a folder")
    runs = estimated(plan(sources, options), seconds=dry_run)
    if dry_run:
        with open_workers(cluster.address, pool=False) as workers:
            data = {"runs": [described(one, cluster, workers, len(runs)) for one in runs]}
            show(data, options, lambda: costs(data["runs"], workers, tasks_of(runs, cluster, workers)))
        return
    done = Batch(out, runs, cluster)
    with open_workers(cluster.address, pool=len(done.todo) > 1) as workers:
        data = done.conduct(workers, options.quiet)
    show(data, options, lambda: lines(data, out))
    if any(row["state"] in ("stopped", "waiting") for row in data["runs"]):
        raise Interrupted("stopped on request; what was finished is kept, run the same command again to go on")
    if any(row["state"] == "failed" for row in data["runs"]):
        raise typer.Exit(1)


def cores(cluster: ClusterOptions, workers: Workers, runs: int) -> int:
    """Cores of each run: as many as there are for each, where no number is given."""
    if cluster.cpus_per_run is not None:
        return cluster.cpus_per_run
    nodes = [int(node.cpus) for node in workers.nodes if node.cpus >= 1] or [1]
    return max(1, min(sum(nodes) // max(1, runs), min(nodes)))


def tasks_of(runs: Sequence[Planned], cluster: ClusterOptions, workers: Workers, arguments: Sequence[Any] = ()) -> list[Task]:
    """What is reserved for each run; `arguments` in the same order."""
    from fieldfuse.cluster import Task

    count = cores(cluster, workers, len(runs))
    out = []
    for index, one in enumerate(runs):
        gpus = cluster.gpus_per_run if cluster.gpus_per_run is not None else float(one.options.device == "cuda")
        size = one.memory if cluster.memory_per_run is None else int(cluster.memory_per_run * GB)
        out.append(Task(one.name, arguments[index] if arguments else None, count, gpus, size, cluster.retries))
    return out


def described(one: Planned, cluster: ClusterOptions, workers: Workers, count: int) -> dict[str, Any]:
    """A run of the plan, for `--dry-run`."""
    (task,) = tasks_of([one], cluster, workers)
    return {
        "name": one.name,
        "source": str(one.source),
        "options": words(one.options),
        "seconds": round(one.seconds),
        "memory_bytes": task.memory,
        "gpus": task.gpus,
        "refused": workers.too_large(task),
    }


def costs(runs: Sequence[dict[str, Any]], workers: Workers, tasks: Sequence[Task]) -> Iterator[str]:
    """The plan in lines: each run, then all of them."""
    from fieldfuse.cluster import held
    from fieldfuse.evaluation.words import counted, duration, size

    for run in runs:
        options = f" ({' '.join(run['options'])})" if run["options"] else ""
        yield f"{run['name']}: {run['source']}{options}, about {duration(run['seconds'])} and {size(run['memory_bytes'])} of memory"
        if run["refused"]:
            yield f"refused: {run['refused']}"
    largest = max(tasks, key=lambda task: task.memory)
    at_once = max(1, min(sum(held(largest, node) for node in workers.nodes), len(runs)))
    total = max(sum(run["seconds"] for run in runs) / at_once, max(run["seconds"] for run in runs))
    names = ", ".join(node.name for node in workers.nodes)
    each = f"{at_once} at once with {counted(largest.cpus, 'core')} each"
    yield f"{counted(len(runs), 'run')}, {each} ({names}), about {duration(total)} in all"


def lines(data: dict[str, Any], out: Path) -> Iterator[str]:
    """How each run ended, and where the page is."""
    from fieldfuse.pipelines.batch_show import line

    yield from map(line, data["runs"])
    yield str(out / "batch.html")


@dataclass(frozen=True)
class Entry:
    """A run of the plan, and what is known of it now."""

    planned: Planned
    row: Row


class Batch:
    """All runs of a command: which are to be made, what became of them, and the page that shows it."""

    def __init__(self, out: Path, runs: Sequence[Planned], cluster: ClusterOptions) -> None:
        self.out, self.cluster = out.absolute(), cluster
        self._thumbnails: dict[str, str] = {}
        self._written, self._pause = 0.0, PAGE_EVERY
        before = earlier(self.out)
        self.entries = {one.name: Entry(one, self._row(one, before.get(one.name))) for one in runs}
        self.todo = [entry for entry in self.entries.values() if entry.row["state"] != "done"]

    def _row(self, one: Planned, before: Row | None) -> Row:
        """A run's entry: that of an earlier call, if it was the same run and is finished."""
        from fieldfuse.files import fingerprint
        from fieldfuse.pipelines.source import source_state

        try:
            state = source_state(one.source, self.out) if one.source.exists() else ""
        except OSError as error:
            state = str(error)
        given = words(one.options)
        key = fingerprint(__version__, given, state)
        if before is not None and before["state"] == "done" and before["key"] == key and (self.out / one.name / "report.json").is_file():
            self._see(one.name)
            return {**before, **RESTING}
        about = {"name": one.name, "source": str(one.source.absolute()), "options": given, "state": "waiting", "key": key}
        return {**about, **dict.fromkeys(("error", "node", "seconds", "psnr", "ssim", "lpips", "report")), **RESTING}

    def conduct(self, workers: Workers, quiet: bool) -> dict[str, Any]:
        """Make what is missing.

        Returns:
            what `batch.json` holds.

        Raises:
            InputError, OutputError: nodes do not fit (`Workers.check`), or the page cannot be written.
        """
        from fieldfuse.pipelines.batch_run import execute
        from fieldfuse.pipelines.batch_show import make_display

        shared = not self.cluster.upload
        workers.check(self.out if shared else None, [entry.planned.source for entry in self.todo] if shared else [])
        rows = [entry.row for entry in self.entries.values()]
        shown = make_display(rows, workers.stop, quiet)
        with shown.listening():
            tasks = self._specs(workers, shown)
            self.write()

            def listen(news: Message) -> None:
                row = self.entries[news.task].row
                row |= {"state": "running", "node": news.node}
                row |= {key: value for key, value in news.data.items() if key in row and (key != "psnr" or value is not None)}
                if "begun" in news.data:  # also once more, elsewhere
                    shown.changed(row)

            for task, outcome in workers.run(execute, tasks, listen):
                self._ended(self.entries[task.name], outcome)
                shown.changed(self.entries[task.name].row)
                if time.monotonic() - self._written >= self._pause:
                    self.write()
        return self.write()

    def _specs(self, workers: Workers, shown: Display) -> list[Task]:
        """Tasks of the runs that can be made; others are failed already."""
        from fieldfuse.pipelines.batch_run import RunSpec

        planned = [entry.planned for entry in self.todo]
        count, longest = cores(self.cluster, workers, len(planned)), self.cluster.timeout or math.inf
        specs: dict[str, RunSpec] = {}
        for one in planned:
            given = words(one.options) + ([] if one.options.threads is not None else ["--threads", str(count)])
            place, log = self.out / one.name, self.out / "logs" / f"{one.name}.log"
            with self._failing(one.name, shown):
                upload = upload_of(one, place) if self.cluster.upload else None
                specs[one.name] = RunSpec(str(one.source.absolute()), str(place), tuple(given), str(log), longest, upload)
        ready = [one for one in planned if one.name in specs]
        tasks = tasks_of(ready, self.cluster, workers, [specs[one.name] for one in ready])
        for task in tasks:
            with self._failing(task.name, shown):
                if (refusal := workers.too_large(task)) is not None:
                    raise InputError(f"{refusal}; give --memory-per-run or --cpus-per-run less, or add a node")
        return [task for task in tasks if self.entries[task.name].row["state"] != "failed"]

    @contextmanager
    def _failing(self, name: str, shown: Display) -> Iterator[None]:
        """What is refused here costs this run only."""
        row = self.entries[name].row
        try:
            yield
        except FieldfuseError as error:
            row |= {"state": "failed", "error": str(error)}
            shown.changed(row)

    def _ended(self, entry: Entry, outcome: Outcome) -> None:
        """Note how a run ended."""
        row, name = entry.row, entry.planned.name
        if not outcome.begun:
            return
        found = outcome.value or {}
        row |= {**RESTING, "node": outcome.node, "seconds": found.get("seconds"), "error": outcome.error or found.get("error")}
        if found.get("folder") is not None:
            with self._unpacking(row):
                put_folder(found["folder"], self.out / name)
        if row["error"] is not None:
            where = f" (on the node {outcome.node})" if self.cluster.address and outcome.node else ""
            row |= {"state": "failed", "error": f"{row['error']}{where}"}
            return
        facts = found.get("facts")
        if facts is None:  # stopped before it had a report
            row["state"] = "stopped"
            return
        row |= {**facts, "state": "stopped" if facts["stopped"] else "done", "report": f"{name}/report.html"}
        self._see(name)

    @contextmanager
    def _unpacking(self, row: Row) -> Iterator[None]:
        try:
            yield
        except FieldfuseError as error:
            row["error"] = str(error)

    def _see(self, name: str) -> None:
        from fieldfuse.evaluation.batch_page import thumbnail

        if (image := thumbnail(self.out / name)) is not None:
            self._thumbnails[name] = image

    def write(self) -> dict[str, Any]:
        """The page, and `batch.json`; answers what the latter holds."""
        from fieldfuse.evaluation.batch_page import batch_data, write_batch
        from fieldfuse.pipelines.folder import command_line

        rows = [{key: value for key, value in entry.row.items() if key not in RESTING} for entry in self.entries.values()]
        created = datetime.now(UTC).isoformat(timespec="seconds")
        data = batch_data({"command": command_line(), "created": created, "runs": rows})
        began = time.monotonic()
        write_batch(self.out, data, self._thumbnails)
        self._written = time.monotonic()
        self._pause = max(PAGE_EVERY, PAUSES * (self._written - began))
        return data


def earlier(out: Path) -> dict[str, Row]:
    """Runs by name, as an earlier call left them in `batch.json`; none where there is none that can be read."""
    from fieldfuse.evaluation.batch_page import batch_data
    from fieldfuse.files import read_json

    path = out / "batch.json"
    if not path.is_file():
        return {}
    try:
        return {str(row["name"]): row for row in batch_data(read_json(path))["runs"]}
    except (FieldfuseError, AttributeError, TypeError):
        return {}


def upload_of(one: Planned, folder: Path) -> Any:
    """The files that travel with a run.

    Raises:
        InputError: there is no source, it is too large, or it is a file that stands for others beside it.
    """
    from fieldfuse.pipelines.batch_run import Upload, pack

    source = one.source
    if not source.exists():
        raise InputError(f"{source} does not exist; give a video, a folder of pictures, or a capture folder")
    if source.suffix.lower() == ".json":
        raise InputError(f"{source} names files beside it, which --upload would not send; give its folder")
    size = sum(path.stat().st_size for path in ([source] if source.is_file() else source.rglob("*")) if path.is_file())
    if size > MOST_UPLOAD:
        raise InputError(f"{source} holds {size / GB:.1f} GB, and --upload sends at most {MOST_UPLOAD / GB:.1f}; put it on shared storage")
    return Upload(pack(source), pack(folder) if folder.is_dir() else None)


def put_folder(data: bytes, folder: Path) -> None:
    """Replace a run's folder by the one that came back.

    Raises:
        InputError, OutputError: it cannot be unpacked here.
    """
    from fieldfuse.files import remove
    from fieldfuse.pipelines.batch_run import unpack

    temporary = folder.with_name(f".tmp-{os.getpid()}-{folder.name}")
    try:
        unpack(data, temporary)
        remove(folder)
        (temporary / folder.name).rename(folder)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}; free space or choose another --out") from error
    finally:
        remove(temporary)
