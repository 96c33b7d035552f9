"""Parts of the networks that are switched off for a table, and come back as they were."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from benchmarks.ablations import without
from fieldfuse.nerfusion.gru import RunningMean
from fieldfuse.nerfusion.model import NerfusionModel


def test_the_direction_code_is_off_for_a_recording_as_well() -> None:
    """A recording, as encoding is repeated from on CUDA, reads parameters where they were and calls no module."""
    torch.manual_seed(0)
    model = NerfusionModel()
    assert model.direction is not None
    directions = F.normalize(torch.randn(5, 3), dim=1)
    layers = [(layer.weight, layer.bias) for layer in model.direction if isinstance(layer, torch.nn.Linear)]

    @torch.no_grad()
    def recorded() -> torch.Tensor:
        values = directions
        for number, (weight, bias) in enumerate(layers):
            values = F.linear(torch.relu(values) if number else values, weight, bias)
        return values

    before = recorded()
    assert before.any() and torch.allclose(before, model.direction(directions), atol=1e-6)
    with without(model, "no direction code"):
        assert not recorded().any() and not model.direction(directions).any()
    assert torch.equal(recorded(), before)


@pytest.mark.parametrize("part", ["no variance", "mean instead of GRU", "no direction code", "whole"])
def test_what_is_switched_off_comes_back_after_an_error(part: str) -> None:
    model = NerfusionModel()
    config, fusion = model.config, model.fusion
    numbers = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(KeyboardInterrupt), without(model, part):
        assert (model.config.variance, isinstance(model.fusion, RunningMean)) == (part != "no variance", part == "mean instead of GRU")
        raise KeyboardInterrupt
    assert model.config is config and model.fusion is fusion
    assert all(torch.equal(value, numbers[name]) for name, value in model.state_dict().items())
