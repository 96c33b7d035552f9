"""Whole training runs, small: health, both stages, resuming bit for bit, many processes, refusals."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.checkpoint import TrainState, checkpoints, load_checkpoint
from fieldfuse.nerfusion.training.curve import Curve, draw_curve
from fieldfuse.nerfusion.training.distributed import Crew, join_crew
from fieldfuse.nerfusion.training.optimiser import RECOVER, NonfinitePolicy, learning_rate
from fieldfuse.nerfusion.training.rendering import ALIVE
from fieldfuse.nerfusion.training.step import local_of
from fieldfuse.nerfusion.training.train import WEIGHTS, Trainer, make_model
from fieldfuse.nerfusion.weights import load_model
from tests.nerfusion.training.tiny import SMALL, merged, tiny_settings

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No picture of the curve, which takes a second at each checkpoint, but where it is looked at."""
    monkeypatch.setattr("fieldfuse.nerfusion.training.curve.draw_curve", lambda *_: None)


def state(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.model.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_a_run_leaves_weights_curve_and_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.nerfusion.training.curve.draw_curve", draw_curve)
    trainer = Trainer(tiny_settings(record={"health_every": 2}), tmp_path, Crew())
    before = state(trainer)
    assert trainer.run() == 4
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-0000004.safetensors"]
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    curve = Curve(tmp_path)
    curve.load(100)
    assert [row["step"] for row in curve.rows] == [1, 2, 3, 4]
    assert [row["stage"] for row in curve.rows] == [1, 1, 2, 2]
    assert all({"psnr_local", "loss", "depth_likelihood", "depth_error", "opacity_high", "feature_deviation"} <= set(r) for r in curve.rows)
    assert all({"psnr_fused", "psnr_fused_1", "gate_update_saturated"} <= set(row) for row in curve.rows[2:])
    assert [row["depth_weight"] > 0 for row in curve.rows] == [True, False, False, False]
    loaded = load_model(tmp_path / WEIGHTS)
    assert same(loaded.state_dict(), state(trainer))
    # Every part learns: the fusion in stage 2 only, all others from the first step.
    moved = {name.split(".")[0] for name, value in state(trainer).items() if not torch.equal(value, before[name])}
    assert moved == {name.split(".")[0] for name in before}
    again = make_model(trainer.settings)
    read = load_checkpoint(checkpoints(tmp_path)[-1], TrainState(again, torch.optim.Adam(again.parameters())))
    assert read["loss"]["rays"] == SMALL["loss"]["rays"]


def test_what_is_shipped_is_the_average_along_the_run(tmp_path: Path) -> None:
    trainer = Trainer(tiny_settings(optimiser={"average": 0.3, "start_share": 0.25}), tmp_path, Crew())
    start = mean = state(trainer)
    for step in range(4):
        trainer.run(until=step + 1)
        decay = min(0.3, (1 + step) / (10 + step))
        mean = {name: decay * mean[name] + (1 - decay) * value for name, value in state(trainer).items()}
    shipped = load_model(tmp_path / WEIGHTS).state_dict()
    assert shipped.keys() == mean.keys() and not same(shipped, state(trainer))
    for name, value in mean.items():
        torch.testing.assert_close(shipped[name], 0.75 * value + 0.25 * start[name], rtol=1e-5, atol=1e-6)
    for name, value in itertools.product(("average", "start_share"), (-0.1, 1.0)):
        with pytest.raises(InputError, match=rf"optimiser\.{name}"):
            tiny_settings(optimiser={name: value})


def test_resuming_repeats_every_bit(tmp_path: Path) -> None:
    """Stopped once in each stage; weights, their average, moments of Adam and the curve are those of a run that never stopped."""
    settings = tiny_settings(optimiser={"average": 0.9, "start_share": 0.5})
    whole = Trainer(settings, tmp_path / "whole", Crew())
    whole.run()
    for stop in (1, 3):
        first = Trainer(settings, tmp_path / "parts", Crew(), resume=stop > 1)
        assert first.run(until=stop) == stop
    second = Trainer(settings, tmp_path / "parts", Crew(), resume=True)
    assert second.state.step == 3 and same(state(first), state(second)) and same(first.average.values, second.average.values)
    second.run()
    assert same(state(whole), state(second)) and same(whole.average.values, second.average.values)
    assert (tmp_path / "whole" / WEIGHTS).read_bytes() == (tmp_path / "parts" / WEIGHTS).read_bytes()
    for a, b in zip(whole.model.parameters(), second.model.parameters(), strict=True):
        for name in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(whole.state.adam.state[a][name], second.state.adam.state[b][name])
    once, twice = (
        [{k: v for k, v in row.items() if not k.startswith("seconds")} for row in trainer.curve.rows] for trainer in (whole, second)
    )
    assert [row["step"] for row in once] == [row["step"] for row in twice]
    assert once[-1] == twice[-1]


def test_a_kill_between_two_files_of_a_save_costs_no_row_of_the_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Trainer(tiny_settings(), tmp_path, Crew())

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("fieldfuse.nerfusion.training.train.save_model", killed)  # the checkpoint is there then
        first.run(until=1)
    second = Trainer(tiny_settings(), tmp_path, Crew(), resume=True)
    assert second.state.step == 1 and [row["step"] for row in second.curve.rows] == [1]


def test_only_the_newest_checkpoints_stay_and_a_second_run_does_not_overwrite_them(tmp_path: Path) -> None:
    Trainer(tiny_settings(record={"checkpoint_every": 1, "keep": 2}), tmp_path, Crew()).run(until=3)
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-0000002.safetensors", "checkpoint-0000003.safetensors"]
    with pytest.raises(InputError, match="--resume"):
        Trainer(tiny_settings(), tmp_path, Crew())


def test_a_broken_or_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    Trainer(tiny_settings(), tmp_path, Crew()).run(until=1)
    with pytest.raises(InputError, match=r"not a checkpoint of these networks \(\S+ is [0-9×]+ there and [0-9×]+ here\); go on with"):
        Trainer(tiny_settings(model=merged(SMALL["model"], {"channels": 12})), tmp_path, Crew(), resume=True)
    kept = load_file(checkpoints(tmp_path)[-1])
    with safe_open(checkpoints(tmp_path)[-1], "pt") as file:
        meta = file.metadata()
    lost = next(name for name in kept if name.startswith("model."))
    save_file({name: value for name, value in kept.items() if name != lost}, checkpoints(tmp_path)[-1], metadata=meta)
    with pytest.raises(InputError, match=rf"networks \({lost.removeprefix('model.')} is not in it\)"):
        Trainer(tiny_settings(), tmp_path, Crew(), resume=True)
    path = checkpoints(tmp_path)[-1]
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match="cannot read"):
        Trainer(tiny_settings(), tmp_path, Crew(), resume=True)


