"""kill -9 at random moments of a small real run, again and again: `python -m tests.stability kills`.

Half of the moments are drawn in time, half among the changes that the run makes to files, where a kill can do the most harm. After each
kill no file may be damaged; a run that is let go on must end with the same files as one that was never killed. The last third of the kills
meets runs that start from the networks.
"""

from __future__ import annotations

import random
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.pipelines.made import environment
from tests.stability.runs import NETWORK, ROOT, command, corrupt, differences, launch, leftovers, make_source

EACH = 5  # kills before a run is left alone
NETWORK_SHARE = 1 / 3  # of the kills meet runs that start from the networks


@dataclass
class Survey:
    """How often a run was killed, and what was wrong afterwards."""

    kills: int = 0
    late: int = 0  # moments that came when the run had ended
    runs: int = 0
    from_networks: int = 0  # kills of runs that started from the networks
    seconds: float = 0.0
    wrong: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        survived = "all survived" if not self.wrong else f"{len(self.wrong)} problems"
        started = f", {self.from_networks} of them of runs that started from the networks" if self.from_networks else ""
        return [f"{self.kills} kills{started}, in {self.runs} runs: {survived}; {self.seconds:.0f} s."]


def kill_runs(folder: Path, kills: int, seed: int, each: int = EACH, network_share: float = NETWORK_SHARE) -> Survey:
    """Kill until `kills` are counted; run n draws from `seed` and n alone. The last `network_share` of them meet runs that start from the
    networks."""
    survey, source, began = Survey(), make_source(folder / "room"), time.monotonic()
    whole: dict[bool, tuple[Path, float]] = {}
    plain = kills - round(kills * network_share)
    while survey.kills < kills:
        number, networks = survey.runs, survey.kills >= plain
        if networks not in whole:
            whole[networks] = _undisturbed(source, folder / f"whole{networks:d}", networks)
        draw, left = random.Random(f"{seed} {number}"), (kills if networks else plain) - survey.kills
        _one_run(survey, draw, source, folder / f"run{number}", *whole[networks], networks, min(each, left))
    survey.seconds = time.monotonic() - began
    return survey


def _undisturbed(source: Path, out: Path, networks: bool) -> tuple[Path, float]:
    """A run that nothing happens to, and how long it took."""
    began = time.monotonic()
    first = launch({}, source, out, *options(networks))
    if first.returncode != 0:
        raise RuntimeError(f"the run does not even end when nobody disturbs it: {first.stderr[-2000:]}")
    return out, time.monotonic() - began


def _one_run(survey: Survey, draw: random.Random, source: Path, out: Path, whole: Path, alone: float, networks: bool, kills: int) -> None:
    """Kill one run up to `kills` times, let it go on, and compare it with the `whole` one, which took `alone` seconds."""
    more, changes, before = options(networks), count_changes(whole), survey.kills
    for _ in range(kills):
        if draw.random() < 0.5:
            done = launch({"event": draw.randint(1, changes), "signal": "SIGKILL"}, source, out, *more).returncode
        else:
            done = killed_after(draw.uniform(0, alone), source, out, *more)
        survey.kills += done == -signal.SIGKILL
        survey.late += done == 0
        survey.wrong += [f"after kill {survey.kills}: {text}" for text in (corrupt(out) if out.exists() else [])]
        if done not in (0, -signal.SIGKILL):
            survey.wrong.append(f"after kill {survey.kills}: the run ended with {done}")
        if done == 0:
            break
    last = launch({}, source, out, *more)
    if last.returncode != 0:
        survey.wrong.append(f"run {survey.runs} did not go on: {last.stderr[-500:]}")
    survey.wrong += [f"run {survey.runs}: {text}" for text in differences(whole, out) + leftovers(out) + corrupt(out)]
    survey.runs += 1
    survey.from_networks += (survey.kills - before) * networks


def options(networks: bool) -> tuple[str, ...]:
    return NETWORK if networks else ()


def count_changes(folder: Path) -> int:
    """About how many changes to files a run makes: each file is opened, and renamed."""
    return 2 * sum(path.is_file() for path in folder.rglob("*")) + 10


def killed_after(seconds: float, source: Path, out: Path, *more: str) -> int:
    process = subprocess.Popen(
        command({}, source, out, *more), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment(), cwd=ROOT
    )
    try:
        return process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def survey(kills: int, seed: int) -> tuple[list[str], list[str]]:
    """What was wrong, and lines for the page."""
    with tempfile.TemporaryDirectory(prefix="fieldfuse-kills-") as folder:
        found = kill_runs(Path(folder), kills, seed)
    return found.wrong, found.lines()
