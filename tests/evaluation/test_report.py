"""The report: stable JSON keys, a page that needs nothing but itself, everything from users escaped."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse import __version__
from fieldfuse.errors import InputError, OutputError
from fieldfuse.evaluation.pictures import Pictures, method_pictures
from fieldfuse.evaluation.report import CAPTURE, FIELD, POINT, POSES, SCORE, SFM_NOTE, STAGE, plain, report_data
from fieldfuse.evaluation.report_page import render_page, write_report
from fieldfuse.evaluation.score import nearest_image_scores, score_views
from fieldfuse.evaluation.terminal import report_text
from tests.evaluation.browser import embedded_pictures
from tests.evaluation.samples import draw, make_views

NASTY = '<script>alert("x")</script><img src=x onerror=alert(1)>&"\'{{ 7 * 7 }}{% raw %}'
VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Collects tags, attributes and text; refuses tags that do not close in order."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.stack: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.stack == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.stack or self.stack[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def sample(tsdf: bool = True) -> tuple[dict[str, Any], Pictures]:
    return deepcopy(make_sample(tsdf))


@lru_cache
def make_sample(tsdf: bool) -> tuple[dict[str, Any], Pictures]:
    """Data and pictures of a made-up run, as a pipeline would give them."""
    views = make_views(count=13)
    indices = np.flatnonzero(views.test)
    field = [draw(views, i) for i in indices]
    surface = [draw(views, i, masked=True) for i in indices] if tsdf else None
    data: dict[str, Any] = {
        "command": "fieldfuse run fox --out runs/fox",
        "source": "fox",
        "seconds_total": 372.0,
        "warnings": ["17 files are missing."],
        "capture": {"kind": "transforms", "frames": 13, "width": 540, "height": 960},
        "poses": {"source": "given", "registered": 12, "total": 13, "models": [12], "missing": ["lost.jpg"]},
        "scene": {"metric": True},
        "field": {"voxel_size": 0.01, "blocks": 100, "voxels": 12345, "bytes": 4_000_000},
        "evaluation": {"field": score_views(field, views, indices, 0.4)},
        "baseline": nearest_image_scores(views, indices),
        "timeline": [{"seconds": s, "psnr": 20.0 + s} for s in (1.0, 2.0, 3.0)],
        "stages": [{"name": "field", "seconds": np.float32(3.5), "peak_memory_mb": np.int64(812), "cached": np.bool_(False)}],
        "exports": [{"path": "exports/a b.ply", "points": 12}, {"path": "exports/field.html"}],
        "settings": {"seed": 0, "fit": {"budget": None}},
    }
    if surface:
        data["evaluation"]["tsdf"] = score_views(surface, views, indices, 0.1)
    shown = {"field": field, **({"tsdf": surface} if surface else {})}
    return data, method_pictures(views, indices, shown, unit="m")


def check_page(text: str) -> Page:
    """Self-contained: no script, no handler, nothing fetched."""
    page = Page(text)
    allowed = re.sub(r'xmlns="http://www\.w3\.org/2000/svg"', "", text)
    for tag, attributes in page.tags:
        assert tag not in {"script", "link", "iframe", "object", "embed", "base", "form"}
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("src", "href", "srcset", "data", "poster", "action", "background"):
            address = attributes.get(name)
            if address is not None:
                assert address.startswith(("data:image/", "./", "#")), address
    styles = " ".join(re.findall(r"<style>(.*?)</style>", allowed, flags=re.DOTALL))
    assert "@import" not in styles and "url(" not in styles and "http" not in styles
    return page


def test_the_form_of_the_json_is_fixed(tmp_path: Path) -> None:
    data, pictures = sample()
    json_path, html_path = write_report(tmp_path, data, pictures)
    assert json_path == tmp_path / "report.json" and html_path == tmp_path / "report.html"
    found = json.loads(json_path.read_text(encoding="utf-8"), parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert set(CAPTURE) <= set(found["capture"]) and set(POSES) <= set(found["poses"]) and set(FIELD) <= set(found["field"])
    assert all(set(STAGE) <= set(stage) for stage in found["stages"]) and all(set(POINT) <= set(point) for point in found["timeline"])
    assert all(set(SCORE) <= set(found["evaluation"][name]) and found["evaluation"][name]["views"] == 5 for name in ("field", "tsdf"))
    assert found["evaluation"]["nearest_image"]["psnr"] > 0 and "baseline" not in found
    assert found["seconds_total"] == 372 and found["version"] == __version__ and found["command"].startswith("fieldfuse run")
    assert found["stages"][0] == {"name": "field", "seconds": 3.5, "peak_memory_mb": 812, "cached": False}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "report.json"]
    once = report_data(data)
    assert report_data(once) == once
    assert plain({1: (Path("a"), {"b"}, np.arange(2), True)}) == {"1": ["a", ["b"], [0, 1], True]}


def test_what_is_not_known_is_null(tmp_path: Path) -> None:
    json_path, html_path = write_report(tmp_path, {})
    found = json.loads(json_path.read_text())
    assert found["capture"] == dict.fromkeys(CAPTURE) and found["field"] == dict.fromkeys(FIELD) and found["poses"] == dict.fromkeys(POSES)
    assert found["evaluation"] == {"field": None, "tsdf": None, "nearest_image": None}
    assert found["timeline"] == found["stages"] == found["warnings"] == []
    check_page(html_path.read_text(encoding="utf-8"))
    data = {"seconds_total": float("nan"), "field": {"voxel_size": np.float32("inf")}, "extra": {"array": np.array([1.0, np.nan])}}
    found = json.loads(write_report(tmp_path, data)[0].read_text())
    assert found["seconds_total"] is None and found["field"]["voxel_size"] is None and found["extra"]["array"] == [1.0, None]


@pytest.mark.parametrize("broken", [{"capture": [1]}, {"stages": {"a": 1}}, {"stages": ["a"]}, {"evaluation": {"field": 3}}])
def test_wrong_form_is_refused(tmp_path: Path, broken: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="report's part"):
        write_report(tmp_path, broken)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write"):
        write_report(tmp_path / "file", {})


def test_page_shows_what_counts(tmp_path: Path) -> None:
    data, pictures = sample()
    (tmp_path / "exports").mkdir()
    (tmp_path / "exports" / "a b.ply").write_bytes(b"x" * 2048)
    json_path, html_path = write_report(tmp_path, data, pictures)
    page = check_page(html_path.read_text(encoding="utf-8"))
    field, tsdf = data["evaluation"]["field"], data["evaluation"]["tsdf"]
    numbers = [
        f"{field['psnr']:.2f}",
        f"{tsdf['psnr']:.2f}",
        f"{tsdf['psnr_masked']:.2f}",
        "6 min 12 s",
        "12 of 13",
        "12,345",
        "2.0 kB",
        "12 points",
    ]
    texts = ["fox", "1 warning", "17 files are missing.", "lost.jpg", "Measured depth", "2 more views", "Nearest training photo"]
    for wanted in [*numbers, *texts, "fieldfuse run fox", "fit.budget automatic"]:
        assert wanted in page.text, wanted
    assert ("a", {"href": "./exports/a%20b.ply"}) in page.tags
    assert page.tags.count(("a", {"href": "./exports/field.html"})) == 2  # at the top, and among the files
    assert json.loads(json_path.read_text())["exports"][0] == {"path": "exports/a b.ply", "bytes": 2048, "points": 12}
    assert sum(tag == "svg" for tag, _ in page.tags) == 2


def test_exports_may_be_paths_alone(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"12345")
    assert report_data({"exports": [tmp_path / "a.ply", "b.ply"]}, tmp_path)["exports"] == [
        {"path": "a.ply", "bytes": 5},
        {"path": "b.ply", "bytes": None},
    ]


@pytest.mark.parametrize(("source", "title"), [("/data/my fox/", "my fox"), ("room.mp4", "room.mp4"), ("/", "Report"), (None, "Report")])
def test_title_is_the_captures_name(source: str | None, title: str) -> None:
    page = check_page(render_page(report_data({"source": source, "created": "2026-03-02T14:05:33+00:00"}), Pictures()))
    assert f" Fieldfuse {title} " in page.text and "2026-03-02 14:05 UTC" in page.text
    assert source is None or source in page.text


def test_field_alone_and_surface_alone() -> None:
    data, pictures = sample(tsdf=False)
    page = check_page(render_page(report_data(data), pictures))
    assert "TSDF" not in page.text and "Measured depth" not in page.text
    both, _ = sample()
    both["evaluation"]["field"] = None
    views = make_views()
    page = check_page(render_page(report_data(both), method_pictures(views, [0], {"tsdf": [draw(views, 0, True)]})))
    assert "TSDF" in page.text and "Photo" in page.text


def test_a_column_of_depth_is_shown_where_there_is_depth() -> None:
    """Every row of the table then has as many cells as its head."""
    for depth in (True, False):
        data, pictures = sample()
        if not depth:
            for score in (data["evaluation"]["field"], data["evaluation"]["tsdf"]):
                score["depth_abs_err"] = None
        page = render_page(report_data(data), pictures)
        assert ("Depth error" in page) is depth and ("depth error" in report_text(data)) is depth
        body = page[page.index("<h2>Quality on test views") :]
        rows = re.findall(r"<tr.*?</tr>", body[: body.index("</table>")], re.DOTALL)
        assert len(rows) > 3 and {len(re.findall(r"<t[hd][ >]", row)) for row in rows} == {6 if depth else 5}


def test_computed_poses_are_told() -> None:
    data, pictures = sample()
    assert SFM_NOTE not in report_data(data)["notes"]
    data["poses"]["source"] = "sfm"
    whole = report_data(data)
    assert whole["notes"] == [SFM_NOTE]
    assert SFM_NOTE in check_page(render_page(whole, pictures)).text


def poisoned(value: Any) -> Any:
    """Every text of the data replaced by a hostile one, and hostile keys added."""
    if isinstance(value, str):
        return NASTY
    if isinstance(value, dict):
        return {**{key: poisoned(entry) for key, entry in value.items()}, NASTY: NASTY}
    if isinstance(value, list):
        return [poisoned(entry) for entry in value]
    return value


def test_everything_is_escaped(tmp_path: Path) -> None:
    data, pictures = sample()
    hostile = Pictures([type(view)(NASTY, view.truth, view.methods, view.measured) for view in pictures.views], pictures.depth_range, NASTY)
    text = write_report(tmp_path, poisoned(plain(data)), hostile)[1].read_text(encoding="utf-8")
    page = check_page(text)
    assert "<script" not in text and "<img src=x" not in text
    assert 'alert("x")' in page.text and "{{ 7 * 7 }}" in page.text


@pytest.mark.parametrize(
    "path", ["../outside.ply", "/etc/passwd", "a/../../b", "javascript:alert(1)", "https://example.org/x", "//example.org/x", ""]
)
def test_links_stay_inside(tmp_path: Path, path: str) -> None:
    text = write_report(tmp_path / "run", {"exports": [{"path": path}]})[1].read_text(encoding="utf-8")
    for tag, attributes in check_page(text).tags:
        if tag == "a":
            assert re.match(r"\./(?!/)", attributes["href"] or "") and ":" not in (attributes["href"] or "")


LEAVES = st.none() | st.booleans() | st.floats() | st.text(max_size=8)
NESTED = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3), max_leaves=8
)


@given(NESTED)
@settings(max_examples=25, deadline=None)
def test_any_settings_make_a_page(value: Any) -> None:
    check_page(render_page(report_data({"settings": {"group": value}, "other": value}), Pictures()))


def test_embedded_pictures_are_whole_and_small(tmp_path: Path) -> None:
    data, pictures = sample()
    shown = embedded_pictures(render_page(report_data(data), pictures))
    assert len(shown) == 5 * 2 * 4 + 2  # five views, two methods, four tiles, two colour bars
    assert all(picture is not None for picture in shown)
    views = make_views(count=8, height=720, width=1280, every=2)
    indices = np.flatnonzero(views.test)
    page = write_report(tmp_path, {}, method_pictures(views, indices, {"field": [draw(views, i) for i in indices]}))[1]
    assert page.stat().st_size < 2_500_000
    sizes = {picture.shape[:2] for picture in embedded_pictures(page.read_text(encoding="utf-8")) if picture is not None}
    assert sizes == {(270, 480), (1, 128)}  # and the colour bars


def test_table_for_the_terminal() -> None:
    data, _ = sample()
    text = report_text(data)
    rows = {line.split("  ")[1].strip() if line.startswith("  ") else line: line for line in text.splitlines() if line}
    assert f"{data['evaluation']['field']['psnr']:.2f}" in rows["Field"] and "0.4 s" in rows["Field"]
    assert f"{data['evaluation']['tsdf']['ssim']:.3f}" in rows["TSDF"]
    assert "Nearest training photo" in text and "50.0% of the pixels" in text
    assert "13 frames, 12 of 13 with a pose" in text and "6 min 12 s in all" in text
    assert max(map(len, text.splitlines())) <= 100
    assert report_text(report_data(data)) == text


def test_no_number_is_cut_off_in_the_terminal() -> None:
    data, _ = sample()
    data["scene"]["metric"] = False
    data["evaluation"]["network"] = {**data["evaluation"]["field"], "key_frames": 12, "seconds": 191.0}
    for width in (60, 80, 100):
        text = report_text(data, width)
        assert "…" not in text and max(map(len, text.splitlines())) <= width
        assert text.count(f"{data['evaluation']['field']['psnr']:.2f}") >= 2 and "12 key" in text


def test_table_without_scores_is_the_facts() -> None:
    assert report_text({}) == ""
    data = {"capture": {"frames": 50}, "poses": {"registered": 48, "total": 50}, "exports": "run/exports/cameras"}
    assert report_text(data) == "50 frames, 48 of 50 with a pose\n"
