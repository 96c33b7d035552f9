"""The kernels on a CUDA device: against the tensors that they stand for, at the sizes of a key frame. Without a device: nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

from fieldfuse.backends import dispatch

if not torch.cuda.is_available():
    pytest.skip("needs a CUDA device", allow_module_level=True)

from fieldfuse.nerfusion.block_conv import block_conv3d
from fieldfuse.nerfusion.extras.cross_view_consistency import confident_points, consistency, cross_view
from fieldfuse.nerfusion.extras.cross_view_consistency import own_estimate as by_itself
from fieldfuse.nerfusion.extras.matching import patch_descriptors, smoothed_softmax
from fieldfuse.nerfusion.extras.plane_sweep import _table, cost_volume, sweep_planes, to_probability
from fieldfuse.nerfusion.unproject import EncodedView, look_up, project
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import cameras, pictures, small_model
from tests.nerfusion.test_plane_sweep import wall

DEVICE = torch.device("cuda")


def timed(name: str, work: Callable[[], Any]) -> Any:
    """What `work` gives; prints milliseconds of a call on the device, the second and later ones."""
    work()
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(5):
        out = work()
    torch.cuda.synchronize()
    sys.stdout.write(f"{name}: {200 * (time.perf_counter() - start):.3f} ms\n")
    return out


def both(name: str, work: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    quick = timed(name, work)
    monkeypatch.setattr(dispatch, "_installed", lambda: False)
    slow = timed(name + ", tensors", work)
    monkeypatch.undo()
    return quick, slow


def test_matching(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = torch.rand((96, 128, 180), generator=torch.Generator().manual_seed(0)).to(DEVICE).permute(2, 0, 1)
    quick, slow = both("likelihood", lambda: smoothed_softmax(cost), monkeypatch)
    torch.testing.assert_close(quick, slow, atol=1e-4, rtol=0)
    likely = smoothed_softmax(cost)
    quick, slow = both("table", lambda: _table(likely, 0.01), monkeypatch)
    torch.testing.assert_close(quick, slow, atol=1e-4, rtol=0)


def test_a_sweep_and_its_witnesses(monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors, seen_by = wall(3)
    descriptors, seen_by = [one.to(DEVICE) for one in descriptors], seen_by.to(DEVICE)
    points = (torch.rand((100_000, 3), generator=torch.Generator().manual_seed(0)) * 8 - 3).to(DEVICE)
    depth = (torch.rand((72, 96), generator=torch.Generator().manual_seed(1)) * 8 - 1).to(DEVICE)

    def everything() -> dict[str, torch.Tensor]:
        costs = cost_volume(descriptors, seen_by, 0.8, 6.0)
        own_estimate = to_probability(costs)
        other = cross_view(sweep_planes([descriptors[1], descriptors[0], descriptors[2]], seen_by[[1, 0, 2]], 0.8, 6.0))
        correction = consistency(costs, [other, cross_view(own_estimate)], confident_points(costs, own_estimate))
        assert correction is not None
        made = to_probability(costs, correction=correction)
        read = made.look(points, torch.full((len(points),), 0.1, device=DEVICE))
        own = by_itself(costs)[0]
        out = {"cost": costs.cost, "alone": own_estimate.table, "said": correction, "table": made.table, "says": own.log_odds}
        out["measured"] = to_probability(costs, depth).table
        return out | {"signed": read.expected_sdf, "open": read.visibility, "sure": read.confidence}

    quick, slow = both("sweep and witnesses", everything, monkeypatch)
    for name, expected in slow.items():
        torch.testing.assert_close(quick[name], expected, atol=2e-3, rtol=1e-3, msg=lambda text, name=name: f"{name}: {text}")


@pytest.mark.parametrize("size", [(144, 192), (480, 640)])
def test_what_pictures_are_compared_by(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    images = torch.rand(3, *size, 3, generator=torch.Generator().manual_seed(0)).to(DEVICE).permute(0, 3, 1, 2)
    quick, slow = both(f"descriptors of {size[0]} x {size[1]}", lambda: patch_descriptors(images), monkeypatch)
    torch.testing.assert_close(quick, slow, atol=1e-4, rtol=0)


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("inside", "outside"), [(16, 16), (32, 16), (8, 8)])
def test_convolution(kind: torch.dtype, inside: int, outside: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    line = torch.arange(7)
    topology = Topology(torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3).to(DEVICE))
    occupied = (torch.rand(topology.zero_row, generator=generator) < 0.6).to(DEVICE)
    rows = torch.randn(topology.zero_row + 1, inside, generator=generator).to(DEVICE, kind)
    rows[:-1] *= occupied[:, None]
    rows[-1] = 0
    weight, bias = torch.randn(outside, inside, 3, 3, 3, generator=generator), torch.randn(outside, generator=generator)
    slopes = torch.randn(len(rows), outside, generator=generator).to(DEVICE, kind)
    leaves = [rows.requires_grad_(), weight.to(DEVICE, kind).requires_grad_(), bias.to(DEVICE, kind).requires_grad_()]

    def everything() -> list[Any]:
        out = block_conv3d(leaves[0], topology, leaves[1], leaves[2], occupied)
        return [out.detach(), *torch.autograd.grad(out, leaves, slopes)]

    allowed = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    quick, slow = both(f"convolution {inside} to {outside}, {kind}, forwards and backwards", everything, monkeypatch)
    with torch.no_grad():
        both(f"convolution {inside} to {outside}, {kind}", lambda: block_conv3d(*leaves[:1], topology, *leaves[1:], occupied), monkeypatch)
    torch.backends.cudnn.allow_tf32 = allowed
    for mine, expected in zip(quick, slow, strict=True):
        scale = float(expected.float().abs().max())
        torch.testing.assert_close(mine.float() / scale, expected.float() / scale, atol=1e-4 if kind is torch.float32 else 2e-2, rtol=0)


def test_lookup(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    model, seen_by = small_model().to(DEVICE), cameras(3).to(DEVICE)
    points, sizes, step = (torch.rand(100_000, *rest, generator=generator).to(DEVICE) for rest in ((3,), (), ()))
    with torch.no_grad():
        views: list[EncodedView] = model.encode(pictures(3).to(DEVICE), seen_by)
        projection = project(points * 2 - 1, sizes * 0.4, seen_by, 0.0, 9.0)
        quick, slow = both("lookup", lambda: look_up(views, projection, 6 * step), monkeypatch)
    torch.testing.assert_close(quick, slow, atol=1e-4, rtol=1e-4)


def test_encoding_is_recorded() -> None:
    """What is repeated equals what is launched one by one, also when other pictures come and parameters change in place."""
    model, seen_by = small_model().to(DEVICE), cameras(3).to(DEVICE)

    @torch.no_grad()
    def rows(seed: int) -> list[torch.Tensor]:
        return [of for view in model.encode(pictures(3, seed).to(DEVICE), seen_by) for of in (view.features.rows, view.colours.rows)]

    for _ in range(3):
        rows(0)
    for seed in (1, 2):
        found = rows(seed)
        model._recorded = type(model._recorded)()
        for one, expected in zip(found, rows(seed), strict=True):
            torch.testing.assert_close(one, expected, atol=1e-5, rtol=1e-5)
        for _ in range(2):
            rows(seed)
        with torch.no_grad():
            next(model.encoder.parameters()).mul_(1.5)