def test_training_starts_from_given_weights(tmp_path: Path) -> None:
    first = Trainer(tiny_settings(), tmp_path / "first", Crew())
    first.run(until=2)
    second = Trainer(tiny_settings(start_from=str(tmp_path / "first" / WEIGHTS)), tmp_path / "second", Crew())
    assert second.state.step == 0 and same(state(first), state(second))
    with pytest.raises(InputError, match="model: channels is 12, and 8 in the weights"):
        make_model(tiny_settings(start_from=str(tmp_path / "first" / WEIGHTS), model={"channels": 12}))
    with pytest.raises(InputError, match="pretrained and start_from"):
        make_model(tiny_settings(start_from=str(tmp_path / "first" / WEIGHTS), pretrained=True))


def test_the_learning_rate_warms_up_and_falls() -> None:
    settings = tiny_settings(stage={"steps": 50, "fused_steps": 50}, optimiser={"warmup": 10, "rate": 3e-3, "final": 0.1})
    rates = [learning_rate(settings, step) for step in range(100)]
    assert rates[0] == pytest.approx(3e-4) and max(rates) == pytest.approx(3e-3) and int(np.argmax(rates)) in (9, 10)
    assert all(a >= b for a, b in pairwise(rates[10:])) and rates[-1] == pytest.approx(3e-4, rel=0.1)


def test_reduced_precision_stays_close(tmp_path: Path) -> None:
    full = Trainer(tiny_settings(), tmp_path / "full", Crew()).one_step()
    reduced = Trainer(tiny_settings(optimiser={"reduced": True}), tmp_path / "reduced", Crew()).one_step()
    assert np.isfinite(reduced["gradient_norm"]) and reduced["gradient_norm"] > 0
    assert reduced["loss"] == pytest.approx(full["loss"], rel=0.1)


