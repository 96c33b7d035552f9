"""`python -m benchmarks.before_after --before DIR --after DIR --data DATA --out DIR`: two checkouts of Fieldfuse beside each other.

Each row is one and the same command of both checkouts. Scores: both run at the same time, a core each, with budgets in seconds of processor
time, so that other work does not count. Seconds: in turns on an otherwise idle machine, and the median ratio counts. A checkout is a folder
with its own `.venv`.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.experiment import Experiment, Row, application, chosen, markdown, program, section, show
from fieldfuse.errors import InputError
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Out, Quiet

BARE = ["--threads", "1", "--quiet", "--image-size", "320", "--set", "export.formats=[]", "--set", "tsdf.enabled=off"]
FITS = {"fox": "fox_540x960", "gum": "gum_360x640", "dtu": "dtu_scan24_384", "redkitchen": "redkitchen", "lego": "lego_400"}
DIRECT, FEW = ("fox", "redkitchen", "lego"), ("fox", "dtu")
ROOMS = ("room", "corridor")  # simulated; they come with their true meshes
TIMED = ("step", "render", "keyframe", "tsdf")  # parts of `benchmarks.speed`
PARTS = ("direct", "fits", "few", "zoo", "meshes", "times")
LIMIT = 1800  # seconds of a command
# Runs a module as `python -m` does, with processor time as the clock of fits.
START = """import runpy, sys, time
time.perf_counter = time.process_time
sys.argv = sys.argv[1:]
runpy.run_module(sys.argv[0], run_name="__main__")"""


@dataclass(frozen=True)
class Checkout:
    """A state of the code, with its environment."""

    name: str
    path: Path

    def run(self, *words: str | Path) -> None:
        """A command of its `fieldfuse`; before 0.2 the command's modules had other names.

        Raises:
            InputError: the command failed.
        """
        module = "fieldfuse" if (self.path / "toolkit" / "__main__.py").is_file() else "pipelines.cli"
        self.python("-c", START, module, *words)

    def python(self, *words: str | Path) -> None:
        """Raises: InputError: the command failed."""
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "NUMBA_NUM_THREADS": "1"}
        command = [str(self.path / ".venv" / "bin" / "python"), *map(str, words)]
        done = subprocess.run(command, cwd=self.path, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)
        if done.returncode:
            raise InputError(f"{self.name}: {done.stderr.strip()[-300:] or f'exit code {done.returncode}'}")


@dataclass(frozen=True)
class Pair:
    """Both checkouts, and where captures and runs are."""

    before: Checkout
    after: Checkout
    data: Path
    out: Path
    repetitions: int = 9  # of what is timed, in turns

    @property
    def sides(self) -> tuple[Checkout, Checkout]:
        """Before and after."""
        return self.before, self.after

    def folder(self, side: Checkout, entry: Row) -> Path:
        """Of the capture's runs: what comes before the fit is reused."""
        return self.out / "runs" / f"{entry['part']}-{entry['capture']}-{side.name}"

    def scores(self, entry: Row) -> Row:
        """Held-out PSNR of both, run at the same time."""
        source, options = self._command(entry)

        def psnr(side: Checkout) -> float:
            folder = self.folder(side, entry)
            side.run("run", source, "--out", folder, *BARE, "--seed", str(entry["seed"]), *options)
            report = json.loads((folder / "report.json").read_text())
            if entry["part"] == "zoo":
                shutil.rmtree(folder)
            return float(report["evaluation"]["field"]["psnr"])

        with ThreadPoolExecutor(2) as pool:
            try:
                before, after = pool.map(psnr, self.sides)
            except InputError as error:
                return {"error": str(error)}
        return {"before": round(before, 3), "after": round(after, 3)}

    def _command(self, entry: Row) -> tuple[Path, list[str]]:
        detail = str(entry["detail"])
        if entry["part"] == "zoo":
            return self.data / "zoo" / entry["capture"], ["--budget", detail]
        source = self.data / FITS[entry["capture"]]
        if entry["part"] == "direct":
            return source, ["--set", "fit.finetune=false"]
        if entry["part"] == "few":
            return source, ["--budget", "20", "--set", f"views.limit={detail}"]
        return source, ["--budget", detail]

    def meshes(self, entry: Row) -> Row:
        """F-scores in percent of both fields' meshes against the simulated room's."""
        capture = self.out / "rooms" / entry["capture"]
        if not capture.exists():
            self.after.run("simulate", entry["capture"], "--out", capture, "--quiet")

        def score(side: Checkout) -> float:
            folder = self.folder(side, entry)
            options = [*BARE[:5], "--budget", str(entry["detail"]), "--set", "export.formats=[ply]"]
            side.run("compare", capture, "--out", folder, *options)
            return f_score(json.loads((folder / "compare.json").read_text()))

        with ThreadPoolExecutor(2) as pool:
            before, after = pool.map(score, self.sides)
        return {"before": round(before, 2), "after": round(after, 2)}

    def times(self, entry: Row) -> Row:
        """Medians of processor seconds of a part of `benchmarks.speed`, in turns.

        Returns:
            `cases`: name and size → before, after, and the median of the ratios.
        """
        part, seconds = str(entry["detail"]), dict[str, dict[str, list[float]]]()
        for number in range(self.repetitions + 1):  # the first has compiling in it
            for side in self.sides if number % 2 else self.sides[::-1]:
                found = self._speed(side, part)
                for name, value in found.items() if number else ():
                    seconds.setdefault(name, {}).setdefault(side.name, []).append(value)
        cases = {}
        for name, by_side in seconds.items():
            if len(by_side) == 2:
                before, after = (by_side[side.name] for side in self.sides)
                ratio = statistics.median(b / a for a, b in zip(before, after, strict=True))
                cases[name] = [statistics.median(before), statistics.median(after), round(ratio, 4)]
        return {"cases": cases}

    def _speed(self, side: Checkout, part: str) -> dict[str, float]:
        """Seconds a unit of each case; of the TSDF, frames a second."""
        options = ["--parts", part, "--threads", "1", "--repetitions", "3", "--quiet"]
        folder = self.out / "speed" / side.name
        if (side.path / "benchmarks" / "speed.py").is_file():
            side.python("-m", "benchmarks.speed", "--out", folder, *options)
            (data,) = json.loads((folder / "speed.json").read_text())["rows"]
        else:
            folder.mkdir(parents=True, exist_ok=True)
            side.run("bench", "speed", "--json", folder / "speed.json", *options)
            data = json.loads((folder / "speed.json").read_text())
        found = {f"{case['name']}, {case['size']}": case["ours"]["processor"] / case["units"] for case in data.get("cases") or []}
        return found | ({"TSDF, frames a second": data["tsdf"]["ours"]} if data.get("tsdf") else {})


