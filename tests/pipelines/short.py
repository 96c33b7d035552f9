"""Settings of short runs on the made-up room, a clock on which their fits make the same steps anywhere, and what their reports hold."""

from __future__ import annotations

import itertools
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from fieldfuse.files import read_json
from fieldfuse.training.fit import Clock
from tests.pipelines.made import command, environment, make_room, said

ALONE = ["--threads", "1", "--init", "classical"]
SMALL = ["--budget", "3", *ALONE, "--set", "field.resolution=32", "--set", "export.mesh_views=6", "--set", "export.video_frames=4"]
FAST = ["--budget", "1", *ALONE, "--set", "field.resolution=16", "--set", "export.formats=[points]", "--set", "export.mesh_views=3"]

HUNG = 500.0  # seconds after which a process counts as hung, on the busiest machine
TICK = 0.01  # seconds that the clock of a fit goes on by at each look: a second is some hundred steps


PLAIN = Clock.__init__


@contextmanager
def clocked(clock: Callable[[], Callable[[], float]]) -> Iterator[None]:
    """Each fit is on a clock of its own, made by `clock`."""

    def begin(self: Clock, _: Callable[[], float]) -> None:
        PLAIN(self, clock())

    with mock.patch.object(Clock, "__init__", begin):
        yield


@contextmanager
def steady(tick: float = TICK) -> Iterator[None]:
    """The clock of each fit goes on by `tick` seconds at each look: a fit makes the same steps on any machine, however busy."""

    def clock() -> Callable[[], float]:
        looks = itertools.count()
        return lambda: next(looks) * tick

    with clocked(clock):
        yield


def finished(out: Path, count: int, *options: object) -> None:
    """A finished run in `out`, of a room of `count` pictures in `room` beside it, for tests of what a run leaves."""
    make_room(out.parent / "room", count)
    with steady():
        answer = said("run", out.parent / "room", "--out", out, *options)
    assert answer.code == 0, answer.err


def report(folder: Path) -> dict[str, Any]:
    data = read_json(folder / "report.json")
    assert isinstance(data, dict)
    return data


def stages(data: dict[str, Any]) -> dict[str, bool]:
    return {stage["name"]: stage["cached"] for stage in data["stages"]}


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment())


def wait_for(path: Path, process: subprocess.Popen[str], seconds: float = HUNG) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end, f"{path} never came"
        time.sleep(0.02)
