"""The compiled plane sweep: against the tensors it stands for, on any number of threads, and on places where nothing can be read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.timing import pinned
from fieldfuse.backends import dispatch
from fieldfuse.backends.numba import plane_sweep as kernels
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import CrossView, confident_points, consistency, cross_view
from fieldfuse.nerfusion.extras.matching import semi_global, smoothed_softmax
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, carved, cost_volume, sweep_planes, to_probability
from tests.nerfusion.made import off
from tests.nerfusion.test_plane_sweep import slow_paths, wall

NEAR, FAR = 0.8, 6.0


def places(count: int = 20_000, seed: int = 0) -> torch.Tensor:
    """(N, 3) before, behind and beside cameras that look along z from about the origin."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand((count, 3), generator=generator) * torch.tensor([8.0, 8.0, 9.0]) - torch.tensor([4.0, 4.0, 1.0])


def everything(views: int = 4, asked: int = 20_000) -> dict[str, torch.Tensor]:
    """What a key frame and its witness come to."""
    descriptors, seen_by = wall(views)
    costs = cost_volume(descriptors, seen_by, NEAR, FAR)
    own_estimate = to_probability(costs)
    order = [1, 0, *range(2, views)] if views > 1 else [0]
    other = cross_view(sweep_planes([descriptors[k] for k in order], seen_by[order], NEAR, FAR))
    correction = consistency(costs, [other, cross_view(own_estimate)], confident_points(costs, own_estimate))
    made = to_probability(costs, correction=correction)
    assert correction is not None
    read = made.look(places(asked), torch.full((asked,), 0.1))
    spoken, seen = other.log_odds_at(places(asked))
    return {
        "cost": costs.cost,
        "alone": own_estimate.table,
        "said": correction,
        "table": made.table,
        "signed": read.expected_sdf,
        "open": read.visibility,
        "sure": read.confidence,
        "spoken": spoken,
        "seen": seen.float(),
    }


def boxed(points: torch.Tensor) -> torch.Tensor:
    """Empty but in a box about the wall."""
    return ((points - points.new_tensor([0.1, 0.0, 2.0])).abs() > points.new_tensor([0.5, 0.4, 0.5])).any(1)


def within() -> dict[str, torch.Tensor]:
    """The same with silhouettes."""
    descriptors, seen_by = wall(3)
    costs = cost_volume(descriptors, seen_by, NEAR, FAR, boxed)
    assert costs.empty is not None and 0 < float(costs.empty.float().mean()) < 1
    return {"cost": costs.cost, "likely": carved(smoothed_softmax(costs.cost), costs.empty), "table": to_probability(costs).table}


@pytest.mark.parametrize("views", [1, 2, 4])
def test_it_gives_what_the_tensors_give(views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = everything(views)
    off(monkeypatch)
    for name, expected in everything(views).items():
        torch.testing.assert_close(quick[name], expected, atol=1e-4, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")


def test_it_gives_what_the_tensors_give_within_silhouettes(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = within()
    off(monkeypatch)
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.AT_ONCE", 100)
    for name, expected in within().items():
        torch.testing.assert_close(quick[name], expected, atol=1e-4, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")


def test_threads_do_not_matter() -> None:
    with pinned(1):
        one = everything()
    for count in (2, 3):
        with pinned(count):
            several = everything()
        for name in ("cost", "spoken", "seen", "signed"):
            torch.testing.assert_close(several[name], one[name], atol=1e-6, rtol=1e-6)
        assert torch.equal(several["cost"], one["cost"])


@pytest.mark.parametrize("shape", [(7, 5, 6), (1, 4, 3), (2, 1, 1), (33, 2, 9)])
def test_semi_global_matching_against_its_recurrence(shape: tuple[int, int, int]) -> None:
    cost = np.random.default_rng(0).random(shape).astype(np.float32)
    given = torch.from_numpy(cost)
    assert dispatch.can_use_numba(given)
    np.testing.assert_allclose(semi_global(given).numpy(), slow_paths(cost.astype(np.float64)), atol=1e-5)


def no_number(camera: Cameras) -> Cameras:
    return replace(camera, world_from_camera=torch.full_like(camera.world_from_camera, torch.nan))


def test_cameras_out_of_this_world_are_read_as_seeing_nothing() -> None:
    descriptors, seen_by = wall(3)
    lost = Cameras.together([seen_by[0], no_number(seen_by[1]), seen_by[2]])
    honest = cost_volume([descriptors[0], descriptors[2]], seen_by[[0, 2]], NEAR, FAR)
    own = descriptors[0].flatten(1).T[: len(honest.rays)]
    found = kernels.costs(descriptors[:2], lost[:2], honest.inverses, honest.rays, own, 8.0, 0.6)
    assert float((found - 0.6).abs().max()) < 1e-6
    one = cross_view(to_probability(honest))
    spoken, seen = replace(one, camera=no_number(one.camera)).log_odds_at(places())
    assert not bool(seen.any()) and float(spoken.abs().max()) == 0


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_extreme_places_and_tiny_tables_are_not_read_beyond(scale: float) -> None:
    camera = Cameras.same_size(torch.tensor([[10.0, 10.0, 0.5, 0.5]]), torch.eye(4)[None], 1, 1)
    table = torch.tensor([[0.9, 0.1], [0.0, 0.1], [1.0, 1.0]]).view(3, 2, 1, 1)
    made, told = DepthDistribution(camera, table, 0.2 / scale, 0.5 / scale), CrossView(camera, table[0], 0.2 / scale, 0.5 / scale)
    far = torch.tensor([[0.0, 0, -1], [0, 0, 0], [1e9, -1e9, 1], [0, 0, 1e9], [1e-9, 0, 1e-9], [torch.nan, 0, 1]]) * scale
    read = made.look(far, torch.full((6,), 0.1 * scale))
    for values in (read.expected_sdf, read.visibility, read.confidence):
        assert bool(torch.isfinite(values[:5]).all()) and float(values[:5].abs().max()) <= 1
    spoken, seen = told.log_odds_at(far)
    assert bool(torch.isfinite(spoken).all()) and not bool(seen[[0, 2, 5]].any()) and bool(seen[3])


def test_where_planes_lie_is_told_in_full_precision() -> None:
    descriptors, seen_by = wall(3)
    full = cost_volume(descriptors, seen_by, NEAR, FAR)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        reduced = cost_volume(descriptors, seen_by, NEAR, FAR)
    assert torch.equal(reduced.cost, full.cost) and torch.equal(reduced.rays, full.rays)
