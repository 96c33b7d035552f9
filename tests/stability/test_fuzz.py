"""Hundreds of damaged files for the readers, and that the watch over them would see what it is there for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.pipelines.made import environment
from tests.stability.fuzz import drive
from tests.stability.fuzz.drive import ROOT, fuzz

INPUTS = 300


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_hundreds_of_damaged_files() -> None:
    result = fuzz(INPUTS, seed=int(os.environ.get("FIELDFUSE_SEED", "20")))
    assert result.inputs == INPUTS
    assert result.refused > INPUTS // 3  # most damage is noticed; some of it is in what nobody reads
    assert len(result.targets) >= 15
    assert result.problems == []


PLANTED = """
import json, os, subprocess, sys, time
from pathlib import Path
from tests.stability.fuzz import watch as watching
from tests.stability.fuzz.targets import Target
from tests.stability.fuzz.watch import Watch, bound_memory
from tests.stability.fuzz.worker import Counts, one
from fieldfuse.errors import InputError

place = Path(sys.argv[1])
root = place / "captures" / "planted"
root.mkdir(parents=True)
(root / "a.bin").write_bytes(b"abc")
(place / "secret.txt").write_text("secret")
watching.SECONDS, watching.WAITING = 0.3, 1.0

def refuse(text):
    raise InputError(text)

def stubborn(act):
    end = time.time() + 20
    while time.time() < end:
        try:
            act()
        except Exception:
            pass

PLANTS = {
    "fine": lambda: None,
    "sentence": lambda: refuse("this is a good sentence"),
    "a word": lambda: refuse("bad"),
    "a page": lambda: refuse("line 1 of it\\n" * 80),
    "IndexError": lambda: [][1],
    "busy": lambda: stubborn(lambda: sum(range(1000))),
    "waiting": lambda: stubborn(lambda: time.sleep(0.1)),
    "read outside": lambda: (place / "secret.txt").read_text(),
    "write": lambda: (root / "new.txt").write_text("x"),
    "write outside": lambda: (place / "new.txt").write_text("x"),
    "shell": lambda: os.system("true"),
    "process": lambda: subprocess.run(["true"]),
    "eval": lambda: eval("1 + 1"),
    "pickle": lambda: __import__("pickle").loads(b"cos\\nsystem\\n(S'true'\\ntR."),
    "memory": lambda: bytearray(3 * 2**30),
}
watch = Watch(place / "captures")
bound_memory(2**30)
told = {}
for name, plant in PLANTS.items():
    target = Target(name, ("a.bin",), lambda root: None, lambda root, number: plant())
    problem = one(target, root, 1, 1, watch, place / "current", Counts())
    told[name] = problem and problem["kind"]
print(json.dumps(told))
"""


def test_what_is_planted_is_found(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PLANTED, str(tmp_path)], capture_output=True, text=True, env=environment(), cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told.pop("fine") is None and told.pop("sentence") is None
    escapes = {name for name, kind in told.items() if kind == "escape"}
    assert escapes == {"read outside", "write", "write outside", "shell", "process", "eval", "pickle"}
    rest = {name: kind for name, kind in told.items() if name not in escapes}
    assert rest == {
        "a word": "not a sentence",
        "a page": "not a sentence",
        "IndexError": "IndexError",
        "busy": "hang",
        "waiting": "hang",
        "memory": "MemoryError",
    }


def test_a_worker_that_dies_is_reported_and_the_next_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver itself: a target that kills its process at one input."""
    program = (
        "import os, signal, sys\n"
        "from tests.stability.fuzz import worker\n"
        "from tests.stability.fuzz.targets import TARGETS, Target\n"
        "def act(root, number):\n"
        "    if number == 7:\n"
        "        os.kill(os.getpid(), signal.SIGSEGV)\n"
        "def make(root):\n"
        "    root.mkdir(parents=True)\n"
        "    (root / 'a.bin').write_bytes(b'abc')\n"
        "worker.TARGETS = (Target('deadly', ('a.bin',), make, act),)\n"
        "sys.exit(worker.main())\n"
    )
    (tmp_path / "deadly.py").write_text(program)

    def popen(command: list[str], **options: Any) -> subprocess.Popen[str]:
        return subprocess.Popen([command[0], str(tmp_path / "deadly.py"), *command[3:]], **options)

    monkeypatch.setattr(drive, "subprocess", SimpleNamespace(Popen=popen, PIPE=subprocess.PIPE))
    problems = [(problem["kind"], problem["number"], problem["text"]) for problem in fuzz(20, 1).problems]
    assert problems == [("crash", 7, "ended by SIGSEGV")]
