"""Metres of structure from motion, against the truth of a simulated capture."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import scale
from tests.stability.hard.within import Within

GROUP = "metres"
BOUNDS = {"marker": 0.5, "gps": 1.0, "distance": 1.0}  # percent


@pytest.mark.long
def test_metres_that_structure_from_motion_gets(within: Within, tmp_path: Path) -> None:
    """Scale by markers, by the GPS of images, and by two points that are marked once each."""
    row = scale.measured(tmp_path, "table", 0, 20)
    within("images without a pose, of 20", 20 - row["placed"], 2)
    for way, bound in BOUNDS.items():
        within(f"error by {way}, percent", row[way]["error"], bound)
    line = scale.table({"rows": [{"scene": "table", "seed": 0, "frames": 20, **row}]}).splitlines()[-1]
    assert line.startswith("| table | 0 |") and line.count("%") == 6
