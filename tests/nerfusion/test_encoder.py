"""The image encoder: alive at the start, aligned with its picture, cheap."""

from __future__ import annotations

import pytest
import torch

from fieldfuse.nerfusion.encoder import STRIDE, ImageEncoder, Sampled
from tests.nerfusion.made import pictures


def test_features_are_alive_at_the_start() -> None:
    for seed in range(3):
        torch.manual_seed(seed)
        maps = ImageEncoder()(pictures(2, seed, (96, 128))).detach()
        deviation = maps.flatten(2).std(2)
        assert maps.shape == (2, 64, 24, 32)
        assert float(deviation.mean()) > 0.3 and float(deviation.min()) > 0.05, "features must differ from place to place"


def test_every_parameter_learns() -> None:
    torch.manual_seed(0)
    encoder = ImageEncoder(16)
    encoder(pictures(1, 0, (48, 64))).square().mul(torch.linspace(0, 1, 16).view(16, 1, 1)).sum().backward()
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None and float(parameter.grad.abs().max()) > 0, name


@pytest.mark.parametrize("size", [(48, 64), (50, 61), (17, 16), (1, 1)])
def test_any_size(size: tuple[int, int]) -> None:
    maps = ImageEncoder(16)(torch.rand(1, 3, *size))
    assert maps.shape[2:] == (-(-size[0] // 16) * 4, -(-size[1] // 16) * 4)
    assert bool(torch.isfinite(maps).all())


def test_cells_are_centred_where_unprojection_looks_for_them() -> None:
    """Turning the picture around turns the map around: with symmetric kernels that holds only for cells centred at s · (j + ½)."""
    torch.manual_seed(0)
    encoder = ImageEncoder(16).double()
    for parameter in encoder.parameters():
        if parameter.ndim == 4:
            parameter.data = (parameter.data + parameter.data.flip(3)) / 2
    image = torch.rand(1, 3, 64, 96, dtype=torch.float64)
    torch.testing.assert_close(encoder(image.flip(3)), encoder(image).flip(3), atol=1e-9, rtol=1e-9)
    sampled = Sampled(16, 16, 4).double()
    sampled.fine.weight.data = (sampled.fine.weight.data + sampled.fine.weight.data.flip(3)) / 2
    one, two = sampled(*encoder.maps(image)), sampled(*encoder.maps(image.flip(3)))
    torch.testing.assert_close(two, one.flip(3), atol=1e-9, rtol=1e-9)
    assert one.shape == (1, 4, 64 // STRIDE, 96 // STRIDE) and float(one.detach().flatten(2).std(2).mean()) > 0.1
