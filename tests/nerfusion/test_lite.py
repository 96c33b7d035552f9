"""The trunk that can start from ImageNet: folding against plain batch norms, alignment, and refusals."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from fieldfuse.errors import InputError
from fieldfuse.nerfusion import lite
from fieldfuse.nerfusion.encoder import ImageEncoder
from fieldfuse.nerfusion.lite import EPSILON, Block, lite_trunk, load_imagenet
from tests.nerfusion.made import SMALL, pictures


def stored(seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights with the names and shapes of the published file."""
    generator = torch.Generator().manual_seed(seed)
    stem, stages = lite_trunk()
    values: dict[str, torch.Tensor] = {}

    def put(conv: torch.nn.Module, name: str, norm: str) -> None:
        assert isinstance(conv, torch.nn.Conv2d)
        outside, inside, side, _ = conv.weight.shape
        side -= conv.stride[0] == 2
        values[f"{name}.weight"] = torch.randn((outside, inside, side, side), generator=generator) / (inside * side**2) ** 0.5
        values[f"{norm}.weight"] = 0.5 + torch.rand(outside, generator=generator)
        values[f"{norm}.bias"] = 0.3 * torch.randn(outside, generator=generator)
        values[f"{norm}.running_mean"] = 0.3 * torch.randn(outside, generator=generator)
        values[f"{norm}.running_var"] = 0.5 + torch.rand(outside, generator=generator)

    put(stem[0], "_conv_stem", "_bn0")
    blocks = [block for part in (stem, *stages) for block in part if isinstance(block, Block)]
    assert len(blocks) == 11
    for number, block in enumerate(blocks):
        if block.expand is not None:
            put(block.expand, f"_blocks.{number}._expand_conv", f"_blocks.{number}._bn0")
        put(block.depthwise, f"_blocks.{number}._depthwise_conv", f"_blocks.{number}._bn1")
        put(block.project, f"_blocks.{number}._project_conv", f"_blocks.{number}._bn2")
    return values


def test_folding_is_what_the_norms_did(tmp_path: Path) -> None:
    """A block of stride 1, written down again with its batch norms; and a stride-2 one as the mean of its two nearest places."""
    values = stored()
    torch.save(values, tmp_path / "weights.pth")
    stem, stages = lite_trunk()
    load_imagenet(stem, stages, tmp_path / "weights.pth")

    def norm(x: torch.Tensor, name: str) -> torch.Tensor:
        return F.batch_norm(
            x, *(values[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")), training=False, eps=EPSILON
        )

    x = torch.randn(1, 24, 10, 12)
    name = "_blocks.2."
    y = F.relu6(norm(F.conv2d(x, values[f"{name}_expand_conv.weight"]), f"{name}_bn0"))
    y = F.relu6(norm(F.conv2d(y, values[f"{name}_depthwise_conv.weight"], padding=1, groups=144), f"{name}_bn1"))
    expected = x + norm(F.conv2d(y, values[f"{name}_project_conv.weight"]), f"{name}_bn2")
    torch.testing.assert_close(stages[0][1](x), expected, atol=1e-5, rtol=1e-4)

    image = torch.randn(1, 3, 16, 16)
    places = []
    for dy in (0, 1):
        for dx in (0, 1):  # the odd kernel centred on each of the four pixels around the middle of a cell
            moved = F.pad(image, (1 - dx, 1 + dx, 1 - dy, 1 + dy))
            places.append(F.conv2d(moved, values["_conv_stem.weight"], stride=2)[:, :, :8, :8])
    expected = norm(torch.stack(places).mean(0), "_bn0")
    found = stem[0](image)
    torch.testing.assert_close(found[:, :, 1:-1, 1:-1], expected[:, :, 1:-1, 1:-1], atol=1e-5, rtol=1e-4)


def test_it_serves_as_the_encoder(tmp_path: Path) -> None:
    torch.save(stored(1), tmp_path / "weights.pth")
    torch.manual_seed(0)
    encoder = ImageEncoder(16, "lite0")
    encoder.load_imagenet(tmp_path / "weights.pth")
    half, maps = encoder.maps(pictures(1, 0, (50, 61)))
    assert half.shape == (1, 16, 32, 32) and maps.shape == (1, 16, 16, 16)
    assert float(maps.detach().flatten(2).std(2).mean()) > 0.3
    maps.square().mul(torch.linspace(0, 1, 16).view(16, 1, 1)).sum().backward()
    assert encoder.stem[0].weight.grad is not None and float(encoder.stem[0].weight.grad.abs().max()) > 0


def test_what_cannot_be_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="lite0"):
        ImageEncoder(16).load_imagenet()
    encoder = ImageEncoder(16, "lite0")
    monkeypatch.setattr(lite, "PACKAGE", "a_package_that_nobody_has")
    with pytest.raises(InputError, match="a_package_that_nobody_has"):
        encoder.load_imagenet()
    path = tmp_path / "weights.pth"
    path.write_bytes(b"nothing of the kind")
    short, wrong = stored(), stored()
    short.pop("_bn0.bias")
    wrong["_conv_stem.weight"] = wrong["_conv_stem.weight"][:, :2]
    for content in (None, short, wrong, {"code": SMALL}):
        if content is not None:
            torch.save(content, path)
        with pytest.raises(InputError, match="cannot be used"):
            encoder.load_imagenet(path)
