"""Metres of structure from motion, against the truth of simulated captures."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import scale


@pytest.mark.slow
def test_metres_that_structure_from_motion_gets(tmp_path: Path) -> None:
    """Markers to half a percent, GPS and two points that are marked once each to one percent."""
    row = scale.measured(tmp_path, "table", 0, 20)
    assert row["placed"] >= 18
    assert row["marker"]["error"] < 0.5 and row["gps"]["error"] < 1 and row["distance"]["error"] < 1
    line = scale.table({"rows": [{"scene": "table", "seed": 0, "frames": 20, **row}]}).splitlines()[-1]
    assert line.startswith("| table | 0 |") and line.count("%") == 6


def test_ways_that_a_scene_lacks_are_left_out_of_the_table() -> None:
    rows = [{"scene": "street", "seed": 1, "frames": 30, "placed": 29, "gps": {"error": 0.123, "stated": 0.2}}]
    assert "| street | 1 | 29 of 30 | – | – | 0.12% (0.20%) |" in scale.table({"rows": rows})