def test_gates_of_what_is_validated_between_steps_count_in_no_row(tmp_path: Path) -> None:
    trainer = Trainer(tiny_settings(stage={"steps": 0}), tmp_path, Crew())
    assert "gate_update_saturated" in trainer.one_step()
    sample = trainer.mixture.sample(0, 1)
    local = local_of(trainer.model, sample, 0)
    with torch.no_grad():
        trainer.model.fuse(trainer.model.start(local.lattice), local)
    assert trainer.gates.shares() == {}


def poison(trainer: Trainer, monkeypatch: pytest.MonkeyPatch, steps: Iterable[int], loss: bool = False) -> None:
    """At these steps a gradient, or the loss alone, is not finite."""
    wrong = set(steps)
    for name in ("stage_one", "stage_two"):
        whole = getattr(trainer.stepper, name)

        def poisoned(sample, step, generator, whole=whole):  # type: ignore[no-untyped-def]
            outcome = whole(sample, step, generator)
            if step in wrong and loss:
                outcome.loss = float("nan")
            elif step in wrong:
                next(trainer.model.parameters()).grad[:] = float("nan")  # type: ignore[index]
            return outcome

        monkeypatch.setattr(trainer.stepper, name, poisoned)


@pytest.mark.parametrize("loss", [False, True])
def test_a_bad_step_moves_nothing_and_the_next_ones_are_smaller(loss: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(tiny_settings(), tmp_path, Crew())
    before = state(trainer)
    poison(trainer, monkeypatch, {0}, loss)
    row = trainer.one_step()
    assert same(before, state(trainer)) and not trainer.state.adam.state and row["skipped"] == 1
    name = next(name for name, _ in trainer.model.named_parameters())
    assert trainer.state.policy.last == ("step 1: the loss" if loss else f"step 1: the gradient of {name}")
    trainer.state.step = 1
    row = trainer.one_step()
    assert row["rate"] == learning_rate(trainer.settings, 1) / 2 and row["skipped"] == 0 and not same(before, state(trainer))
    for _ in range(RECOVER - 1):
        trainer.state.policy.well()
    assert trainer.state.policy == NonfinitePolicy(met=1, last=trainer.state.policy.last)


def test_training_gives_up_with_the_weights_of_the_last_good_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(tiny_settings(), tmp_path, Crew())
    poison(trainer, monkeypatch, range(4))
    monkeypatch.setattr("fieldfuse.nerfusion.training.optimiser.MOST", 2)
    with pytest.raises(InputError, match=r"the last at step 2 in the gradient of .*; the weights of the last good step"):
        trainer.run()
    assert trainer.state.policy.slower == 0.25
    loaded = load_model(tmp_path / WEIGHTS)
    assert same(loaded.state_dict(), state(trainer)) and all(bool(torch.isfinite(v).all()) for v in loaded.state_dict().values())


def test_resuming_after_a_bad_step_repeats_every_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Trainer(tiny_settings(), tmp_path / "whole", Crew())
    poison(whole, monkeypatch, {0})
    whole.run(2)
    first = Trainer(tiny_settings(), tmp_path / "parts", Crew())
    poison(first, monkeypatch, {0})
    first.run(1)
    second = Trainer(tiny_settings(), tmp_path / "parts", Crew(), resume=True)
    assert second.state.policy == first.state.policy and second.state.policy.slower == 0.5
    second.run(2)
    assert same(state(whole), state(second))


@pytest.mark.parametrize("change", [{"slower": 0.0}, {"slower": float("nan")}, {"slower": 2.0}, {"met": "1"}, {"more": 1}])
def test_a_checkpoint_with_a_damaged_record_of_bad_steps_is_refused(change: dict[str, object], tmp_path: Path) -> None:
    trainer = Trainer(tiny_settings(), tmp_path, Crew())
    trainer.save()
    (path,) = checkpoints(tmp_path)
    with safe_open(path, "pt") as file:
        tensors, meta = {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118
    save_file(tensors, path, {**meta, "caution": json.dumps({**asdict(NonfinitePolicy()), **change})})
    with pytest.raises(InputError, match="is not a training checkpoint"):
        Trainer(tiny_settings(), tmp_path, Crew(), resume=True)
    del meta["caution"]
    save_file(tensors, path, meta)
    assert Trainer(tiny_settings(), tmp_path, Crew(), resume=True).state.policy == NonfinitePolicy()


WORKER = """
import json, sys, torch
from pathlib import Path
sys.path.insert(0, {root!r})
from tests.nerfusion.training.tiny import tiny_settings
from fieldfuse.nerfusion.training import curve, mixture, procedural
from fieldfuse.nerfusion.training.distributed import join_crew
from fieldfuse.nerfusion.training.train import Trainer
torch.set_num_threads(1)
procedural.TEXELS, mixture.BANKS = 128, 1
curve.draw_curve = lambda *_: None
with join_crew("cpu") as crew:
    trainer = Trainer(tiny_settings(stage={{"steps": 1, "fused_steps": 2}}), Path({out!r}), crew)
    first = trainer.mixture.sample(0, 1).pictures.images.double().sum().item()
    trainer.run(until=2)
    total = sum(p.double().abs().sum().item() for p in trainer.model.parameters())
    Path({out!r}, f"rank{{crew.rank}}.json").write_text(json.dumps([crew.size, first, total]))
"""


def test_two_processes_stay_equal_and_see_different_samples(tmp_path: Path) -> None:
    import json

    script = tmp_path / "worker.py"
    script.write_text(WORKER.format(root=str(ROOT), out=str(tmp_path)), encoding="utf-8")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(script)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=500)
    assert done.returncode == 0, done.stderr[-2000:]
    (size, first_a, total_a), (_, first_b, total_b) = (json.loads((tmp_path / f"rank{r}.json").read_text()) for r in (0, 1))
    assert size == 2 and first_a != first_b and total_a == total_b
    assert len(checkpoints(tmp_path)) == 1  # the leader alone writes


@pytest.mark.parametrize(("processes", "backend"), [(8, "gloo"), (2, "nccl")])
def test_processes_that_share_a_device_meet_on_the_processor(processes: int, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    for name, value in (("is_available", lambda: True), ("device_count", lambda: 2), ("set_device", lambda _device: None)):
        monkeypatch.setattr(torch.cuda, name, value)
    monkeypatch.setattr(torch.distributed, "init_process_group", begun.append)
    monkeypatch.setattr(torch.distributed, "get_backend", lambda: begun[-1])
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: None)
    for name, number in (("WORLD_SIZE", processes), ("LOCAL_WORLD_SIZE", processes), ("RANK", 1), ("LOCAL_RANK", 1)):
        monkeypatch.setenv(name, str(number))
    with join_crew("cuda") as crew:
        assert begun == [backend] and crew.device == torch.device("cuda", 1)
        assert crew.exchange_device == (torch.device("cpu") if backend == "gloo" else crew.device)


@pytest.mark.parametrize("device", ["tpu", "cuda"])
def test_a_device_that_is_not_there_is_refused(device: str) -> None:
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(InputError), join_crew(device):
        pass


def test_training_briefly_keeps_features_alive_and_finds_depth(tmp_path: Path) -> None:
    """On two scenes whose images come again and again, so that a short run can be compared with its own beginning: features tell places
    apart all the time, and weight moves along the rays to where the surfaces are."""
    steps = 200
    settings = tiny_settings(
        seed=5,
        window=2,
        reuse=10**6,
        model={"image_channels": 32, "sampled": 16, "hidden": 16, "channels": 16, "features": 16, "direction": 8},
        pictures={"long_side": [80, 80], "frames": 5, "targets": 2, "key_frames": 1},
        volume={"voxels_to_median": [12.0, 12.0], "most": 32, "closed": 1.0},
        loss={"rays": 512, "depth": 0.1, "depth_steps": 10 * steps},
        stage={"steps": steps, "fused_steps": 1},
        optimiser={"warmup": 10, "final": 1.0},
        record={"log_every": 4, "health_every": 5000, "checkpoint_every": 10**6},
        sources=[{"kind": "procedural", "scene": "object"}],
    )
    trainer = Trainer(settings, tmp_path, Crew())
    trainer.run(until=steps)
    rows = trainer.curve.rows
    first, last = rows[: len(rows) // 5], rows[-(len(rows) // 5) :]

    def mean(name: str, some: list[dict[str, float]]) -> float:
        return float(np.mean([row[name] for row in some]))

    assert min(row["feature_deviation"] for row in rows) > ALIVE
    assert mean("depth_likelihood", last) > mean("depth_likelihood", first) + 0.3
    assert mean("depth_error", last) < 0.8 * mean("depth_error", first)
    assert mean("psnr_local", last) > mean("psnr_local", first) + 0.5
    assert all(np.isfinite(row["gradient_norm"]) and row["gradient_norm"] > 0 for row in rows)
