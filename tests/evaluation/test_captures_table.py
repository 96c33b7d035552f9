"""What came of each capture as one table."""

from __future__ import annotations

from typing import Any

from fieldfuse.evaluation.captures_table import captures_table

READ = {
    "state": "read", "error": None, "kind": "llff", "poses": "given", "registered": 20, "total": 21, "masks": 0, "psnr": 22.126,
    "nearest_image": 15.04, "seconds": 61.4, "effects": ["motion_blur"], "warnings": [],
}  # fmt: skip
REFUSED = {"state": "refused", "error": "no | poses", "kind": "llff", "poses": None}


def run(variant: str = "default", seed: int = 0, **facts: Any) -> dict[str, Any]:
    return {"variant": variant, "seed": seed, **facts}


def rows(captures: dict[str, list[dict[str, Any]]]) -> list[list[str]]:
    told = [{"capture": name, "runs": runs} for name, runs in captures.items()]
    text = captures_table({"machine": {"cores": 2, "threads": 1}, "command": "fieldfuse bench captures DATA", "captures": told})
    assert "    fieldfuse bench captures DATA\n" in text
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")]


def test_variants_have_columns_and_seeds_stand_side_by_side() -> None:
    off = run("effects off", **{**READ, "psnr": 21.0})
    seeds = [run(**READ), run(seed=1, **{**READ, "psnr": 22.0})]
    head, _, fern, gum = rows({"fern": [*seeds, off], "gum": [run(**{**READ, "masks": 20, "warnings": ["dark", "few"], "effects": []})]})
    assert head[3:5] == ["PSNR, default", "PSNR, effects off"]
    assert fern == ["fern", "llff, given", "20 of 21", "22.13, 22.00", "21.00", "15.0", "motion blur", "61", "none"]
    assert gum[3:5] == ["22.13 (within its masks)", "–"] and gum[-3:] == ["nothing", "61", "2: dark"]


def test_a_refusal_is_told_once() -> None:
    own = [run(**REFUSED), run("own poses", **REFUSED)]
    (_, _, *found) = rows({"a": own, "b": [run(**REFUSED), run("own poses", **READ)], "c": [run(**{**REFUSED, "error": "x" * 999})]})
    assert found[0][3:5] == ["refused: no / poses", "refused"] and found[1][3:5] == ["refused: no / poses", "22.13"]
    assert len(found[2][3]) < 300 and all(len(row) == 9 for row in found)
