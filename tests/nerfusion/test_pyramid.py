"""Lookups in pyramids against a slow definition, and their gradient."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.backends.numba.feature_lookup import _into
from fieldfuse.nerfusion.unproject import Pyramid, pyramid_pixels, pyramid_rows, pyramid_sizes


def pyramid(image: torch.Tensor, stride: int, levels: int) -> Pyramid:
    return Pyramid(pyramid_rows(image[None], levels)[0].contiguous(), pyramid_sizes(*image.shape[1:], levels), stride)


def slow(levels: list[torch.Tensor], stride: int, u: float, v: float, footprint: float) -> torch.Tensor:
    level = min(max(round(float(torch.log2(torch.tensor(footprint / stride)))), 0), len(levels) - 1)
    image, cell = levels[level], stride * 2**level
    x = min(max(u / cell - 0.5, 0.0), image.shape[2] - 1.0)
    y = min(max(v / cell - 0.5, 0.0), image.shape[1] - 1.0)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, image.shape[2] - 1), min(y0 + 1, image.shape[1] - 1)
    fx, fy = x - x0, y - y0
    top = (1 - fx) * image[:, y0, x0] + fx * image[:, y0, x1]
    return (1 - fy) * top + fy * ((1 - fx) * image[:, y1, x0] + fx * image[:, y1, x1])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1, 4]), st.integers(1, 3))
def test_against_the_definition(seed: int, stride: int, levels: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand((2, 8, 12), generator=generator, dtype=torch.float64)
    maps = [image]
    for _ in range(levels - 1):
        maps.append(maps[-1].unflatten(2, (-1, 2)).mean(3).unflatten(1, (-1, 2)).mean(2))
    made = pyramid(image, stride, levels)
    assert made.sizes == tuple((level.shape[1], level.shape[2]) for level in maps)
    pixels = (torch.rand((20, 2), generator=generator, dtype=torch.float64) * 1.2 - 0.1) * stride * torch.tensor([12.0, 8.0])
    footprint = torch.exp(3 * torch.randn(20, generator=generator, dtype=torch.float64))
    found = made.lookup(pixels, footprint)
    for row, (u, v), size in zip(found, pixels.tolist(), footprint.tolist(), strict=True):
        torch.testing.assert_close(row, slow(maps, stride, u, v, size), atol=1e-9, rtol=1e-9)


def test_a_pixel_centre_gives_that_pixel() -> None:
    image = torch.rand(3, 4, 6)
    made = pyramid(image, 1, 5)
    assert made.sizes == ((4, 6), (2, 3))  # no further: a side is odd
    found = made.lookup(pyramid_pixels(made.sizes, made.stride, image.device, image.dtype)[:24], torch.ones(24))
    torch.testing.assert_close(found, image.flatten(1).T)
    whole = made.lookup(pyramid_pixels(made.sizes, made.stride, image.device, image.dtype)[24:], torch.full((6,), 2.0))
    torch.testing.assert_close(whole, made.rows[24:])


def test_gradient() -> None:
    image = torch.rand(2, 4, 4, dtype=torch.float64, requires_grad=True)
    pixels = torch.rand(7, 2, dtype=torch.float64) * 4
    footprint = torch.tensor([1.0, 1.0, 2.0, 2.0, 8.0, 0.1, 1.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: pyramid(x, 1, 2).lookup(pixels, footprint), (image,))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1, 2, 4]), st.integers(1, 4), st.integers(1, 9))
def test_the_kernel_gives_the_same(seed: int, stride: int, levels: int, channels: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    made = pyramid(torch.randn((channels, 16, 24), generator=generator), stride, levels)
    pixels = (torch.rand((5000, 2), generator=generator) * 1.4 - 0.2) * stride * torch.tensor([24.0, 16.0])
    footprint = torch.exp(2 * torch.randn(5000, generator=generator))
    halves = (torch.log2(footprint / stride) % 1 - 0.5).abs() < 1e-5  # between two levels the last digit decides
    footprint = torch.where(halves, 1.001 * footprint, footprint)
    out = torch.full((5000, channels + 3), 7.0)
    _into(made, pixels, footprint, out, 2)
    torch.testing.assert_close(out[:, 2 : channels + 2], made.lookup(pixels, footprint), atol=1e-5, rtol=1e-5)
    assert bool((out[:, :2] == 7).all()) and bool((out[:, channels + 2 :] == 7).all()), "the other columns are not its own"


def test_the_kernel_reads_nothing_beyond_for_places_out_of_this_world() -> None:
    made = pyramid(torch.rand(2, 4, 6), 2, 2)
    nan, inf = torch.nan, torch.inf
    pixels = torch.tensor([[nan, 1.0], [inf, -inf], [1e30, -1e30], [3.0, nan], [3.0, 3.0], [3.0, 3.0]])
    footprint = torch.tensor([1.0, inf, 1e30, nan, nan, -1.0])
    out = torch.zeros(6, 2)
    _into(made, pixels, footprint, out, 0)
    assert bool(((out[1:3] >= 0) & (out[1:3] <= 1)).all()) and bool(((out[4:] >= 0) & (out[4:] <= 1)).all())
