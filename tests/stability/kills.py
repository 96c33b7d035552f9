"""kill -9 at random moments of a small real run, again and again: `python -m tests.stability.kills --kills 50`.

Half of the moments are drawn in time, half among the changes that the run makes to files, where a kill can do the most harm. After each
kill no file may be damaged; a run that is let go on must end with the same files as one that was never killed.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.pipelines.made import environment
from tests.stability.page import replace_part
from tests.stability.runs import ROOT, command, corrupt, differences, launch, leftovers, make_source

EACH = 5  # kills before a run is left alone


@dataclass
class Survey:
    """How often a run was killed, and what was wrong afterwards."""

    kills: int = 0
    late: int = 0  # the run had ended before the moment came
    runs: int = 0
    seconds: float = 0.0
    wrong: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        survived = "all survived" if not self.wrong else f"{len(self.wrong)} problems"
        return [
            f"{self.kills} kills in {self.runs} runs, {survived}; {self.seconds:.0f} s.",
        ]


def kill_runs(folder: Path, kills: int, seed: int, each: int = EACH, seconds: float = 1e9) -> Survey:
    """Kill until `kills` are counted or the time is over."""
    draw, survey, began = random.Random(seed), Survey(), time.monotonic()
    source, whole = make_source(folder / "room"), folder / "whole"
    first = launch({}, source, whole)
    if first.returncode != 0:
        raise RuntimeError(f"the run does not even end when nobody disturbs it: {first.stderr[-2000:]}")
    alone = time.monotonic() - began
    changes = count_changes(whole)
    while survey.kills < kills and time.monotonic() - began < seconds:
        out = folder / f"run{survey.runs}"
        for _ in range(min(each, kills - survey.kills)):
            if draw.random() < 0.5:
                done = launch({"event": draw.randint(1, changes), "signal": "SIGKILL"}, source, out).returncode
            else:
                done = killed_after(draw.uniform(0, alone), source, out)
            survey.kills += done == -signal.SIGKILL
            survey.late += done == 0
            survey.wrong += [f"after kill {survey.kills}: {text}" for text in (corrupt(out) if out.exists() else [])]
            if done not in (0, -signal.SIGKILL):
                survey.wrong.append(f"after kill {survey.kills}: the run ended with {done}")
            if done == 0:
                break
        last = launch({}, source, out)
        if last.returncode != 0:
            survey.wrong.append(f"run {survey.runs} did not go on: {last.stderr[-500:]}")
        survey.wrong += [f"run {survey.runs}: {text}" for text in differences(whole, out) + leftovers(out) + corrupt(out)]
        survey.runs += 1
    survey.seconds = time.monotonic() - began
    return survey


def count_changes(folder: Path) -> int:
    """About how many changes to files a run makes: each file is opened, and renamed."""
    return 2 * sum(path.is_file() for path in folder.rglob("*")) + 10


def killed_after(seconds: float, source: Path, out: Path) -> int:
    process = subprocess.Popen(command({}, source, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment(), cwd=ROOT)
    try:
        return process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(prog="kills")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--page", type=Path)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fieldfuse-kills-") as folder:
        survey = kill_runs(Path(folder), chosen.kills, chosen.seed, seconds=chosen.seconds)
    for text in survey.wrong:
        sys.stdout.write(text + "\n")
    sys.stdout.write("\n".join(survey.lines()) + f"\n{survey.late} moments came too late\n")
    if chosen.page is not None:
        replace_part(chosen.page, "kills", survey.lines())
    return 1 if survey.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
