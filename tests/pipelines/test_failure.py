"""A run that failed says so first: on the terminal, in report.json and on the page."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from fieldfuse.files import read_json
from tests.pipelines.made import call, make_room, write_transforms
from tests.pipelines.short import FAST, report


def test_scores_of_images_that_are_there_twice_are_not_believed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = make_room(tmp_path / "room", 9)
    frames = []
    for frame in data["frames"]:  # the camera stood still for two images, which differ by less than noise
        again = frame["file_path"].replace(".png", "b.png")
        stored = cv2.imread(str(tmp_path / "room" / frame["file_path"]))
        cv2.imwrite(str(tmp_path / "room" / again), cv2.add(stored, (1.0, 1.0, 1.0, 0.0)))
        frames += [frame, {**frame, "file_path": again}]
    write_transforms(tmp_path / "room", {**data, "frames": frames})
    answer = call(capsys, "run", tmp_path / "room", "--out", tmp_path / "out", *FAST)
    assert answer.code == 0, answer.err
    first = report(tmp_path / "out")["warnings"][0]
    assert "held-out images equal a training image (" in first and "000b" in first
    assert f"note: {first}" in answer.out
    assert "held-out images equal a training image" in (tmp_path / "out" / "report.html").read_text()


def test_a_good_run_is_measured_and_says_nothing(done: Path) -> None:
    field = report(done)["evaluation"]["field"]
    assert field["training_psnr"] > field["psnr"] - 3 and all(0.5 < view["seen"] <= 1 for view in field["per_view"])
    assert not [text for text in report(done)["warnings"] if "failed" in text or "is poor" in text or "held-out" in text]
    assert read_json(done / "evaluation.json")["field"]["training_psnr"] == field["training_psnr"]