def f_score(compared: dict[str, Any]) -> float:
    """Of the field's mesh in `compare.json`, percent."""
    for method in compared["methods"]:
        if method["key"] == "field" and method["geometry"]:
            return 100 * float(method["geometry"]["f_score_2"])
    raise InputError("compare.json has no F-score of the field's mesh")


def plan(parts: Sequence[str], data: Path) -> list[Row]:
    """All rows."""
    zoo = sorted(path.name for path in (data / "zoo").iterdir()) if (data / "zoo").is_dir() else []
    rows: dict[str, list[tuple[str, Any, int]]] = {
        "times": [("demo", part, 0) for part in TIMED],
        "direct": [(name, "", 0) for name in DIRECT],
        "fits": [(name, budget, seed) for budget in (10, 30, 60) for seed in (0, 1) for name in FITS],
        "few": [(name, count, 0) for name in FEW for count in (3, 6, 12)],
        "zoo": [(name, 20, 0) for name in zoo],
        "meshes": [(name, 20, 0) for name in ROOMS],
    }
    entries = [(part, *entry) for part in parts for entry in rows[part]]
    return [{"part": part, "capture": name, "detail": detail, "seed": seed} for part, name, detail, seed in entries]


def before_after(
    out: Out,
    before: Annotated[Path, typer.Option(help="Checkout of the state before.")],
    after: Annotated[Path, typer.Option(help="Checkout of the state after.")],
    data: Annotated[Path, typer.Option(help="Folder of captures.")],
    parts: Annotated[str | None, typer.Option(help=f"Comma-separated part of {','.join(PARTS)}.", show_default=False)] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Pairs of runs that are timed.")] = 9,
    quiet: Quiet = False,
) -> None:
    """Scores and seconds of two checkouts, on the same machine in one run."""
    kinds = chosen(parts, PARTS, "--parts")
    sides = Checkout("before", before.absolute()), Checkout("after", after.absolute())
    pair = Pair(*sides, data.absolute(), out.absolute(), repetitions)
    measures: dict[str, Callable[[Row], Row]] = {"times": pair.times, "meshes": pair.meshes}

    def run(entry: Row) -> Row:
        return measures.get(entry["part"], pair.scores)(entry)

    experiment = Experiment("before_after", plan(kinds, data), run, table, state=f"{before} {after}")
    show(section(experiment.conduct(out, make_progress(quiet), 1), table), quiet)


def table(data: Row) -> str:
    """Markdown: a line a row, then the mean and the worst difference of each part."""
    lines: list[list[Any]] = []
    parts: dict[str, list[float]] = {}
    for row in data["rows"]:
        what = [row["part"], row["capture"], row["detail"], row["seed"]]
        if row.get("error"):
            lines.append([*what, row["error"][:80], "", ""])
        elif "cases" in row:
            for name, (before, after, ratio) in row["cases"].items():
                lines.append([row["part"], name, row["detail"], "", f"{before:.4g}", f"{after:.4g}", f"×{ratio:.3f}"])
        else:
            change = row["after"] - row["before"]
            parts.setdefault(row["part"], []).append(change)
            lines.append([*what, row["before"], row["after"], f"{change:+.2f}"])
    text = markdown(["part", "capture or case", "budget or what", "seed", "before", "after", "change"], lines)
    for part, changes in parts.items():
        text += f"\n{part}: mean {statistics.mean(changes):+.3f}, worst {min(changes):+.2f}, of {len(changes)}\n"
    return text


app = application(before_after)
if __name__ == "__main__":
    program(app)
