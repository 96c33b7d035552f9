"""Workers started, listened to, and started again behind the input that ended one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]


@dataclass
class Result:
    """How many inputs were read, by target, and what went wrong."""

    inputs: int = 0
    seconds: float = 0.0
    targets: Counter[str] = field(default_factory=Counter)
    refused: int = 0
    problems: list[dict[str, Any]] = field(default_factory=list)

    def lines(self) -> list[str]:
        """As a table for people."""
        kinds = Counter(str(problem["kind"]) for problem in self.problems)
        escapes = kinds.pop("escape", 0) + kinds.pop("Escape", 0)
        hangs, crashes = kinds.pop("hang", 0), kinds.pop("crash", 0)
        return [
            f"{self.inputs:,} inputs in {self.seconds:.0f} s, of which {self.refused:,} were refused and the others read:",
            "",
            "| what | times |",
            "| --- | --- |",
            f"| crashes of the process | {crashes} |",
            f"| longer than 5 s | {hangs} |",
            f"| files touched outside the capture, or code run | {escapes} |",
            f"| anything but a result or a sentence (memory beyond 1 GiB among it) | {sum(kinds.values())} |",
            "",
            "Inputs by target: " + ", ".join(f"{name} {count:,}" for name, count in sorted(self.targets.items())) + ".",
        ]


Told = Callable[[Result], None]


def fuzz(inputs: int, seed: int, jobs: int = 1, only: list[str] | None = None, told: Told | None = None) -> Result:
    """Read so many damaged files of a seed in `jobs` processes."""
    result = Result()
    began = time.monotonic()
    share = -(-inputs // jobs)
    parts = [(start, min(share, inputs - start)) for start in range(0, inputs, share)]
    with tempfile.TemporaryDirectory(prefix="fieldfuse-fuzz-") as folder, ThreadPoolExecutor(jobs) as pool:

        def work(part: tuple[int, int]) -> None:
            _one_range(Path(folder) / str(part[0]), seed, *part, only or [], result, told)

        list(pool.map(work, parts))
    result.seconds = time.monotonic() - began
    return result


def survey(inputs: int, seed: int, jobs: int, only: list[str]) -> tuple[list[str], list[str]]:
    """What was wrong as lines of JSON, and lines for the page."""

    def told(result: Result) -> None:
        sys.stderr.write(f"{result.inputs} inputs, {len(result.problems)} problems\n")

    result = fuzz(inputs, seed, jobs, only, told)
    return [json.dumps(problem) for problem in result.problems], result.lines()


def _one_range(folder: Path, seed: int, first: int, count: int, only: list[str], result: Result, told: Told | None) -> None:
    stop = first + count
    while first < stop:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "current").unlink(missing_ok=True)
        command = [sys.executable, "-m", "tests.stability.fuzz.worker", str(folder), str(seed), str(first), str(stop - first), *only]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, env=environment, cwd=ROOT, text=True)
            assert process.stdout is not None
            done = _listen(process.stdout, result, told)
            process.wait()
        if done:
            return
        tail = (folder / "log").read_text(errors="replace")[-3000:]
        if not (folder / "current").exists():
            raise RuntimeError(f"a worker could not start:\n{tail}")
        current = json.loads((folder / "current").read_text())
        result.problems.append({"kind": "crash", "text": _ending(process.returncode), "trace": tail, **current})
        first = current["number"] + 1


def _listen(stream: Any, result: Result, told: Told | None) -> bool:
    for line in stream:
        message = json.loads(line)
        if message["kind"] in ("progress", "done"):
            result.inputs += message["inputs"]
            result.refused += message["refused"]
            result.targets.update(message["targets"])
            if told is not None:
                told(result)
            if message["kind"] == "done":
                return True
        else:
            result.problems.append(message)
    return False


def _ending(code: int) -> str:
    return f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
