"""SIGINT and SIGTERM at each stage of small real runs: `python -m tests.stability stops`.

One folder is stopped at one stage after the other, once (the stage is brought to an end) or twice (at once). Each time the command must end
in a sentence with whole files; then the same command goes on, and must end with the files of a run that nobody stopped.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import cv2

from fieldfuse.files import read_json
from tests.pipelines.made import CAMERA, Answer, circle, make_room, shoot
from tests.stability.runs import OPTIONS, STAGES, TICK, corrupt, differences, leftovers, make_source

REPORT = "report"  # not a stage with a record: the last thing that a run does
PHOTO = CAMERA.scaled(288, 216)


def make_pictures(folder: Path) -> Path:
    """Ten pictures of the made-up room with poses and without depth, 96×72."""
    make_room(folder, 10)
    return folder


def make_film(folder: Path) -> Path:
    """A walk through a part of the room as a video."""
    folder.mkdir(parents=True)
    writer = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (PHOTO.width, PHOTO.height))
    for pose in circle(30, 0.3):
        writer.write(cv2.cvtColor(shoot(pose, PHOTO)[0], cv2.COLOR_RGB2BGR))
    writer.release()
    return folder / "film.mp4"


@dataclass(frozen=True)
class Kind:
    """A run: what it is made of, what it is told, and its stages in their order."""

    make: Callable[[Path], Path]
    options: tuple[str, ...]
    stages: tuple[str, ...]


_MORE = ("--budget", "0.3", "--set", "field.init=network", "--set", "network.voxels=24", "--set", "tsdf.enabled=on")
KINDS = {
    "RGB-D": Kind(make_source, (), STAGES),
    "pictures, from the networks": Kind(
        make_pictures,
        (*_MORE, "--image-size", "48"),
        ("capture", "poses", "effects", "scene", "views", "keyframes", "stereo", "tsdf", "network", "direct", "field", "render", "export",
         "evaluate"),
    ),
    "video": Kind(
        make_film,
        ("--set", "capture.max_frames=12", "--image-size", "96"),
        ("capture", "frames", "poses", "effects", "scene", "views", "keyframes", "field", "render", "export", "evaluate"),
    ),
}  # fmt: skip
# A fit keeps what it has and the report follows; behind the last stage there is nothing to stop.
KEEPS = ("field", "evaluate", REPORT)


def fieldfuse(*arguments: object) -> Answer:
    """The command line in this process, its fit on a clock that advances by looks."""
    from fieldfuse.pipelines import cli
    from fieldfuse.training import fit

    out, err, looks = io.StringIO(), io.StringIO(), itertools.count(1)
    with (
        mock.patch.object(sys, "argv", ["fieldfuse", *map(str, arguments)]),
        mock.patch.object(fit.Clock, "seconds", lambda _: next(looks) * TICK),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            cli.main()
            code: Any = 0
        except SystemExit as end:
            code = end.code
    return Answer(int(code or 0), out.getvalue(), err.getvalue())


@contextlib.contextmanager
def struck(stage: str, number: int, times: int) -> Iterator[None]:
    """Send a signal to this process as soon as `stage` begins."""
    from fieldfuse.pipelines import reconstruct, summary
    from fieldfuse.pipelines.console import ConsoleProgress

    def strike() -> None:
        for _ in range(times):
            os.kill(os.getpid(), number)

    def begin(self: ConsoleProgress, name: str) -> None:
        self.name = name
        if name == stage:
            strike()

    plain = summary.put_report

    def put_report(*given: Any) -> dict[str, Any]:
        if stage == REPORT:
            strike()
        return plain(*given)

    with mock.patch.object(ConsoleProgress, "begin", begin), mock.patch.object(reconstruct, "put_report", put_report):
        yield


def stop_everywhere(folder: Path, kind: Kind, times: int, first: int = 0, only: tuple[str, ...] = ()) -> list[str]:
    """Stop a run at each of its stages, or at `only` some, SIGINT and SIGTERM in turn (`first` 1: SIGTERM first); what was wrong, at best
    nothing."""
    source, whole, out = kind.make(folder / "source"), folder / "whole", folder / "out"
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    told = fieldfuse("run", source, "--out", whole, *OPTIONS, *kind.options)
    if told.code != 0:
        return [f"the run does not end when nobody disturbs it: {told.err}"]
    wrong = []
    if {path.stem for path in (whole / "stages").glob("*.json")} != set(kind.stages):
        wrong.append(f"the run has other stages: {sorted(path.stem for path in (whole / 'stages').glob('*.json'))}")
    for index, stage in enumerate((*kind.stages, REPORT)):
        if only and stage not in only:
            continue
        number = (signal.SIGINT, signal.SIGTERM)[(index + first) % 2]
        with struck(stage, number, times):
            answer = fieldfuse("run", source, "--out", out, *OPTIONS, *kind.options)
        name = f"{number.name} {times}× at {stage}"
        if "Traceback" in answer.err + answer.out:
            wrong.append(f"{name}: a traceback: {answer.err[-500:]}")
        wanted = 0 if times == 1 and stage in KEEPS else 130
        if answer.code != wanted:
            wrong.append(f"{name}: it ended with {answer.code} instead of {wanted}: {answer.err[-300:]}")
        if wanted == 130 and ("same command again" in answer.err) != (times == 1):
            wrong.append(f"{name}: it said {answer.err[-300:]!r}")
        done = {path.stem for path in (out / "stages").glob("[!.]*.json")}
        missing = set(kind.stages[:index]) - {"field", "render", "export"} - done
        wrong += [f"{name}: the stage {one} was lost" for one in sorted(missing)] + [f"{name}: {text}" for text in corrupt(out)]
    told = fieldfuse("run", source, "--out", out, *OPTIONS, *kind.options)
    if told.code != 0:
        return [*wrong, f"the stopped run does not go on: {told.err}"]
    if any("stopped early" in text for text in read_json(out / "report.json")["warnings"]):
        wrong.append("the finished run still counts as stopped")
    if (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) != handlers:
        wrong.append("the signals' handlers were not put back")
    return wrong + differences(whole, out) + leftovers(out) + corrupt(out)


def survey(kinds: list[str]) -> tuple[list[str], list[str]]:
    """What was wrong, and lines for the page."""
    count, wrong, began = 0, [], time.monotonic()
    for name in kinds:
        for times, first in itertools.product((1, 2), (0, 1)):
            with tempfile.TemporaryDirectory(prefix="fieldfuse-stops-") as folder:
                found = stop_everywhere(Path(folder), KINDS[name], times, first)
            count += len(KINDS[name].stages) + 1
            wrong += [f"{name}: {text}" for text in found]
            sys.stderr.write(f"{time.monotonic() - began:6.0f} s  {name}, {times}×: {len(found)} problems\n")
    ended = "all survived" if not wrong else f"{len(wrong)} problems"
    stages = [f"- {name}: {', '.join((*KINDS[name].stages, REPORT))}" for name in kinds]
    return wrong, [f"{count} stops: {ended}; {time.monotonic() - began:.0f} s. The stages of each kind of run:", "", *stages]
