"""Ctrl-C while a field is fitted, and while code is made from text; `tests/stability` stops and kills runs at every stage."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fieldfuse.pipelines.console import STOPPING
from fieldfuse.render.field import Field
from tests.pipelines.made import call, environment, make_room
from tests.pipelines.short import FAST, HUNG, report, stages, wait_for

Capsys = pytest.CaptureFixture[str]
# Of a fit that does not end by itself while a test looks at it; without matching steps begin at once.
LONG = ("--budget", "600", "--set", "fit.passes=null", "--set", "fit.depth_from=off")


def fitting(told: Path, *arguments: object) -> subprocess.Popen[str]:
    """`fieldfuse …` as a process of its own, which makes the file `told` when its fit is under way."""
    words = [sys.executable, "-m", "tests.pipelines.fitting", str(told), *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment())


def test_ctrl_c_while_fitting_keeps_the_field_and_reports(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    arguments = ["run", tmp_path / "room", "--out", tmp_path / "out", *FAST]
    process = fitting(tmp_path / "fitting", *arguments, *LONG)
    wait_for(tmp_path / "fitting", process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=HUNG)  # a whole fit would take longer
    assert process.returncode == 0, err
    data = report(tmp_path / "out")
    assert any("stopped early" in warning for warning in data["warnings"])
    assert data["evaluation"]["field"]["views"] == 2
    assert "Traceback" not in err
    assert not (tmp_path / "out" / "exports").exists()  # nobody waits for a video after Ctrl-C
    answer = call(capsys, *arguments)
    assert answer.code == 0, answer.err
    again = report(tmp_path / "out")
    assert not any("stopped early" in warning for warning in again["warnings"]) and not stages(again)["field"] and stages(again)["views"]


def test_ctrl_c_while_code_is_made_from_text(tmp_path: Path) -> None:
    """Many imports do that. CPython then ends `python -m` by the signal, although the interrupt was caught."""
    (tmp_path / "interrupted.py").write_text(
        "import atexit, signal, fieldfuse.pipelines.cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # tests that run in the background inherit that it is ignored
        "atexit.register(print, 'tidied')\n"
        "fieldfuse.pipelines.cli.program(lambda: exec('import signal; signal.raise_signal(signal.SIGINT)'))\n"
    )
    there = environment(PYTHONPATH=os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])]))
    answer = subprocess.run([sys.executable, "-m", "interrupted"], env=there, capture_output=True, text=True, timeout=HUNG)
    assert answer.returncode == 130 and answer.stderr == "fieldfuse: stopped\n" and answer.stdout == "tidied\n"


def test_ctrl_c_twice_ends_at_once(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 10)
    process = fitting(tmp_path / "fitting", "run", tmp_path / "room", "--out", tmp_path / "out", *FAST, *LONG)
    wait_for(tmp_path / "fitting", process)
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    while process.stderr.readline().strip() not in (STOPPING, ""):  # the first has been heard
        pass
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 130  # after one alone there would be a report, and code 0
    assert "Traceback" not in err
    # A fit ends within a step of the first, so its stage may be whole by the time of the second; nothing after it is.
    done = {path.stem for path in (tmp_path / "out" / "stages").glob("*.json")}
    assert "views" in done and done.isdisjoint({"render", "export", "evaluate"})
    assert not (tmp_path / "out" / "report.json").exists() and not (tmp_path / "out" / "exports").exists()
    if "field" in done:
        assert Field.load(tmp_path / "out" / "field.safetensors").voxels > 0
