"""How the program starts and how it fails: help in no time, no heavy library for it, no traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.pipelines.made import call, environment, make_room

Capsys = pytest.CaptureFixture[str]


def unit() -> float:
    """Seconds of the processor that a piece of Python takes here, an eighth of one where help took two thirds: the best of three."""
    taken = []
    for _ in range(3):
        began = time.process_time()
        sum(number * number for number in range(1_000_000))
        taken.append(time.process_time() - began)
    return min(taken)


@pytest.mark.parametrize(
    ("words", "units"),
    [
        (("-c", "import fieldfuse"), 10),
        (("-m", "fieldfuse", "--help"), 16),
        (("-m", "fieldfuse", "run", "--help"), 16),
    ],
)
def test_help_is_quick(words: tuple[str, ...], units: int) -> None:
    """By what the processor does for it, against what it does for other work: other machines are slower, and busy."""
    for _ in range(2):  # the first writes bytecode
        before = os.times()
        answer = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment())
        after = os.times()
    assert answer.returncode == 0 and ("Usage: " in answer.stdout) == ("--help" in words)
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    assert 0 < spent < units * unit()


def test_heavy_libraries_are_not_loaded_for_help() -> None:
    heavy = {"torch", "open3d", "cv2", "numpy", "pycolmap", "trimesh"}
    program = f"import sys, fieldfuse.pipelines.cli; print(sorted({heavy} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment())
    assert answer.stdout.strip() == "[]", answer.stdout + answer.stderr


def test_unexpected_errors_leave_a_log_and_no_traceback(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    make_room(tmp_path / "room", 6)

    def fail(*_: object) -> None:
        raise RuntimeError("a bolt is loose")

    monkeypatch.setattr("fieldfuse.poses.result.given_poses", fail)
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", "--quiet")
    assert answer.code == 1
    assert "error.log" in answer.sentence() and "RuntimeError" in answer.sentence()
    assert "a bolt is loose" in (tmp_path / "out" / "error.log").read_text()


def test_doctor_as_json(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.pipelines.doctor.KERNELS", "print('sound')")  # tests/test_doctor.py runs them
    answer = call(capsys, "doctor", "--json")
    checks = json.loads(answer.out)
    assert {"python", "torch", "pycolmap"} <= {check["name"] for check in checks}
    assert answer.code == int(any(check["status"] == "fail" for check in checks))


def test_help_tells_when_a_fit_starts_from_the_networks(capsys: Capsys) -> None:
    from fieldfuse.training.start import FEW_VIEWS

    assert f"fewer than {FEW_VIEWS} training pictures" in " ".join(call(capsys, "run", "--help").out.split())


def test_the_list_of_commands_cuts_no_text_off(capsys: Capsys) -> None:
    assert "..." not in call(capsys, "--help").out.partition("Commands:")[2]
