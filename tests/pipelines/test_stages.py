"""The stage runner: what is reused, what is made again, and what a kill at any moment leaves."""

from __future__ import annotations

import gc
import mmap
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from fieldfuse.config import Settings
from fieldfuse.errors import InputError, Interrupted, OutputError
from fieldfuse.files import read_json, write_json
from fieldfuse.memory import give_back
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import RunFolder
from fieldfuse.pipelines.stages import CollectingStage, EndlessStage, PeakMemory, Stage, Stages, finished_stages, own_bytes


class Chain:
    """Three stages that add one to a number each; counts how often each is made."""

    def __init__(self, path: Path, trusted: tuple[str, ...] = ()) -> None:
        self.path = path
        self.made: list[str] = []
        self.trusted = trusted
        self.progress = ConsoleProgress()

    def run(self, start: int = 0, shift: int = 0, keeps: bool = False, stop: bool = False) -> int:
        self.made = []
        with RunFolder(self.path) as folder:
            folder.start(Path("source"), Settings())
            stages = Stages(folder, self.progress, self.trusted)
            value, before = start, []
            for name in ("first", "second", "third"):
                uses = {"first": start, "second": shift, "third": None}[name]
                value = self._stage(
                    stages, folder, name, value + (shift if name == "second" else 1), uses, before, keeps and name == "second", stop
                )
                before = [name]
            self.stages = stages
            return value

    def _stage(
        self, stages: Stages, folder: RunFolder, name: str, result: int, uses: Any, after: list[str], keeps: bool, stop: bool
    ) -> int:
        path = folder / f"{name}.value"

        def make() -> int:
            self.made.append(name)
            if stop and keeps:
                self.progress.request_stop()
            return result

        def save(value: int) -> list[Path]:
            path.write_text(str(value))
            return [path]

        def load() -> int:
            text = path.read_text()
            if not text.isdigit():
                raise InputError(f"{path} is damaged")
            return int(text)

        return stages.run((EndlessStage if keeps else Stage)(name, make, save, load, after, uses))


def test_finished_stages_are_reused(tmp_path: Path) -> None:
    chain = Chain(tmp_path / "run")
    assert chain.run(shift=5) == 7
    assert chain.made == ["first", "second", "third"]
    assert chain.run(shift=5) == 7
    assert chain.made == []
    assert [entry["cached"] for entry in chain.stages.summary()] == [True, True, True]
    assert [record.name for record in finished_stages(RunFolder(tmp_path / "run"))] == ["first", "second", "third"]


def test_a_changed_setting_makes_its_stage_and_what_follows(tmp_path: Path) -> None:
    chain = Chain(tmp_path / "run")
    chain.run(shift=5)
    assert chain.run(shift=6) == 8
    assert chain.made == ["second", "third"]


@pytest.mark.parametrize("spoil", ["remove", "grow", "record"])
def test_damaged_outputs_are_made_again_with_what_follows(tmp_path: Path, spoil: str) -> None:
    chain = Chain(tmp_path / "run")
    chain.run(shift=5)
    path = tmp_path / "run" / "second.value"
    if spoil == "remove":
        path.unlink()
    elif spoil == "grow":
        path.write_text("123456")
    else:
        (tmp_path / "run" / "stages" / "second.json").write_text("{")
    assert chain.run(shift=5) == 7
    assert chain.made == ["second", "third"]


def test_same_size_but_unreadable_is_made_again_unless_it_was_to_be_taken_as_it_is(tmp_path: Path) -> None:
    chain = Chain(tmp_path / "run")
    chain.run(shift=5)
    (tmp_path / "run" / "second.value").write_text("x")
    assert chain.run(shift=5) == 7
    assert chain.made == ["second", "third"]
    (tmp_path / "run" / "second.value").write_text("x")
    with pytest.raises(InputError, match="damaged"):
        Chain(tmp_path / "run", trusted=("first", "second")).run(shift=5)


def test_trusted_stages_ignore_settings_but_not_what_they_stand_on(tmp_path: Path) -> None:
    Chain(tmp_path / "run").run(shift=5)
    chain = Chain(tmp_path / "run", trusted=("first", "second", "third"))
    assert chain.run(start=100, shift=50) == 7
    assert chain.made == []
    Chain(tmp_path / "run").run(start=10, shift=5)
    record = tmp_path / "run" / "stages" / "first.json"
    write_json(record, {**read_json(record), "made": "another"})
    chain.run(start=10, shift=5)
    assert chain.made == ["second", "third"]


def test_a_stopped_stage_keeps_what_it_has_and_is_made_in_full_next_time(tmp_path: Path) -> None:
    chain = Chain(tmp_path / "run")
    assert chain.run(shift=5, keeps=True, stop=True) == 7  # the short stages after it still run
    assert chain.stages.stopped() == ["second"]
    assert not chain.progress.stopping()
    assert chain.run(shift=5, keeps=True) == 7
    assert chain.made == ["second", "third"]
    assert chain.stages.stopped() == []


def test_a_stop_between_stages_ends_before_the_next(tmp_path: Path) -> None:
    chain = Chain(tmp_path / "run")
    chain.progress.request_stop()
    with pytest.raises(Interrupted, match="again"):
        chain.run(shift=5)
    assert chain.made == []


