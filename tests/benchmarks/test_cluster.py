"""What the benchmark of a cluster reads from a run, and its table. The runs themselves are in `tests/cluster`."""

from __future__ import annotations

import os
from pathlib import Path

from benchmarks.cluster import found, table
from fieldfuse.files import write_json


def made_run(folder: Path, cells: int) -> Path:
    write_json(folder / "report.json", {"evaluation": {"field": {"psnr": 30.25}}})
    write_json(folder / "stages" / "field.json", {"seconds": 61.24})
    (folder / "field.safetensors").write_bytes(b"a field")
    for cell in range(cells):
        write_json(folder / "cells" / "plan.json", {})
        write_json(folder / "cells" / f"cell-{cell:03}.json", {})
        os.utime(folder / "cells" / f"cell-{cell:03}.json", (1e9 + 10 * cell, 1e9 + 10 * cell))
        os.utime(folder / "cells" / "plan.json", (1e9 - 5, 1e9 - 5))
    return folder


def test_a_row_has_the_seconds_from_the_plan_to_the_last_cell(tmp_path: Path) -> None:
    row = found(made_run(tmp_path / "cells", 3))
    assert row == {"psnr": 30.25, "seconds": 61.2, "cells_seconds": 25.0, "field": row["field"]} and len(row["field"]) == 8
    whole = found(made_run(tmp_path / "whole", 0))
    assert "cells_seconds" not in whole and whole["field"] == row["field"]
    assert "| two workers | 30.25 dB | 61.2 | 25 |  | " in table({"rows": [{"way": "two workers", **row}]})
