"""Measurements become tables of a page: runs with seeds side by side, total budgets, and whatever else leaves JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.run_tables import budget_table, run_table
from benchmarks.table import sections
from fieldfuse.evaluation.tradeoff import tradeoff_data
from fieldfuse.files import write_json
from tests.evaluation.test_tradeoff import ladder
from tests.pipelines.made import bench


def run(source: str, psnr: float, seed: int = 0, tsdf: float | None = None, command: str = "") -> dict[str, Any]:
    scores = {"psnr": psnr, "ssim": 0.9, "lpips": 0.1, "psnr_masked": None, "coverage": None}
    surface = None if tsdf is None else {**scores, "psnr": tsdf, "psnr_masked": tsdf + 2, "coverage": 0.5}
    return {
        "source": source,
        "command": f"fieldfuse run {source} {command}",
        "created": "2026-11-23T10:00:00+00:00",
        "seconds_total": 60.0 + seed,
        "evaluation": {"field": scores, "tsdf": surface, "nearest_image": {"psnr": 11.25}},
        "views": {"total": 50, "test": 7, "width": 240, "height": 135},
        "settings": {"fit": {"finetune": True, "budget": 30.0}, "engine": "auto", "threads": 1, "seed": seed},
        "stages": [
            {"name": "network", "seconds": 20.0, "peak_memory_mb": None},
            {"name": "field", "seconds": 31.0, "peak_memory_mb": 900.0},
            {"name": "views", "seconds": 5.0, "peak_memory_mb": 300.0},
        ],
        "timeline": [],
        "machine": {"python": "3.11", "device": "cpu"},
    }


def rows(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")][2:]


def test_seeds_stand_side_by_side() -> None:
    text = run_table([run("/data/fox", 29.5), run("/data/gum", 24.0), run("/data/fox", 29.1, seed=1)], ["one", "two", "three"])
    same = ["43 / 7", "240×135", "30 s, one thread"]
    assert rows(text) == [
        ["fox", *same, "29.5, 29.1", "0.900, 0.900", "0.100, 0.100", "11.2", "51 s", "900 MB", "1 min, 1 min 1 s"],
        ["gum", *same, "24.0", "0.900", "0.100", "11.2", "51 s", "900 MB", "1 min"],
    ]
    assert text.startswith("Measured 2026-11-23, Python 3.11, device cpu:") and "    three\n" in text


def test_settings_that_change_scores_keep_runs_apart() -> None:
    off = run("/data/fox", 20.0, command="--set fit.depth_from=off --set 'export.formats=[cameras]'")
    off["settings"]["fit"]["finetune"] = False
    found = rows(run_table([run("/data/fox", 29.5), off], ["one", "two"]))
    assert [row[3] for row in found] == ["30 s, one thread", "networks alone, one thread, `fit.depth_from=off`"]


def test_a_surface_is_scored_twice() -> None:
    field, surface = rows(run_table([run("/data/kitchen", 27.0, tsdf=17.5)], ["one"]))
    assert field[3:5] == ["30 s, one thread", "27.0"]
    assert surface[3:5] == ["its TSDF", "17.5 (19.5 on the 50% where it has surface)"]


def test_runs_of_a_budget_become_one_table() -> None:
    def run(source: str, asked: float, real: float, effects: bool) -> dict[str, object]:
        choice = {"image_size": 240, "fit_seconds": 12.5, "resolution": 256, "video_frames": 0, "effects": effects}
        told = {"asked_seconds": asked, "predicted_seconds": asked, "real_seconds": real, "stages": {}, "choice": choice}
        return {"source": source, "budget": told, "evaluation": {"field": {"psnr": 27.25}}}

    fox = run("/data/fox", 30, 36, False)
    fox["budget"]["choice"] |= {"texture": False, "page": True}  # type: ignore[index]
    text = budget_table([run("/data/lego", 60, 63, True), fox], ["fieldfuse run a", "fieldfuse run b"])
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert rows[2].startswith("| fox | 30 s | 30.0 s | 36.0 s | +20% | not looked for |") and rows[3].startswith("| lego | 60 s |")
    assert "240 pixels, 256³, no video, no texture | 27.2 |" in rows[2] and "256³, no video | 27.2 |" in rows[3]
    assert "1 of 2 runs took what was predicted, within 15%" in text and "    fieldfuse run b" in text


def test_the_table_tells_what_is_missing(tmp_path: Path) -> None:
    missing = {"left_out": ["field-900s-seed0", "tsdf-voxel2.0-seed0"], "refused": ["No surface was made: nothing to match."]}
    data = tradeoff_data({"command": "fieldfuse tradeoff room", "unit": "m", "rows": ladder(), "machine": {"cores": 2}, **missing})
    write_json(tmp_path / "room" / "tradeoff.json", data)
    ((name, text),) = sections([tmp_path / "room" / "tradeoff.json"], None, None)
    lines = text.splitlines()
    assert name == "room" and lines[0] == "### room" and "load 1.5" in lines[2] and "    fieldfuse tradeoff room" in lines
    points = [line for line in lines if line.startswith(("| Field", "| TSDF"))]
    assert len(points) == 5 and any("| 1 cm |" in line for line in points)
    assert lines[-2:] == ["- Not measured for want of time: field-900s, tsdf-voxel2.0.", "- No surface was made: nothing to match."]


def test_results_of_benchmarks_go_into_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    row = {"views": 3, "start": "direct", "budget": 0, "psnr": 20.0, "seconds": 5.0}
    rows = [row, {"views": 3, "start": "nearest", "budget": 0, "psnr": 9.0}]
    about = {"machine": {"cores": 2, "threads": 1}, "command": f"python -m benchmarks.few_views {tmp_path}/gum --out /x/y"}
    write_json(tmp_path / "few" / "few_views.json", {"experiment": "few_views", "rows": rows, **about})
    (tmp_path / "page.md").write_text("# Results\n")
    answer = bench(capsys, "table", tmp_path / "few" / "few_views.json", "--into", tmp_path / "page.md", "--data", tmp_path)
    assert answer.code == 0, answer.err
    text = (tmp_path / "page.md").read_text()
    assert "<!-- measured: few -->\nMeasured " in text and "| 3 | 9.00 | 20.00 | 5 |" in text
    assert "    python -m benchmarks.few_views DATA/gum --out runs/y\n" in text


@pytest.mark.parametrize(
    "damage",
    [
        {"experiment": "lunch"},
        {"experiment": "../table"},
        {"experiment": "timing"},
        {"experiment": "table"},
        {"rows": [1]},
        {"rows": [{"views": 3, "start": "direct", "budget": 0, "psnr": "20"}]},
        {"rows": [{"views": 3, "start": "direct", "budget": 0, "psnr": 20.0, "seconds": "5"}]},
        {"rows": None},
        {"machine": 3},
        {"experiment": "suites", "suite": "llff", "rows": [1]},
    ],
)
def test_damaged_results_leave_the_page(damage: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = {"experiment": "few_views", "rows": [], "machine": {}, "command": "python"}
    write_json(tmp_path / "results.json", {**whole, **damage})
    (tmp_path / "page.md").write_text("# Results\n")
    answer = bench(capsys, "table", tmp_path / "results.json", "--into", tmp_path / "page.md")
    assert answer.code == 2 and "results.json holds no results" in answer.sentence() and (tmp_path / "page.md").read_text() == "# Results\n"
