"""`python -m benchmarks.before_after --before DIR --after DIR --data DATA --out DIR`: two checkouts of Fieldfuse beside each other.

Each row is one and the same command of both checkouts. Scores: both run at the same time, a core each. Seconds: in turns on an otherwise
idle machine, and the median ratio counts. A checkout is a folder with its own `.venv`.
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
CLIP = "fox"  # what is timed
PARTS = ("times", "direct", "fits", "few", "zoo", "meshes")
STEPS = 600  # of a timed fit
LIMIT = 1800  # seconds of a command


@dataclass(frozen=True)
class Checkout:
    """A state of the code, with its environment."""

    name: str
    path: Path

    def command(self, *words: str | Path) -> list[str]:
        """Command line of its `fieldfuse`; before 0.2 the command's modules had other names."""
        module = "fieldfuse" if (self.path / "toolkit" / "__main__.py").is_file() else "pipelines.cli"
        return [str(self.path / ".venv" / "bin" / "python"), "-m", module, *map(str, words)]

    def run(self, *words: str | Path) -> None:
        """Raises: InputError: the command failed."""
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "NUMBA_NUM_THREADS": "1"}
        command = self.command(*words)
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

    @property
    def sides(self) -> tuple[Checkout, Checkout]:
        """Before and after."""
        return self.before, self.after

    def folder(self, side: Checkout, entry: Row) -> Path:
        """Of the entry's run."""
        return self.out / "runs" / "-".join(str(value) for value in (*entry.values(), side.name))

    def scores(self, entry: Row) -> Row:
        """Held-out PSNR of both, run at the same time."""
        source, options = self._command(entry)

        def psnr(side: Checkout) -> float:
            folder = self.folder(side, entry)
            side.run("run", source, "--out", folder, *BARE, "--seed", str(entry["seed"]), *options)
            report = json.loads((folder / "report.json").read_text())
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
            options = ["--threads", "1", "--quiet", "--image-size", "320", "--budget", str(entry["detail"]), "--set", "export.formats=[]"]
            side.run("compare", capture, "--out", folder, *options)
            return f_score(json.loads((folder / "compare.json").read_text()))

        with ThreadPoolExecutor(2) as pool:
            before, after = pool.map(score, self.sides)
        return {"before": round(before, 2), "after": round(after, 2)}

    def times(self, entry: Row) -> Row:
        """Medians of seconds, of runs in turns: earlier stages are reused, the one that counts is made anew."""
        kind, source, repetitions = str(entry["detail"]), self.data / FITS[entry["capture"]], 9
        options = {
            "fit": ["--budget", "600", "--set", f"fit.iterations={STEPS}"],
            "render": ["--budget", "600", "--set", "fit.iterations=200", "--image-size", "640"],
            "key frames": ["--set", "fit.finetune=false"],
            "tsdf": ["--budget", "1", "--set", "tsdf.enabled=on"],
        }[kind]
        stage = {"fit": "field", "render": "field", "key frames": "network", "tsdf": "tsdf"}[kind]
        seconds: dict[str, list[float]] = {side.name: [] for side in self.sides}
        for number in range(repetitions + 1):  # the first has compiling in it
            for side in self.sides if number % 2 else self.sides[::-1]:
                folder = self.folder(side, entry)
                (folder / "stages" / f"{stage}.json").unlink(missing_ok=True)
                side.run("run", source, "--out", folder, *BARE, *options)
                report = json.loads((folder / "report.json").read_text())
                if number:
                    seconds[side.name].append(_seconds(report, kind, stage))
        before, after = (seconds[side.name] for side in self.sides)
        ratio = statistics.median(b / a for a, b in zip(before, after, strict=True))
        return {"before": round(statistics.median(before), 4), "after": round(statistics.median(after), 4), "ratio": round(ratio, 4)}


def _seconds(report: dict[str, Any], kind: str, stage: str) -> float:
    if kind == "render":
        return float(report["evaluation"]["field"]["seconds_per_view"])
    if kind == "fit":
        return float(report["timeline"][-1]["seconds"])
    return float(next(row["seconds"] for row in report["stages"] if row["name"] == stage))


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
        "times": [(CLIP, "fit", 0), (CLIP, "render", 0), (CLIP, "key frames", 0), ("redkitchen", "tsdf", 0)],
        "direct": [(name, "", 0) for name in DIRECT],
        "fits": [(name, budget, seed) for budget in (10, 30, 60) for name in FITS for seed in (0, 1)],
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
    quiet: Quiet = False,
) -> None:
    """Scores and seconds of two checkouts, on the same machine in one run."""
    kinds = chosen(parts, PARTS, "--parts")
    pair = Pair(Checkout("before", before.absolute()), Checkout("after", after.absolute()), data.absolute(), out.absolute())
    measures: dict[str, Callable[[Row], Row]] = {"times": pair.times, "meshes": pair.meshes}

    def run(entry: Row) -> Row:
        return measures.get(entry["part"], pair.scores)(entry)

    experiment = Experiment("before_after", plan(kinds, data), run, table, state=f"{before} {after}")
    show(section(experiment.conduct(out, make_progress(quiet), 1), table), quiet)


def table(data: Row) -> str:
    """Markdown: a line a row, then the mean and the worst difference of each part."""
    lines, parts = [], {}  # type: ignore[var-annotated]
    for row in data["rows"]:
        what = [row["part"], row["capture"], row["detail"], row["seed"]]
        if row.get("error"):
            lines.append([*what, row["error"][:80], "", ""])
            continue
        change = f"×{row['ratio']:.3f}" if "ratio" in row else f"{row['after'] - row['before']:+.2f}"
        if "ratio" not in row:
            parts.setdefault(row["part"], []).append(row["after"] - row["before"])
        lines.append([*what, row["before"], row["after"], change])
    text = markdown(["part", "capture", "budget or what", "seed", "before", "after", "change"], lines)
    for part, changes in parts.items():
        text += f"\n{part}: mean {statistics.mean(changes):+.3f}, worst {min(changes):+.2f}, of {len(changes)}\n"
    return text


app = application(before_after)
if __name__ == "__main__":
    program(app)
