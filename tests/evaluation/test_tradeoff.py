"""Points, the Pareto front, steps in sentences, plots and the page of a trade-off."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.errors import InputError
from fieldfuse.evaluation.tradeoff import (
    NUMBERS,
    Point,
    checked_row,
    front_sentence,
    length,
    pareto,
    points_of,
    sentence,
    series,
    steps,
    times_text,
    tradeoff_data,
)
from fieldfuse.evaluation.tradeoff_page import csv_text, quality_plot, write_tradeoff
from fieldfuse.files import read_json
from tests.evaluation.browser import embedded_pictures, open_page


def row(method: str, axes: list[str], psnr: float, seconds: float, memory: float, seed: int = 0, **setting: Any) -> dict[str, Any]:
    wanted = {"iterations": 30.0, "voxel_size": 1.0, **setting.pop("wanted", {})}
    name = f"{method}-{sorted(wanted.items())}-{setting.get('precision')}"
    scores = {"psnr": psnr, "ssim": psnr / 40, "lpips": 1 - psnr / 40, "depth_error": 2 / psnr}
    costs = {"seconds": seconds, "memory_mb": memory, "peak_memory_mb": memory + 500, "disk_bytes": memory * 1e4, "seconds_per_view": 0.1}
    about = {"stages": {"fit": seconds}, "load": [1.0, 2.0], "seed": seed}
    return checked_row({"id": name, "method": method, "axes": axes, "setting": {**setting, "wanted": wanted}, **about, **scores, **costs})


def ladder() -> list[dict[str, Any]]:
    """Fields at three times with two seeds, surfaces at two voxel sizes, one that failed."""
    rows = []
    for seed in (0, 1):
        for time, psnr in ((3.0, 20.0), (10.0, 23.0), (30.0, 25.0)):
            rows.append(
                row("field", ["iterations"], psnr + seed, time + 0.5, 200 + time, seed, iterations=time, wanted={"iterations": time})
            )
    rows += [
        row("tsdf", ["voxel_size"], 15 + n, 2.0 * 2.4**n, 100 * 3.9**n, voxel_size=v, wanted={"voxel_size": v})
        for n, v in enumerate((0.02, 0.01))
    ]
    failed = row("tsdf", ["voxel_size"], 1, 1, 1, voxel_size=0.001, wanted={"voxel_size": 0.001})
    return [*rows, {**failed, **dict.fromkeys(NUMBERS), "error": "too fine for the memory"}]


def test_points_are_means_over_seeds() -> None:
    points = points_of(ladder())
    assert [point.seeds for point in points] == [2, 2, 2, 1, 1]
    assert points[0].mean["psnr"] == pytest.approx(20.5) and points[0].spread["psnr"] == pytest.approx(0.5**0.5)
    assert points[-1].spread["psnr"] == 0


def test_the_front_is_what_nothing_beats() -> None:
    front = pareto(points_of(ladder()))
    assert [(round(point.mean["seconds"], 1), round(point.mean["psnr"], 1)) for point in front] == [
        (2.0, 15.0),
        (3.5, 20.5),
        (10.5, 23.5),
        (30.5, 25.5),
    ]
    text = front_sentence(points_of(ladder()))
    assert (
        text is not None and "4 settings that nothing beats, over 15× in time" in text and text.endswith("25.50 dB in 30 s (Field, 30 s).")
    )
    assert front_sentence([]) is None


@given(st.lists(st.tuples(st.floats(0.1, 1e3), st.floats(1, 50)), max_size=30))
def test_a_front_is_monotone_and_covers_every_point(values: list[tuple[float, float]]) -> None:
    points = [Point(str(i), "field", ("iterations",), {}, {"seconds": cost, "psnr": psnr}) for i, (cost, psnr) in enumerate(values)]
    front = pareto(points)
    costs, quality = ([point.mean[key] for point in front] for key in ("seconds", "psnr"))
    assert costs == sorted(costs) and quality == sorted(set(quality))
    for point in points:
        assert any(one.mean["seconds"] <= point.mean["seconds"] and one.mean["psnr"] >= point.mean["psnr"] for one in front)


def test_what_is_only_shown_otherwise_is_not_on_the_front() -> None:
    base = row("field", ["iterations", "precision"], 25, 30, 200, iterations=30.0, precision="float16")
    better = row("field", ["precision"], 26, 30, 200, precision="float32")
    assert [point.mean["psnr"] for point in pareto(points_of([base, better]))] == [25]
    (step,) = steps(points_of([base, better]))
    text = "Field, precision of the stored field: from 16 bits to 32 bits: +1.0 dB, −0.3 points of depth error"
    assert sentence(step) == text + ", 1× time a picture, 1× size on disk."


def test_a_step_is_a_sentence() -> None:
    found = {step[0]: step for step in steps(points_of(ladder()))}
    text = sentence(found["voxel_size"], "m")
    assert text.startswith("TSDF, voxel size: from 2 cm to 1 cm: +1.0 dB, ") and text.endswith("2.4× time, 3.9× memory.")
    assert "from 10 s to 30 s: +2.0 dB (±1.0)" in sentence(found["iterations"])


def test_both_decoders_are_compared_at_the_same_time() -> None:
    rows = []
    for time in (10.0, 30.0):
        for method, decoder, psnr in (("field", "deferred", 25.0), ("field_per_sample", "per_sample", 24.0)):
            about = {"iterations": time, "decoder": decoder, "wanted": {"iterations": time, "decoder": decoder}}
            rows.append(row(method, ["iterations", "decoder"], psnr + time / 10, time, 200, **about))
    found = [(axis, [point.method for point in line]) for axis, line in series(points_of(rows))]
    assert found.count(("decoder", ["field", "field_per_sample"])) == 2
    assert ("iterations", ["field", "field"]) in found and ("iterations", ["field_per_sample", "field_per_sample"]) in found
    texts = [sentence(step) for step in steps(points_of(rows)) if step[0] == "decoder"]
    assert texts[0].startswith("Field, decoder at 10 s of fitting: from deferred to per sample: −1.0 dB")


def test_numbers_in_words() -> None:
    assert [length(value, "m") for value in (1.5, 0.0125, 0.0005)] == ["1.5 m", "1.25 cm", "0.5 mm"]
    assert length(0.0125, "units") == "0.0125 units"
    assert [times_text(value) for value in (0.94, 2.44, 31.2)] == ["0.94×", "2.4×", "31×"]


def test_the_csv_has_every_row() -> None:
    read = list(csv.DictReader(io.StringIO(csv_text(ladder()))))
    assert len(read) == 9 and float(read[0]["psnr"]) == 20 and read[0]["seconds_fit"] == "3.5" and read[0]["load_after"] == "2.0"
    assert read[-1]["error"] == "too fine for the memory" and read[-1]["psnr"] == ""


def test_plots_show_what_there_is() -> None:
    points = points_of(ladder())
    picture = quality_plot(points, "seconds", "psnr")
    assert picture is not None
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape[0] > 400 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50
    assert quality_plot(points[:1], "seconds", "psnr") is None


def test_the_page_stands_alone(tmp_path: Path) -> None:
    data = {
        "source": "/somewhere/my <b>room</b>",
        "unit": "m",
        "rows": ladder(),
        "warnings": ["dark <script>alert(1)</script>"],
        "machine": {"cores": 2},
    }
    data |= {
        "stages": [{"name": "views", "seconds": 3.0}],
        "left_out": ["field-900s-seed0"],
        "refused": ["The axis keyframes was not varied: none."],
    }
    written = write_tradeoff(tmp_path, data)
    assert tradeoff_data(written) == written == read_json(tmp_path / "tradeoff.json")
    html = (tmp_path / "tradeoff.html").read_text(encoding="utf-8")
    shown = embedded_pictures(html)
    assert len(shown) == 8 and all(picture is not None for picture in shown)
    assert len(list((tmp_path / "tradeoff").glob("*.png"))) == 8
    assert "<script" not in html and "http" not in html.replace("no-referrer", "")
    for words in ("from 2 cm to 1 cm", "too fine for the memory", "field-900s-seed0", "&lt;b&gt;room", "±0.71"):
        assert words in html, words
    seen = open_page(tmp_path / "tradeoff.html", tmp_path)
    assert seen.pictures == 8 and not seen.broken and not seen.errors


def test_a_row_that_is_none_is_refused() -> None:
    for bad in ({"method": "magic", "setting": {}}, {"method": "field"}, 3):
        with pytest.raises(InputError, match="measured point"):
            checked_row(bad)
