"""Ordinary runs become one table: seeds side by side, a surface's scores below its field's."""

from __future__ import annotations

from typing import Any

from fieldfuse.evaluation.run_table import is_report, run_table


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


def test_bare_photos_are_named_by_what_holds_them() -> None:
    assert [row[0] for row in rows(run_table([run("/data/fox/images/", 29.5), run("photos", 20.0)], ["one", "two"]))] == [
        "fox/images",
        "photos",
    ]


def test_only_reports_are_reports() -> None:
    assert is_report(run("/data/fox", 29.5))
    assert not is_report({"rows": []}) and not is_report(None)
