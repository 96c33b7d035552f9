"""What is compiled before a fit's clock runs: all that the fit needs, once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TWICE = {"fieldfuse.backends.numba.per_sample._move"}  # rows of two kinds


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_no_kernel_is_compiled_or_loaded_while_the_clock_of_a_fit_runs(decoder: str) -> None:
    run = [sys.executable, "-m", "tests.training.kernels", decoder]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["missed"] == {"pictures": [], "masked": [], "alpha": [], "depth": []}
    assert set(told["several"]) <= TWICE
