"""Runs that are killed, stopped with Ctrl-C, or started twice in one folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.pipelines.made import Answer, call, make_room, spawn
from tests.pipelines.short import FAST, SMALL, report, stages, start, wait_for
from toolkit.render.field import Field

Capsys = pytest.CaptureFixture[str]


def test_killed_at_several_moments_the_run_goes_on(done: Path, tmp_path: Path) -> None:
    """Killed right after the capture, while the field is fitted, and after it; then left alone."""
    arguments = ["run", done.parent / "room", "--out", tmp_path / "out", *SMALL]
    for stage, delay in (("capture", 0.0), ("views", 1.0), ("field", 0.05)):
        process = start(*arguments)
        wait_for(tmp_path / "out" / "stages" / f"{stage}.json", process)
        time.sleep(delay)
        process.kill()
        process.communicate()
    answer = spawn(*arguments)
    assert answer.returncode == 0, answer.stderr
    data = report(tmp_path / "out")
    cached = stages(data)
    assert cached["capture"] and cached["views"] and cached["field"]
    # The surface repeats; how far a field gets in a few seconds depends on what else the machine does.
    for method, noise in (("tsdf", 0.1), ("field", 3.0)):
        assert data["evaluation"][method]["psnr"] == pytest.approx(report(done)["evaluation"][method]["psnr"], abs=noise)
    assert not list((tmp_path / "out").rglob(".tmp-*"))


def test_ctrl_c_while_fitting_keeps_the_field_and_reports(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 10)
    long = ("--budget", "60", "--set", "fit.passes=null", "--set", "fit.depth_from=off")  # without matching steps begin at once
    process = start("run", tmp_path / "room", "--out", tmp_path / "out", *FAST, *long)
    wait_for(tmp_path / "out" / "stages" / "views.json", process)
    time.sleep(5)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert time.monotonic() - began < 30
    data = report(tmp_path / "out")
    assert any("stopped early" in warning for warning in data["warnings"])
    assert data["evaluation"]["field"]["views"] == 2
    assert "Traceback" not in err
    assert not (tmp_path / "out" / "exports").exists()  # nobody waits for a video after Ctrl-C
    answer = spawn("run", tmp_path / "room", "--out", tmp_path / "out", *FAST)
    assert answer.returncode == 0, answer.stderr
    again = report(tmp_path / "out")
    assert not any("stopped early" in warning for warning in again["warnings"]) and not stages(again)["field"] and stages(again)["views"]


def test_ctrl_c_before_the_field_says_how_to_go_on(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 60, depth=True)
    process = start("run", tmp_path / "room", "--out", tmp_path / "out", *FAST)
    wait_for(tmp_path / "out" / "run.json", process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "same command again" in Answer(130, out, err).sentence()


def test_ctrl_c_twice_ends_at_once(tmp_path: Path) -> None:
    make_room(tmp_path / "room", 10)
    process = start("run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--budget", "60", "--set", "fit.passes=null")
    wait_for(tmp_path / "out" / "stages" / "views.json", process)
    time.sleep(1)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    began = time.monotonic()
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130 and time.monotonic() - began < 10  # after one alone there would be a report, and code 0
    assert "Traceback" not in err
    # A fit ends within a step of the first, so its stage may be whole by the time of the second; nothing after it is.
    done = {path.stem for path in (tmp_path / "out" / "stages").glob("*.json")}
    assert "views" in done and done.isdisjoint({"render", "export", "evaluate"})
    assert not (tmp_path / "out" / "report.json").exists() and not (tmp_path / "out" / "exports").exists()
    if "field" in done:
        assert Field.load(tmp_path / "out" / "field.safetensors").voxels > 0


def test_ctrl_c_while_code_is_made_from_text(tmp_path: Path) -> None:
    """Many imports do that. CPython then ends `python -m` by the signal, although the interrupt was caught."""
    (tmp_path / "interrupted.py").write_text(
        "import atexit, signal, pipelines.cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # tests that run in the background inherit that it is ignored
        "atexit.register(print, 'tidied')\n"
        "pipelines.cli.app = lambda: exec('import signal; signal.raise_signal(signal.SIGINT)')\n"
        "pipelines.cli.program()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])}
    answer = subprocess.run([sys.executable, "-m", "interrupted"], env=environment, capture_output=True, text=True, timeout=60)
    assert answer.returncode == 130 and answer.stderr == "fieldfuse: stopped\n" and answer.stdout == "tidied\n"


def test_two_runs_in_one_folder(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 10)
    arguments = ["run", tmp_path / "room", "--out", tmp_path / "out", *FAST, "--budget", "30"]
    process = start(*arguments)
    wait_for(tmp_path / "out" / "stages" / "capture.json", process)
    answer = call(capsys, *arguments)
    process.kill()
    process.communicate()
    assert answer.code == 2
    assert "another fieldfuse command" in answer.sentence()
