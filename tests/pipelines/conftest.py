"""A finished run that tests of several files read."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.pipelines.made import make_room, spawn
from tests.pipelines.short import SMALL

RESULTS = ("exports/field.html", "report.html")


@pytest.fixture(scope="session")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run on the room with depth, made once for all tests that only read it."""
    root = tmp_path_factory.mktemp("room")
    make_room(root / "room", 16, depth=True)
    answer = spawn("run", root / "room", "--out", root / "out", *SMALL)
    assert answer.returncode == 0, answer.stderr
    assert "PSNR" in answer.stdout and answer.stdout.splitlines()[-2:] == [str(root / "out" / name) for name in RESULTS]
    assert "field: " in answer.stderr and "Traceback" not in answer.stderr
    return root / "out"
