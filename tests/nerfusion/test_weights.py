"""The weights file: what is written is read, what is broken is refused in one sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from fieldfuse.errors import InputError, OutputError
from fieldfuse.nerfusion.model import ModelConfig, NerfusionModel
from fieldfuse.nerfusion.weights import METADATA_KEY, VERSION, config_from, load_model, save_model
from tests.nerfusion.made import SMALL, small_model


def test_there_and_back(tmp_path: Path) -> None:
    model = small_model(config=replace(SMALL, direction=0, decoder="per_sample"))
    save_model(tmp_path / "weights.safetensors", model, {"steps": 3})
    again = load_model(tmp_path / "weights.safetensors")
    assert again.config == model.config and not again.training
    for (name, one), two in zip(model.state_dict().items(), again.state_dict().values(), strict=True):
        assert torch.equal(one, two), name


def test_the_default_model_fits(tmp_path: Path) -> None:
    save_model(tmp_path / "w.safetensors", NerfusionModel())
    assert (tmp_path / "w.safetensors").stat().st_size < 10 * 2**20
    with pytest.raises(OutputError, match="10 MB"):
        save_model(tmp_path / "w.safetensors", NerfusionModel(replace(ModelConfig(), channels=512, hidden=512, gru_hidden=256)))


def described(**changes: object) -> dict[str, str]:
    config = {name: getattr(SMALL, name) for name in SMALL.__dataclass_fields__}
    data = {"version": VERSION, "config": config | changes.pop("config", {}), "meta": {}} | changes  # type: ignore[operator]
    return {METADATA_KEY: json.dumps(data)}


def test_broken_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    good = {name: value.clone() for name, value in small_model().state_dict().items()}
    first = next(iter(good))
    cases: list[tuple[dict[str, torch.Tensor], dict[str, str] | None]] = [
        (good, None),
        (good, {METADATA_KEY: "{"}),
        (good, {METADATA_KEY: "[1]"}),
        (good, {METADATA_KEY: "[" * 100_000}),
        (good, described(version=1)),
        (good, described(config={"channels": 9})),
        (good, described(config={"channels": 10**9})),
        (good, described(config={"channels": True})),
        (good, described(config={"hidden": 0})),
        (good, described(config={"fusion": "magic"})),
        (good, described(config={"surprise": 1})),
        ({name: value for name, value in good.items() if name != first}, described()),
        (good | {"extra": torch.zeros(1)}, described()),
        (good | {first: good[first] * float("nan")}, described()),
        (good | {first: good[first].half()}, described()),
        (good | {first: good[first][:1]}, described()),
    ]
    for tensors, metadata in cases:
        save_file(tensors, str(path), metadata)
        with pytest.raises(InputError) as caught:
            load_model(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    for content in (b"", b"not safetensors at all", b"\xff" * 64):
        path.write_bytes(content)
        with pytest.raises(InputError, match="weights"):
            load_model(path)
    with pytest.raises(InputError, match="cannot read"):
        load_model(tmp_path / "missing.safetensors")
    path.write_bytes(b"\0" * (21 * 2**20))
    with pytest.raises(InputError, match="larger"):
        load_model(path)


def test_a_configuration_says_what_is_wrong() -> None:
    assert config_from({"channels": 8, "direction": 0}) == replace(ModelConfig(), channels=8, direction=0)
    for data in ({"channels": -1}, {"channels": "8"}, {"decoder": "x"}, {"variance": 1}, {"unknown": 1}):
        with pytest.raises(ValueError, match=next(iter(data))):
            config_from(data)
