"""Small files that stand for large things are refused before they cost anything."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pipelines.made import environment
from tests.stability.runs import ROOT


@pytest.mark.timeout(600)
def test_bombs(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.stability.bombs", str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment(),
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    result = json.loads(done.stdout)
    assert len(result) >= 22
    read = {name for name, outcome in result.items() if outcome == "read: 6"}
    assert read == {"six frames announced as 90 million", "six frames announced as two thousand million"}
    assert {name: outcome for name, outcome in result.items() if outcome != "refused" and name not in read} == {}
