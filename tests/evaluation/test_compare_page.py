"""The comparison's table and page: what is the best, what is left out, and that the page stands alone."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldfuse.errors import InputError
from fieldfuse.evaluation.compare import compare_data, table
from fieldfuse.evaluation.compare_meshes import MeshPictures
from fieldfuse.evaluation.compare_page import write_comparison
from fieldfuse.evaluation.pictures import Pictures, Tiles, ViewPictures
from fieldfuse.evaluation.terminal import comparison_text
from tests.evaluation.browser import embedded_pictures, open_page

SCORE = {"psnr": 25.0, "ssim": 0.8, "lpips": 0.2, "seconds_per_view": 0.5, "coverage": None, "on": {}, "depth_scale": 1.5, "abs_err": 0.02}
DEPTH = {"acc_1": 0.5, "acc_5": 0.9, "depth": {"median_rel": 0.01, "coverage": 1.0}}


def made() -> dict[str, Any]:
    """A field, a surface with holes, and a reference that is better than both."""
    field = {**SCORE, **DEPTH, "on": {"tsdf": {"psnr": 26.0, "ssim": 0.85, "lpips": None}}}
    tsdf = {**SCORE, **DEPTH, "psnr": 20.0, "ssim": 0.80001, "coverage": 0.9, "on": {"tsdf": {"psnr": 27.0, "ssim": 0.86, "lpips": None}}}
    exact = {**tsdf, "psnr": 30.0, "on": {"tsdf_exact": {"psnr": 31.0, "ssim": 0.9, "lpips": None}}}
    geometry = {"accuracy": 0.01, "completeness": 0.02, "voxel_size": 0.01, "f_score_1": 0.5, "f_score_2": 0.7, "f_score_4": 0.9}
    stages = [{"name": "field", "seconds": 30.0, "peak_memory_mb": 500.0}, {"name": "render", "seconds": 2.0, "peak_memory_mb": 700.0}]
    return {
        "source": "/captures/<b>room",
        "capture": {"kind": "transforms", "frames": 20},
        "truth": {"mesh": True, "depth": "exact", "seen_share": 0.25, "unit": "m"},
        "methods": [
            {"key": "field", "title": "Field", "stages": stages, "score": field, "geometry": geometry, "disk_bytes": 1000},
            {"key": "tsdf", "title": "TSDF", "note": "depth of the sensor", "stages": [{"name": "tsdf", "seconds": 4.0}], "score": tsdf},
            {
                "key": "tsdf_exact",
                "title": "TSDF of exact depth",
                "reference": True,
                "score": exact,
                "geometry": {**geometry, "f_score_2": 1.0},
            },
        ],
        "stages": [{"name": "field", "seconds": 30.0, "peak_memory_mb": 500.0}],
        "settings": {"fit": {"budget": 30}},
    }


def cells(data: dict[str, Any]) -> dict[tuple[str, str], list[tuple[str, bool]]]:
    return {(title, row.label): [(cell.text, cell.best) for cell in row.cells] for title, rows in table(data) for row in rows}


def test_the_best_is_marked_and_a_reference_takes_no_part() -> None:
    found = cells(compare_data(made()))
    assert found["Pictures of test views, whole", "PSNR (dB) ↑"] == [("25.00", True), ("20.00", False), ("30.00", False)]
    assert found["Pictures of test views, whole", "SSIM ↑"] == [("0.800", False), ("0.800", False), ("0.800", False)]  # alike as shown
    assert found["The same where TSDF shows surface", "PSNR (dB) ↑"] == [("26.00", False), ("27.00", True), ("–", False)]
    assert found["Cost", "Time to make it"] == [("32 s", False), ("4.0 s", True), ("–", False)]
    assert found["Cost", "Peak memory"] == [("700 MB", False), ("–", False), ("–", False)]
    mesh = "Mesh against the true surface that the cameras saw"
    assert found[mesh, "F-score at 2 voxels ↑"] == [("70.0%", False), ("–", False), ("100.0%", False)]  # the field has no rival


def test_rows_without_numbers_are_left_out() -> None:
    data = made()
    for method in data["methods"]:
        method.pop("geometry", None)
        method["score"] = {**method["score"], "lpips": None}
    found = cells(compare_data(data))
    assert not any(title.startswith("Mesh") for title, _ in found)
    assert ("Pictures of test views, whole", "LPIPS ↓") not in found
    assert not any("exact depth shows" in title for title, _ in found)


def test_the_form_is_fixed_and_stays() -> None:
    once = compare_data({"methods": [{"key": "field", "title": "Field", "score": {"psnr": float("nan")}}], "more": np.float32(2)})
    assert compare_data(once) == once
    assert json.loads(json.dumps(once, allow_nan=False)) == once
    assert once["methods"][0]["seconds"] is None and once["more"] == 2
    assert list(table(once)) == []
    for bad in ({}, {"methods": []}, {"methods": ["field"]}):
        with pytest.raises(InputError, match="methods"):
            compare_data(bad)


def test_the_terminal_shows_the_same() -> None:
    text = comparison_text(made())
    assert re.search(r"PSNR \(dB\) ↑ +25\.00 \* +20\.00 +30\.00", text)
    assert "TSDF of exact depth" in text and "<b>" not in text


@pytest.mark.parametrize(("width", "tables"), [(60, 3), (80, 2), (100, 1), (None, 1)])
def test_the_terminals_lines_are_no_longer_than_it(width: int | None, tables: int) -> None:
    text = comparison_text(made(), width)
    assert width is None or max(map(len, text.splitlines())) <= width
    assert len(re.findall("PSNR", text)) == tables * len(re.findall("PSNR", comparison_text(made())))
    assert {"25.00", "20.00", "30.00"} <= set(text.split()) and "…" not in text


def pictures() -> tuple[Pictures, list[MeshPictures]]:
    rng = np.random.default_rng(0)

    def noise() -> Any:
        return rng.integers(0, 256, (30, 40, 3)).astype(np.uint8)

    views = []
    for index in range(5):
        tiles = {"field": Tiles(noise(), noise(), noise(), noise()), "tsdf": Tiles(noise(), noise(), noise(), noise())}
        views.append(ViewPictures(f"view {index} <i>", noise(), tiles, noise()))
    mesh = MeshPictures("Seen from outside", {"coloured": {"field": noise()}, "shape": {"truth": noise(), "field": noise()}})
    return Pictures(views, (0.5, 2.0), "m"), [mesh]


def test_the_page_stands_alone(tmp_path: Path) -> None:
    shown, meshes = pictures()
    path, page = write_comparison(tmp_path, made(), shown, meshes, 0.075)
    html = page.read_text(encoding="utf-8")
    assert json.loads(path.read_text())["methods"][0]["peak_memory_mb"] == 700
    assert "<script" not in html and not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert "<b>room" not in html and "<i>" not in html.replace("<i></i>", "")
    # A photo, true depth and four tiles of two methods in five views, three of meshes, bars for error and depth.
    assert len(embedded_pictures(html)) == 5 * (2 + 2 * 4) + 3 + len(re.findall(r"<span>[^<]*<img", html))
    assert all(picture is not None for picture in embedded_pictures(html))


def test_a_browser_shows_every_picture(tmp_path: Path) -> None:
    shown, meshes = pictures()
    _, page = write_comparison(tmp_path, made(), shown, meshes, 0.075)
    seen = open_page(page, tmp_path)
    assert seen.pictures == len(embedded_pictures(page.read_text(encoding="utf-8")))
    assert seen.broken == [] and seen.errors == []
    assert seen.title == "<b>room compared · Fieldfuse"


def test_a_browser_tells_what_is_broken(tmp_path: Path) -> None:
    """The check itself can fail: a picture that is none, and a script that throws."""
    page = tmp_path / "bad.html"
    page.write_text(
        '<!DOCTYPE html><html><head><title>bad</title></head><body><img src="data:image/png;base64,AAAA" alt="no picture">'
        "<script>throw new Error('on purpose')</script></body></html>"
    )
    seen = open_page(page, tmp_path)
    assert seen.broken == ["no picture"]
    assert any("on purpose" in error for error in seen.errors)
