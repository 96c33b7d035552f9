"""What the doctor finds on a sound machine and on broken ones."""

from __future__ import annotations

import configparser
import re
import sys
from pathlib import Path

import pytest

from fieldfuse.pipelines import doctor
from fieldfuse.pipelines.doctor import FAIL, OK, WARN, Check

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def checks() -> dict[str, Check]:
    return {check.name: check for check in doctor.collect()}


def test_a_machine_that_runs_the_tests_is_fit_for_use(checks: dict[str, Check]) -> None:
    assert [check for check in checks.values() if check.status == FAIL] == []
    assert {"open3d", "pycolmap", "torch device", "kernels", "video", "cores", "memory", "disk", "lpips", "xfeat"} <= checks.keys()
    assert checks["open3d"].found.startswith("0.")
    assert all(check.status == OK or check.advice for check in checks.values())


def test_every_requirement_is_looked_at(checks: dict[str, Check]) -> None:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    wanted = {re.split(r"[<>=;]", line)[0].strip() for line in parser["options"]["install_requires"].split("\n") if line.strip()}
    assert wanted - {"open3d-cpu"} <= checks.keys()


def test_a_child_that_aborts_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PYCOLMAP", "import os; os.abort()")
    found = doctor._pycolmap()
    assert found.status == FAIL and "signal 6" in found.found and "pycolmap" in found.advice


def test_a_kernel_that_renders_wrongly_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = "import fieldfuse.pipelines.kernel_check as k; k.engine_errors = lambda: {'numba': 0.1}; k.report()"
    monkeypatch.setattr(doctor, "KERNELS", wrong)
    found = doctor._kernels()
    assert found.status == FAIL and "numba 1e-01" in found.found and "constraints.txt" in found.advice


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_a_slightly_wrong_kernel_is_noticed(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    from fieldfuse.pipelines import kernel_check
    from fieldfuse.render.numba_renderer import NumbaRenderer

    plain = NumbaRenderer.render
    assert max(kernel_check.engine_errors().values()) < kernel_check.TOLERANCE
    monkeypatch.setattr(NumbaRenderer, "render", lambda *given: plain(*given) * factor)
    with pytest.raises(ArithmeticError, match="numba"):
        kernel_check.report()


def test_a_child_that_hangs_is_a_finding() -> None:
    good, said = doctor.in_child("import time; time.sleep(30)", seconds=0.5)
    assert not good and "no answer" in said


@pytest.mark.parametrize(
    ("message", "advice"),
    [
        ("ImportError: libusb-1.0.so.0: cannot open shared object file: No such file or directory", "libusb-1.0-0"),
        ("OSError: libGL.so.1: cannot open shared object file: No such file or directory", "libgl1"),
        ("OSError: libsomething.so.4: cannot open shared object file", "libsomething.so.4"),
        ("ModuleNotFoundError: No module named 'open3d'", "open3d-cpu"),
        ("ValueError: strange", "install it again"),
    ],
)
def test_advice_for_open3d_names_the_cure(monkeypatch: pytest.MonkeyPatch, message: str, advice: str) -> None:
    kind, _, text = message.partition(": ")
    monkeypatch.setattr(doctor, "OPEN3D", f"raise {kind}({text!r})")
    found = doctor._open3d()
    assert found.status == FAIL and advice in found.advice


def test_a_check_that_raises_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)  # `import cv2` now raises ImportError
    monkeypatch.setattr(doctor, "OPEN3D", "print('0.0')")
    monkeypatch.setattr(doctor, "PYCOLMAP", "print('0.0')")
    monkeypatch.setattr(doctor, "KERNELS", "print('0.0')")
    found = {check.name: check for check in doctor.collect()}
    assert found["video"].status == FAIL and "cv2" in found["video"].found
    assert found["disk"].status in (OK, WARN)


def test_little_memory_and_disk_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    import psutil

    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=2**29, total=2**33))
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: SimpleNamespace(free=2**20))
    assert doctor._memory().status == WARN and "--image-size" in doctor._memory().advice
    assert doctor._disk().status == FAIL and "--out" in doctor._disk().advice


def test_the_table_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    warned, failed = Check("lpips", WARN, "none", "make lpips"), Check("open3d", FAIL, "no [lib]", "apt-get it")
    doctor.show([Check("python", OK, "3.11 [x]"), warned, failed])
    shown = capsys.readouterr().out
    assert "3.11 [x]" in shown and "no [lib]" in shown
    assert shown.index("apt-get it") < shown.index("make lpips")
    assert "can run here" not in shown
    doctor.show([Check("python", OK, "3.11")])
    assert "can run here" in capsys.readouterr().out
