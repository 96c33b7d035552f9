"""Faults in the middle of a run: kill -9, signals at each stage, a full disk at each writer, clocks that jump, two runs, little memory."""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fieldfuse.config import Settings
from fieldfuse.pipelines.folder import RunFolder
from tests.pipelines.made import environment
from tests.stability.kills import kill_runs
from tests.stability.runs import OPTIONS, PATIENCE, ROOT, corrupt, differences, leftovers, make_source
from tests.stability.stops import KINDS, fieldfuse, stop_everywhere
from tests.stability.writers import ELSEWHERE

LONG = pytest.mark.timeout(900)  # what takes half a minute alone takes minutes on a busy machine


@pytest.mark.slow
@LONG
def test_killed_twice_at_random_the_run_goes_on_to_the_same_files(tmp_path: Path) -> None:
    survey = kill_runs(tmp_path, kills=2, seed=int(os.environ.get("FIELDFUSE_SEED", "7")), each=3, network_share=0)
    assert survey.kills == 2 and not survey.wrong


def test_the_check_of_a_folder_notices_damage(tmp_path: Path) -> None:
    (tmp_path / "stages").mkdir()
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "b.png").write_bytes(b"\x89PNG")
    (tmp_path / "field.safetensors").write_bytes(b"x" * 20)
    (tmp_path / "c.txt").touch()
    (tmp_path / ".tmp-12-d.json").write_text("{")
    (tmp_path / "stages" / "views.json").write_text(json.dumps({"outputs": {"views.safetensors": 5}}))
    found = corrupt(tmp_path)
    assert [
        name for name in ("a.json", "b.png", "field.safetensors", "c.txt", "views.safetensors") if not any(name in text for text in found)
    ] == []
    assert not any(".tmp" in text for text in found) and leftovers(tmp_path) == [".tmp-12-d.json"]


