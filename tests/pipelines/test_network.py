"""Runs that start from the networks or end with them, runs on few pictures, and the tables that compare such runs."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from fieldfuse.config import load_settings
from fieldfuse.files import read_json
from fieldfuse.pipelines.fields import uses_network
from tests.pipelines.made import CAMERA, call, make_room
from tests.pipelines.short import stages, start, wait_for

Capsys = pytest.CaptureFixture[str]
FAST = ["--init", "network", "--budget", 1, "--threads", 1, "--set", "field.resolution=64", "--set", "export.formats=[cameras]"]
FAST += ["--set", "network.voxels=12", "--set", "tsdf.enabled=off", "--set", "keyframes.most=5"]


def run(capsys: Capsys, room: Path, out: Path, *more: object) -> dict[str, Any]:
    answer = call(capsys, "run", room, "--out", out, *FAST, *more, "--json")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert isinstance(data, dict)
    return data | {"said": answer.err}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("network") / "room"
    make_room(folder, 12, True, CAMERA.scaled(48, 36))
    return folder


def test_few_pictures_start_from_the_networks_and_the_report_says_what_they_gave(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "out"
    data = run(capsys, room, out)
    assert {"keyframes", "network", "direct", "field", "render"} <= set(stages(data))
    network, field = data["evaluation"]["network"], data["evaluation"]["field"]
    assert network["views"] == field["views"] == 2 and network["key_frames"] >= 3
    assert 0 < network["encode_seconds"] < network["fusion_seconds"] < network["seconds"] and network["first_preview_seconds"] > 0
    assert field["psnr"] > network["psnr"] > data["evaluation"]["nearest_image"]["psnr"]
    picture = cv2.imread(str(out / "preview.png"))
    assert picture.shape == (36, 3 * 48, 3) and np.ptp(picture[:, 48:96]) > 20
    assert "preview.png shows what 3 key frames" in data["said"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Networks alone" in page and "nothing fitted" in page
    # The same again reuses all; other settings of the fit leave the networks' field as it is; other key frames do not.
    assert all(stages(run(capsys, room, out)).values())
    cached = stages(run(capsys, room, out, "--budget", 0.5))
    assert cached["network"] and cached["direct"] and not cached["field"]
    cached = stages(run(capsys, room, out, "--budget", 0.5, "--set", "keyframes.method=uniform", "--set", "keyframes.every=2"))
    assert cached["views"] and not (cached["keyframes"] or cached["network"] or cached["direct"] or cached["field"])
    chosen = read_json(out / "keyframes.json")
    assert chosen["keyframes"] == ["001", "003", "005", "007", "010"]


def test_without_fine_tuning_the_networks_field_is_the_result_until_it_is_fitted(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "out"
    data = run(capsys, room, out, "--no-finetune")
    assert data["timeline"] == [] and "network" not in data["evaluation"]
    assert any("nothing was fitted" in text for text in data["warnings"])
    direct = data["evaluation"]["field"]["psnr"]
    assert direct > data["evaluation"]["nearest_image"]["psnr"]
    answer = call(capsys, "finetune", out, "--budget", 6, "--json", "--quiet")
    assert answer.code == 0, answer.err
    data = json.loads(answer.out)
    assert stages(data)["network"] and not stages(data)["field"]
    assert data["evaluation"]["field"]["psnr"] > direct and data["evaluation"]["network"]["psnr"] == pytest.approx(direct, abs=0.1)
    assert data["field"]["resolution"] == 64 and not any("nothing was fitted" in text for text in data["warnings"])


def test_with_many_pictures_too_the_networks_field_is_fitted_further(
    room: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By itself a run with so many pictures would start classically; what the folder has does not stand on that."""
    monkeypatch.setattr("fieldfuse.training.start.FEW_VIEWS", 1)
    out = tmp_path / "out"
    assert stages(run(capsys, room, out, "--no-finetune", "--init", "auto"))["network"] is False
    timelines = []
    for verb in (["finetune", out, "--budget", 0.5], ["finetune", out, "--budget", 0.5], ["export", out]):
        answer = call(capsys, *verb, "--json", "--quiet")
        assert answer.code == 0, answer.err
        data = json.loads(answer.out)
        assert stages(data)["network"] and stages(data)["field"] == (verb[0] == "export")
        timelines.append([point["seconds"] for point in data["timeline"]])
    assert timelines[1][: len(timelines[0])] == timelines[0] and len(timelines[1]) > len(timelines[0]) and timelines[2] == timelines[1]
    assert "network" not in stages(run(capsys, room, tmp_path / "other", "--init", "auto"))


def test_contradictions_and_missing_networks_are_said(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "run", room, "--out", tmp_path / "a", *FAST, "--init", "classical", "--no-finetune", "--quiet")
    assert answer.code == 2 and "fine-tuning" in answer.sentence()
    answer = call(capsys, "run", room, "--out", tmp_path / "b", *FAST, "--set", "network.weights=nowhere.safetensors", "--quiet")
    assert answer.code == 2 and "nowhere.safetensors" in answer.sentence()
    for pair in ("views.limit=0", "network.levels=9", "keyframes.most=-1", "init=magic"):
        assert call(capsys, "run", room, "--out", tmp_path / "c", "--set", pair, "--quiet").code == 2, pair


def test_the_classical_start_asks_no_network_and_a_limit_leaves_the_held_out_views_alone(
    room: Path, tmp_path: Path, capsys: Capsys
) -> None:
    data = run(capsys, room, tmp_path / "out", "--set", "views.limit=3", "--init", "classical")
    assert "network" not in stages(data) and "network" not in data["evaluation"] and not (tmp_path / "out" / "preview.png").exists()
    assert data["views"]["total"] == 5 and data["views"]["test"] == 2
    assert [view["name"] for view in data["evaluation"]["field"]["per_view"]] == ["000", "008"]
    cached = stages(run(capsys, room, tmp_path / "out", "--set", "views.limit=4", "--init", "classical"))
    assert cached["poses"] and not cached["scene"] and not cached["views"]


def test_a_run_killed_among_the_key_frames_goes_on(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "out"
    arguments = [*FAST, "--set", "keyframes.method=uniform", "--set", "keyframes.every=1"]
    process = start("run", room, "--out", out, *arguments)
    wait_for(out / "preview.png", process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert cv2.imread(str(out / "preview.png")) is not None, "a preview is whole at any moment"
    cached = stages(run(capsys, room, out, *arguments[len(FAST) :]))
    assert cached["keyframes"] and not list(out.rglob(".tmp-*"))


@pytest.mark.parametrize(("count", "used"), [(23, True), (24, False)])
def test_which_start_is_automatic(count: int, used: bool) -> None:
    settings = load_settings()
    views = SimpleNamespace(test=np.zeros(count, bool))
    job: Any = SimpleNamespace(settings=settings, again=False)
    ready: Any = SimpleNamespace(views=views)
    assert uses_network(job, ready) is used
    assert not uses_network(job, ready, planned=True)
    settings.fit.finetune = False
    assert uses_network(job, ready, planned=True)


@pytest.mark.skipif(torch.cuda.is_available(), reason="Triton's engine runs here")
def test_the_engine_for_cuda_is_refused_without_it(room: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "run", room, "--out", tmp_path / "out", "--engine", "triton", "--set", "effects=off")
    assert answer.code == 2 and "runs on CUDA alone, and the device is 'cpu'; leave --engine at auto" in answer.err
