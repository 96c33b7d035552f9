"""Plots: SVG that parses, follows the page's colours, escapes names, and refers to nothing outside."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest

from fieldfuse.evaluation.plots import CSS, psnr_over_time, stage_bars

TIMELINE = [{"seconds": 1.0, "psnr": 15.0}, {"seconds": 10.0, "psnr": 24.0}, {"seconds": 5.0, "psnr": 21.0}]
STAGES = [
    {"name": "poses", "seconds": 20.0, "peak_memory_mb": 900.0, "cached": True},
    {"name": "field", "seconds": 60.0, "peak_memory_mb": None, "cached": False},
]


def texts(svg: str) -> list[str]:
    return [(element.text or "").strip() for element in ElementTree.fromstring(svg).iter() if element.tag.endswith("text")]


def check_svg(svg: str) -> None:
    root = ElementTree.fromstring(svg)
    assert root.tag.endswith("svg") and root.get("viewBox")
    outside = re.sub(r'xmlns="http://www\.w3\.org/2000/svg"', "", svg)
    assert "http" not in outside and "<script" not in outside and "<!DOCTYPE" not in outside
    assert not re.search(r"#0[1-6]0[1-6]0[1-6]", svg)  # every drawn colour became a variable
    ids = [element.get("id") for element in root.iter() if element.get("id")]
    assert len(ids) == len(set(ids))
    for reference in re.findall(r'(?:href="#|url\(#)([^")]+)', svg):
        assert reference in ids


def test_psnr_over_time() -> None:
    svg = psnr_over_time(TIMELINE, {"TSDF": 18.25, "nearest photo": None})
    assert svg is not None
    check_svg(svg)
    assert "24.00 dB" in texts(svg)  # the last in time, not in the list
    assert any(text.startswith("TSDF 18.") for text in texts(svg)) and not any("nearest" in text for text in texts(svg))
    assert CSS["#040404"] in svg


@pytest.mark.parametrize("timeline", [[], TIMELINE[:1], [*TIMELINE[:1], {"seconds": 3.0, "psnr": None}, {"seconds": None, "psnr": 2.0}]])
def test_too_few_points(timeline: list[dict[str, float | None]]) -> None:
    assert psnr_over_time(timeline) is None


def test_stage_bars() -> None:
    svg = stage_bars(STAGES)
    assert svg is not None
    check_svg(svg)
    assert {"poses", "field", "20 s, 900 MB, reused", "1 min"} <= set(texts(svg))
    assert stage_bars([]) is None and stage_bars([{"name": "x", "seconds": None}]) is None


@pytest.mark.parametrize("name", ["<script>a</script>", "a & b", "$x^2$", "$\\frac$", "50%", '"quoted"', "名前", ""])
def test_stage_names_are_shown_as_they_are(name: str) -> None:
    svg = stage_bars([{"name": name, "seconds": 0.0}])
    assert svg is not None
    check_svg(svg)
    assert name == "" or name in texts(svg)


def test_long_stage_names_leave_room_for_bars() -> None:
    svg = stage_bars([{"name": "a" * 300, "seconds": 1.0}])
    assert svg is not None and "a" * 23 + "…" in texts(svg)


def test_same_input_same_plot() -> None:
    assert stage_bars(STAGES) == stage_bars(STAGES)
    assert psnr_over_time(TIMELINE) == psnr_over_time(TIMELINE)
