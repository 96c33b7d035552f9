"""Settings, the learning curve, and the command."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.curve import Curve, draw_curve, smoothed
from fieldfuse.nerfusion.training.settings import load_train_settings
from tests.nerfusion.training.tiny import SMALL

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "train"
RATES = {"paper.yaml": 3e-3, "cpu.yaml": 6e-4, "gpu.yaml": 4e-4}  # the paper's, the one that made the shipped weights, going on


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_shipped_settings_load(path: Path) -> None:
    settings = load_train_settings(path)
    assert settings.total_steps > 100 and settings.optimiser.rate == RATES[path.name] and settings.pictures.views == 3
    assert load_train_settings(data=asdict(settings)) == settings


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"stage": {"step": 3}}, "step"),
        ({"loss": {"rays": "many"}}, "many"),
        ({"loss": {"rays": 0}}, "greater than 0"),
        ({"volume": {"region": [0.9, 0.1]}}, "lower and an upper"),
        ({"sources": [{"kind": "dtu"}]}, "path"),
        ({"sources": [{"kind": "imagenet", "path": "x"}]}, r"sources\[0\].kind is 'imagenet'; it must be one of"),
        ({"sources": [{"weight": 0.0}]}, "weight"),
        ({"optimiser": {"rate": -1.0}}, "rate"),
        ({"record": {"validate_every": 0}}, "validate_every is 0"),
        ({"record": {"health_every": 0}}, "health_every is 0"),
        ({"pictures": {"long_side": [2, 3]}}, "at least 16"),
        ({"stage": {"steps": -5}}, "at least 0"),
    ],
)
def test_wrong_settings_are_named(data: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        load_train_settings(data=data)
    assert "\n" not in str(caught.value)


def test_settings_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        load_train_settings(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("stage: [1, {", encoding="utf-8")
    with pytest.raises(InputError, match=r"bad\.yaml"):
        load_train_settings(tmp_path / "bad.yaml")


def test_the_curve_survives_a_round_trip_and_forgets_what_lies_ahead(tmp_path: Path) -> None:
    curve = Curve(tmp_path)
    for step in range(10):
        curve.add({"step": step, "stage": 1.0 + (step > 5), "loss": 0.1 / (step + 1), "psnr_local": 15.0 + step})
    curve.add({"step": 9, "val_psnr_fused": 18.5, "broken": float("nan")})
    curve.write()
    again = Curve(tmp_path)
    again.load(until=4)
    assert [row["step"] for row in again.rows] == [0, 1, 2, 3, 4]
    again.load(until=99)
    assert again.rows[-1] == {"step": 9.0, "val_psnr_fused": 18.5}
    picture = cv2.imread(str(tmp_path / "curve.png"))
    assert picture is not None and picture.shape[1] == 800 and picture.std() > 5


def test_a_curve_of_nothing_can_be_drawn_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    draw_curve([], tmp_path / "empty.png")
    assert (tmp_path / "empty.png").is_file()
    (tmp_path / "curve.csv").write_text("a,b\n1,x\n", encoding="utf-8")
    with pytest.raises(InputError, match="not a learning curve"):
        Curve(tmp_path).load(5)


def test_a_curve_of_one_row_is_seen(tmp_path: Path) -> None:
    draw_curve([{"step": 2, "psnr_local": 15.0}], tmp_path / "curve.png")
    picture = cv2.imread(str(tmp_path / "curve.png")).astype(int)
    panel = picture[20:-30, 100:300]  # without the legend
    assert (abs(panel - (180, 119, 31)).max(-1) < 40).sum() > 4  # blue, in OpenCV's order


def test_smoothing_is_a_trailing_mean() -> None:
    assert smoothed([1, 2, 3, 4, 5], window=2) == pytest.approx([1, 1.5, 2.5, 3.5, 4.5])
    assert smoothed([]) == []


def test_the_command_trains_stops_and_goes_on(tmp_path: Path) -> None:
    from fieldfuse.pipelines.cli import app

    config, out = tmp_path / "tiny.yaml", tmp_path / "out"
    config.write_text(json.dumps(SMALL))
    run = CliRunner().invoke(app, ["train", "--config", str(config), "--out", str(out), "--steps", "1", "--threads", "1"])
    assert run.exit_code == 0 and "weights.safetensors (1 steps)" in run.output, run.output
    more = CliRunner().invoke(app, ["train", "--config", str(config), "--out", str(out), "--steps", "2", "--resume", "--quiet"])
    assert more.exit_code == 0 and (out / "checkpoint-0000002.safetensors").is_file(), more.output
    again = CliRunner().invoke(app, ["train", "--config", str(config), "--out", str(out), "--steps", "2"])
    assert isinstance(again.exception, InputError) and "--resume" in str(again.exception)
    # Other settings than those of the steps before are said; one that is not known is refused.
    other = ["train", "--config", str(config), "--out", str(out), "--steps", "3", "--resume", "--set", "optimiser.rate=0.002"]
    told = CliRunner().invoke(app, other)
    assert told.exit_code == 0 and "optimiser.rate 0.003 → 0.002" in told.output and "record" not in told.output, told.output
    wrong = CliRunner().invoke(app, [*other, "--set", "optimiser.speed=3"])
    assert isinstance(wrong.exception, InputError) and "speed" in str(wrong.exception)


def test_a_training_that_is_stopped_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fieldfuse.errors import Interrupted
    from fieldfuse.pipelines.cli import app
    from fieldfuse.pipelines.console import ConsoleProgress

    config = tmp_path / "tiny.yaml"
    config.write_text(json.dumps(SMALL))
    monkeypatch.setattr(ConsoleProgress, "stopping", lambda self: True)
    stopped = CliRunner().invoke(app, ["train", "--config", str(config), "--out", str(tmp_path / "out"), "--quiet"])
    assert isinstance(stopped.exception, Interrupted) and "after 1 steps; go on with --resume" in str(stopped.exception)
    assert (tmp_path / "out" / "weights.safetensors").is_file()
