"""Fits of so many steps on any machine, and a finished run that tests of several files read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.pipelines.made import make_room, said
from tests.pipelines.short import SMALL, steady

RESULTS = ("exports/field.html", "report.html")


@pytest.fixture(autouse=True)
def _steps_for_seconds() -> Iterator[None]:
    """Fits in this process count steps for seconds. A file that is about seconds has a fixture of this name that does nothing."""
    with steady():
        yield


@pytest.fixture(scope="session")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run on the room with depth, made once for all tests that only read it."""
    root = tmp_path_factory.mktemp("room")
    make_room(root / "room", 16, depth=True)
    with steady():
        answer = said("run", root / "room", "--out", root / "out", *SMALL)
    assert answer.code == 0, answer.err
    assert "PSNR" in answer.out and answer.out.splitlines()[-2:] == [str(root / "out" / name) for name in RESULTS]
    assert "field: " in answer.err and "Traceback" not in answer.err
    return root / "out"
