"""Directions as decoders see them, and weights from when they saw less of them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.nerfusion.encoding import BEHIND, DIRECTION, spherical_harmonics
from fieldfuse.render.field import Field
from fieldfuse.volume.store import read_field, write_field
from tests.render.made import random_field

DEGREES = (slice(0, 1), slice(1, 4), slice(4, 9), slice(9, 16))


def around(count: int) -> torch.Tensor:
    """Directions spread evenly over the sphere, along a spiral."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    height, angle = 1 - 2 * step / count, step * math.pi * (3 - math.sqrt(5))
    ring = (1 - height**2).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)


def test_harmonics_are_orthonormal() -> None:
    values = spherical_harmonics(around(20000))
    assert values.shape == (20000, DIRECTION)
    torch.testing.assert_close(4 * math.pi * values.T @ values / 20000, torch.eye(DIRECTION).double(), atol=1e-3, rtol=0)


@pytest.mark.parametrize("kind", ["deferred", "per_sample"])
def test_a_field_stored_with_nine_harmonics_is_the_same_field(kind: str, tmp_path: Path) -> None:
    field = random_field(decoder=kind)
    name = "net.0.weight" if kind == "deferred" else "colour.0.weight"
    field.decoder.state_dict()[name][:, -(DIRECTION - BEHIND) :] = 0
    field.save(tmp_path / "new.safetensors")
    data = read_field(tmp_path / "new.safetensors")
    data.decoder[name] = data.decoder[name][:, : -(DIRECTION - BEHIND)]
    write_field(tmp_path / "old.safetensors", data, "float16")
    old, new = Field.load(tmp_path / "old.safetensors"), Field.load(tmp_path / "new.safetensors")
    for (key, one), other in zip(old.decoder.state_dict().items(), new.decoder.state_dict().values(), strict=True):
        assert torch.equal(one, other), key


def test_weights_of_another_width_are_refused() -> None:
    weights = make_decoder("deferred", 8, 16).state_dict()
    weights["net.0.weight"] = weights["net.0.weight"][:, :-1]
    with pytest.raises(RuntimeError, match="size mismatch"):
        make_decoder("deferred", 8, 16).load_state_dict(weights)