def test_the_comparison_of_folders_notices_changes(tmp_path: Path) -> None:
    for name, value in (("first", 1.0), ("second", 2.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.json").write_text(json.dumps({"far": value, "seconds": value}))
        (tmp_path / name / "only.json").write_text(json.dumps({"seconds": value, "made": value}))
    assert differences(tmp_path / "first", tmp_path / "second") == ["scene.json differs"]
    (tmp_path / "first" / "more.txt").touch()
    assert "more.txt is only in one of them" in differences(tmp_path / "first", tmp_path / "second")


# ------------------------------------------------------------------------------------------------ signals


@pytest.mark.slow
@LONG
@pytest.mark.parametrize(
    ("kind", "times", "only"),
    [("RGB-D", 1, ()), ("RGB-D", 2, ()), ("pictures, from the networks", 2, ("network",))],  # all of it: `make stability`
)
def test_signals_at_each_stage(kind: str, times: int, only: tuple[str, ...], tmp_path: Path) -> None:
    """One folder is stopped at one stage after the other: each time in a sentence, with whole files, and it goes on from there."""
    assert stop_everywhere(tmp_path, KINDS[kind], times, times % 2, only) == []


def test_a_stop_that_is_not_heard_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.stability.stops.os.kill", lambda *_: None)
    found = stop_everywhere(tmp_path, KINDS["RGB-D"], 1, only=("views",))
    assert len(found) == 2 and all("SIG" in text for text in found), found  # it ended with 0, and said nothing of going on


# ------------------------------------------------------------------------------------------------ disks


@pytest.mark.slow
@LONG
def test_every_writer_says_that_the_disk_is_full_or_the_folder_closed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.stability.writers", str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment(),
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    result = json.loads(done.stdout)
    assert len(result) >= 130
    assert {case: what for case, what in result.items() if what != "ok"} == {}
    assert not list(tmp_path.rglob(".tmp*"))


WRITES = re.compile(r"\b(?:atomic_path|write_bytes|write_text|save_file|savefig|imwrite|VideoWriter|write_triangle_mesh)\(|open\(\"[wax]")


def test_no_module_with_a_writer_is_left_out() -> None:
    """Every module that opens a file for writing is tried by `writers`, or named with a reason."""
    sources = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in (ROOT / "toolkit").rglob("*.py")}
    found = {name for name, text in sources.items() if WRITES.search(text)}
    tried = (ROOT / "tests" / "stability" / "writers.py").read_text(encoding="utf-8")
    named = {
        # Behind `Field.save`, `save_views` and `simulate`.
        "toolkit/volume/store.py", "toolkit/capture/views_file.py", "toolkit/simulate/simulate.py", "toolkit/export/ply.py",
        "toolkit/nerfusion/training/validate.py",
    }  # fmt: skip
    modules = {name: name.removesuffix(".py").replace("toolkit", "fieldfuse", 1).replace("/", ".") for name in found}
    missing = {name for name in found - named - set(ELSEWHERE) if modules[name] not in tried}
    assert missing == set()
    assert set(ELSEWHERE) <= set(sources) | {"pipelines/doctor.py"}


def test_leftovers_of_every_kind_are_removed_and_nothing_else(tmp_path: Path) -> None:
    with RunFolder(tmp_path) as folder:
        folder.start(Path("source"), Settings())
    (tmp_path / "renders").mkdir()
    gone = [".tmp-12-field.safetensors", ".tmpaB3xYz", "renders/.tmp-7-a.png", "renders/.tmpQQ12zz"]
    kept = [".tmp-mine", ".tmpfiles", ".tmp", "renders/.tmpaB3xYz.keep", "notes.txt"]
    for name in gone + kept:
        (tmp_path / name).write_text("x")
    with RunFolder(tmp_path):
        assert [name for name in gone if (tmp_path / name).exists()] == []
        assert [name for name in kept if not (tmp_path / name).exists()] == []


# ------------------------------------------------------------------------------------------------ clocks, memory, company


@pytest.mark.slow
@LONG
def test_a_wall_clock_that_jumps_by_a_year_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = make_source(tmp_path / "room")
    for index, path in enumerate(sorted(source.rglob("*.png"))):  # files of 1970, of the year 2100 and from before 1970
        os.utime(path, (4.1e9 if index % 3 else 0.0, (0.0, 4.1e9, -1e6)[index % 3]))
    plain, draw, began = time.time, random.Random(0), time.monotonic()
    monkeypatch.setattr(time, "time", lambda: plain() + draw.uniform(-3e7, 3e7))  # by up to a year either way at each look
    done = fieldfuse("run", source, "--out", tmp_path / "out", *OPTIONS, "--json")
    assert done.code == 0, done.err
    report = json.loads(done.out)
    assert all(0 <= stage["seconds"] < time.monotonic() - began for stage in report["stages"])
    assert 0 < report["seconds_total"] < time.monotonic() - began
    again = fieldfuse("run", source, "--out", tmp_path / "out", *OPTIONS, "--json")
    assert again.code == 0 and all(stage["cached"] for stage in json.loads(again.out)["stages"])


RACE = """
import sys
from pathlib import Path
from fieldfuse.pipelines.folder import RunFolder
from fieldfuse.errors import OutputError
print("ready", flush=True)
sys.stdin.readline()
try:
    with RunFolder(Path(sys.argv[1])):
        print("mine", flush=True)
        sys.stdin.read()
except OutputError as error:
    print("busy" if "another fieldfuse command" in str(error) else error, flush=True)
"""


def test_of_six_commands_that_start_at_once_one_gets_the_folder(tmp_path: Path) -> None:
    command = [sys.executable, "-c", RACE, str(tmp_path / "out")]
    racers = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()) for _ in range(6)]
    assert [racer.stdout.readline().strip() for racer in racers if racer.stdout is not None] == ["ready"] * 6
    for racer in racers:
        assert racer.stdin is not None
        racer.stdin.write("go\n")
        racer.stdin.flush()
    said = [racer.stdout.readline().strip() for racer in racers if racer.stdout is not None]
    for racer in racers:
        racer.communicate(timeout=PATIENCE)
    assert sorted(said) == ["busy"] * 5 + ["mine"]
    with RunFolder(tmp_path / "out"):
        pass
