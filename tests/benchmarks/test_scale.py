"""Metres of structure from motion, against the truth of simulated captures."""

from __future__ import annotations

from benchmarks import scale


def test_ways_that_a_scene_lacks_are_left_out_of_the_table() -> None:
    rows = [{"scene": "street", "seed": 1, "frames": 30, "placed": 29, "gps": {"error": 0.123, "stated": 0.2}}]
    assert "| street | 1 | 29 of 30 | – | – | 0.12% (0.20%) |" in scale.table({"rows": rows})
