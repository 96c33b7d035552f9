"""The table of the benchmark of batches, and what it compares."""

from __future__ import annotations

from pathlib import Path

from benchmarks.batch import scores, table
from fieldfuse.files import write_json


def test_the_table_has_shares_and_sentences() -> None:
    row = {"captures": 24, "equal": 23, "failed": ["c23: it is broken"], "code": 1, "killed": 2, "single": 200.0, "beside": 8.0}
    assert table({"rows": [row]}).splitlines()[-1] == (
        "| 24 | 23 of 23 | 1: c23: it is broken | 1 | 2 times | 200 s | 8.0 s (4.0% of the single runs') |"
    )


def test_times_are_no_scores(tmp_path: Path) -> None:
    write_json(tmp_path / "report.json", {"evaluation": {"field": {"psnr": 20.5, "seconds_per_view": 0.1}}})
    assert scores(tmp_path) == {"psnr": 20.5} and scores(tmp_path / "none") is None
