"""Pages on a phone and on a small screen: nothing is cut off, no column falls to a letter a line."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

from fieldfuse.evaluation.compare_page import write_comparison
from fieldfuse.evaluation.report_page import write_report
from fieldfuse.evaluation.tradeoff import points_of, tradeoff_data
from fieldfuse.evaluation.tradeoff_page import render_tradeoff
from tests.evaluation.driven import Driven, driven, until
from tests.evaluation.test_compare_page import made, pictures
from tests.evaluation.test_report import sample
from tests.evaluation.test_tradeoff import ladder

PHONE, SMALL = 390, 1100  # CSS pixels
WIDE = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
EFFECT = {
    "effect": "depth_offset",
    "there": False,
    "on": False,
    "number": 0.023,
    "threshold": 0.12,
    "reason": "points that pictures share are off the sensor's depth, and a camera beside the pictures' explains little of that",
    "held_out": {"before": 0.0064, "after": 0.0062, "unit": "of depth", "decibels": 0.2},
    "seconds": 1.0,
}


def put_pages(folder: Path) -> None:
    """A report with effects and exports, a comparison of five methods, and a sweep of long names without its plots."""
    data, shown = sample()
    data["effects"] = {"effects": [EFFECT], "seconds": 1.0, "looked_at": {}}
    data["exports"] = [{"path": "exports/cameras/colmap/cameras.txt", "points": 12}, {"path": "exports/field.html"}]
    write_report(folder, data, shown)
    compared, (views, meshes) = made(), pictures()
    for name in ("tsdf_stereo", "network"):
        compared["methods"].append({**deepcopy(compared["methods"][1]), "key": name, "title": "TSDF of matched pictures"})
    write_comparison(folder, compared, views, meshes, 0.075)
    rows = [{**row, "method": row["method"].replace("tsdf", "tsdf_stereo")} for row in ladder()]
    swept = tradeoff_data({"rows": rows, "unit": "units", "source": "room"})
    (folder / "tradeoff.html").write_text(render_tradeoff(swept, points_of(rows), {}), encoding="utf-8")


def show(page: Driven, address: str, width: int) -> None:
    """Load it on a screen of that width, with everything unfolded."""
    page.ask("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width == PHONE)
    page.ask("Page.navigate", url=address)
    until(lambda: page.run(f"location.href === '{address}' && document.readyState === 'complete'"))
    page.run("document.querySelectorAll('details').forEach(part => part.open = true)")


def test_pages_fit_a_phone_and_a_small_screen(tmp_path: Path) -> None:
    put_pages(tmp_path)
    report, compared, swept = ((tmp_path / f"{name}.html").as_uri() for name in ("report", "compare", "tradeoff"))
    with driven(report, tmp_path, (PHONE, 900)) as page:
        show(page, report, PHONE)
        assert page.run(WIDE) == 0
        assert page.run("Math.max(...[...document.querySelectorAll('td.path')].map(cell => cell.clientHeight))") < 60  # two lines
        assert page.run("document.querySelector('tr.why td div').getBoundingClientRect().right") <= PHONE
        show(page, compared, PHONE)
        assert page.run(WIDE) == 0
        show(page, swept, PHONE)
        assert page.run(WIDE) == 0
        for table in (compared, swept):
            show(page, table, SMALL)
            assert page.run("[...document.querySelectorAll('.scroll')].every(part => part.scrollWidth <= part.clientWidth)")