@pytest.mark.parametrize(("adds", "left"), [(False, ["0.txt"]), (True, ["0.txt", "1.txt", "2.txt"])])
def test_outputs_that_are_no_longer_made_are_removed(tmp_path: Path, adds: bool, left: list[str]) -> None:
    """Unless the stage adds to what is there."""
    with RunFolder(tmp_path / "run") as folder:
        for count in (3, 1):
            stages = Stages(folder, ConsoleProgress())

            def save(value: int) -> list[Path]:
                paths = [folder / f"{index}.txt" for index in range(value)]
                for path in paths:
                    path.write_text("here")
                return paths

            kind = CollectingStage if adds else Stage
            stages.run(kind("only", lambda: count, save, lambda: 0, settings=count))  # noqa: B023
        assert sorted(path.name for path in folder.path.glob("*.txt")) == left == sorted(stages.records["only"].outputs)


KILLED = """
import os, signal, sys
from pathlib import Path
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import RunFolder
from fieldfuse.pipelines.stages import Stage, Stages
from fieldfuse.config import Settings
from fieldfuse.files import atomic_path

when = sys.argv[2]
with RunFolder(Path(sys.argv[1])) as folder:
    folder.start(Path("source"), Settings())
    stages = Stages(folder, ConsoleProgress())
    path = folder / "value.txt"

    def die(moment):
        if when == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    def make():
        print("made")
        die("make")
        return "result"

    def save(value):
        with atomic_path(path) as temporary:
            temporary.write_text(value)
            die("write")
        die("saved")
        return [path]

    print(stages.run(Stage("only", make, save, path.read_text)))
    die("after")
"""


@pytest.mark.parametrize(("moment", "again"), [("make", True), ("write", True), ("saved", True), ("after", False)])
def test_kill_leaves_a_finished_stage_or_none(tmp_path: Path, moment: str, again: bool) -> None:
    def run(when: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
        command = [sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path / "run"), when]
        return subprocess.run(command, capture_output=True, text=True, env=environment)

    assert run(moment).returncode == -signal.SIGKILL
    assert (tmp_path / "run" / "stages" / "only.json").is_file() != again
    second = run("never")
    assert second.returncode == 0, second.stderr
    assert ("made" in second.stdout) == again
    assert "result" in second.stdout
    assert list((tmp_path / "run").glob(".tmp-*")) == []


def test_two_commands_in_one_folder(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run"), pytest.raises(OutputError, match="another fieldfuse command is working"):
        RunFolder(tmp_path / "run").__enter__()
    with RunFolder(tmp_path / "run"):
        pass


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / ".tmp-mine").write_text("keep")
    with pytest.raises(OutputError, match="holds 'frames' but no fieldfuse run"):
        RunFolder(tmp_path).__enter__()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".tmp-mine", "frames"]
    (tmp_path / "frames").rmdir()
    with RunFolder(tmp_path):
        assert (tmp_path / ".tmp-mine").read_text() == "keep"


def test_leftovers_of_a_killed_run_are_removed(tmp_path: Path) -> None:
    with RunFolder(tmp_path) as folder:
        folder.start(Path("source"), Settings())
    (tmp_path / "stages").mkdir()
    (tmp_path / "exports" / "cameras").mkdir(parents=True)
    for place in (tmp_path, tmp_path / "stages", tmp_path / "exports" / "cameras"):
        (place / ".tmp-123-mesh.ply").write_text("half")
    with RunFolder(tmp_path):
        assert list(tmp_path.rglob(".tmp-*")) == []


def test_unexpected_errors_are_kept_in_the_folder(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError) as caught, RunFolder(tmp_path):
        _ = 1 / 0
    assert "ZeroDivisionError" in Path(caught.value.fieldfuse_log).read_text()  # type: ignore[attr-defined]


def test_a_full_disk_is_said_in_a_sentence(tmp_path: Path) -> None:
    for error in (OSError(28, "No space left on device"), RuntimeError("write failed: No space left on device (os error 28)")):
        with pytest.raises(OutputError, match="No space left"), RunFolder(tmp_path):
            raise error


SIZE = 2**27  # 128 MiB


def until(reached: Callable[[], bool], seconds: float = 200) -> None:
    """Wait for the thread that samples, which a busy machine may hold up; what never comes is for the test to find."""
    end = time.monotonic() + seconds
    while not reached() and time.monotonic() < end:
        time.sleep(0.05)


def test_what_was_taken_and_given_back_is_remembered() -> None:
    gc.collect()
    give_back()  # else the thread may see as much given back as is taken
    before = own_bytes(psutil.Process().memory_info()) / 2**20  # without pages of files, which a system short of memory drops
    with PeakMemory() as memory:
        held = np.ones(SIZE, np.uint8)
        until(lambda: memory.own > before + 100)
        del held
    assert memory.own > before + 100
    assert memory.own <= memory.megabytes


def test_files_are_memory_but_not_its_own(tmp_path: Path) -> None:
    path = tmp_path / "large"
    path.write_bytes(bytes(SIZE))
    with PeakMemory() as before:
        own = before.own
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped, PeakMemory() as memory:
        assert not np.frombuffer(bytes(mapped[:: mmap.PAGESIZE]), np.uint8).any()  # each page is looked at
        until(lambda: memory.megabytes > own + 60)
    if not hasattr(psutil.Process().memory_info(), "shared"):
        pytest.skip("this system does not tell pages of files apart")
    assert memory.own < own + 60 < memory.megabytes


def test_children_count() -> None:
    program = f"import time; held = bytearray(b'1') * {SIZE}; print('there', flush=True); time.sleep(400)"
    before = psutil.Process().memory_info().rss / 2**20
    with PeakMemory() as memory, subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        until(lambda: memory.megabytes > before + 100)
        child.kill()
    assert memory.megabytes > before + 100
