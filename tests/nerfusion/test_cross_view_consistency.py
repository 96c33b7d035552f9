"""Key frames as each other's witnesses: against a slow loop, and on a wall that one of them cannot see for lack of texture."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import AGAINST, FOR, SHARE, confident_points, consistency, cross_view, reliability
from fieldfuse.nerfusion.extras.plane_sweep import CostVolume, DepthDistribution, cost_volume, sweep_planes, to_probability
from tests.nerfusion.test_plane_sweep import WALL, on_axis, wall

NEAR, FAR = 0.8, 6.0


def others(scale: float = 1.0, told: float = WALL) -> DepthDistribution:
    """The sweep of the wall from its second view on."""
    descriptors, seen_by = wall(4, scale=scale)
    order = [1, 0, 2, 3]
    depth = None if told == WALL else torch.full((72, 96), told * scale)
    return sweep_planes([descriptors[k] for k in order], seen_by[order], NEAR * scale, FAR * scale, depth)


def blind(scale: float = 1.0) -> CostVolume:
    """The first view, whose pictures show no texture."""
    descriptors, seen_by = wall(3, scale=scale)
    return cost_volume([torch.zeros_like(one) for one in descriptors], seen_by, NEAR * scale, FAR * scale)


def wrong(made: DepthDistribution, scale: float = 1.0) -> float:
    """Mean error of what voxels on the axis read, in truncations."""
    places, truncation = on_axis(torch.linspace(0.9, 5.0, 83)) * scale, torch.full((83,), 0.15 * scale)
    return float((made.look(places, truncation).expected_sdf - ((WALL * scale - places[:, 2]) / truncation).clamp(-1, 1)).abs().mean())


def test_a_witness_says_what_a_slow_loop_says() -> None:
    one, costs = cross_view(others()), blind()
    distribution = others()
    planes, height, width = distribution.table.shape[1:]
    nearer = [[[0.0] * width for _ in range(height)] for _ in range(planes)]
    for d in range(planes):
        for y in range(height):
            for x in range(width):
                nearer[d][y][x] = float(distribution.table[0, d, y, x])
    for d, y, x in [(0, 3, 5), (1, 0, 0), (planes // 2, 20, 30), (planes - 2, 7, 1), (planes - 1, height - 1, width - 1)]:
        hidden = nearer[d + 2][y][x] if d + 2 < planes else 0.0
        free = 1 - nearer[d - 2][y][x] if d > 1 else 0.0
        expected = torch.tensor(FOR * max(0.0, 1 - hidden - free) + hidden + AGAINST).log()
        assert float(one.log_odds[d, y, x]) == pytest.approx(float(expected), abs=1e-5)
    # A place in the middle of a cell reads that cell alone.
    depth = 1 / (distribution.lowest + 7 * distribution.step)
    local = depth * torch.tensor([[(10.5 / width * 96 - 48) / 90, (20.5 / height * 72 - 36) / 90, 1.0]])
    pose = distribution.camera.world_from_camera[0]
    correction, seen = one.log_odds_at(local @ pose[:3, :3].T + pose[:3, 3])
    assert bool(seen.all()) and float(correction) == pytest.approx(float(one.log_odds[7, 20, 10]), abs=1e-3)
    assert costs.cost.shape[0] == len(costs.inverses)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_view_without_texture_is_told_where_the_wall_is(scale: float) -> None:
    costs = blind(scale)
    correction = consistency(costs, [cross_view(others(scale))])
    assert correction is not None and bool(torch.isfinite(correction).all())
    assert wrong(to_probability(costs, correction=correction), scale) < 0.15 < 0.3 < wrong(to_probability(costs), scale)


def test_pictures_that_tell_their_depth_are_not_talked_out_of_it() -> None:
    """One witness in error among three: the wall stays where it is."""
    descriptors, seen_by = wall(3)
    costs = cost_volume(descriptors, seen_by, NEAR, FAR)
    liar = cross_view(others(told=1.4))
    assert wrong(to_probability(costs, correction=consistency(costs, [liar, cross_view(others()), cross_view(others())]))) < 0.05
    assert wrong(to_probability(costs, correction=consistency(costs, [cross_view(others())]))) < 0.05


def test_witnesses_come_in_any_order_and_say_nothing_of_what_they_do_not_see() -> None:
    costs = blind()
    one, two = cross_view(others()), cross_view(others(told=3.0))
    torch.testing.assert_close(consistency(costs, [one, two]), consistency(costs, [two, one]))
    away = one.camera.world_from_camera.clone()
    away[:, :3, :3] *= torch.tensor([-1.0, 1.0, -1.0])
    behind = replace(one, camera=Cameras(one.camera.intrinsics, one.camera.size, away))
    silent = consistency(costs, [behind])
    assert silent is not None and float(silent.abs().max()) == 0
    torch.testing.assert_close(consistency(costs, [one, behind]), consistency(costs, [one]))
    assert consistency(costs, []) is None
    assert torch.equal(to_probability(costs, correction=silent).table, to_probability(costs).table)


def test_what_is_said_is_bounded() -> None:
    correction = consistency(blind(), [cross_view(others())] * 5)
    assert correction is not None
    low, high = (SHARE * float(torch.tensor(value).log()) for value in (AGAINST, FOR + AGAINST))
    assert low - 1e-5 <= float(correction.min()) < 0 < float(correction.max()) <= high + 1e-5


def test_a_witness_is_believed_as_far_as_it_confirms_what_is_sure() -> None:
    descriptors, seen_by = wall(3)
    costs = cost_volume(descriptors, seen_by, NEAR, FAR)
    surface = confident_points(costs, to_probability(costs))
    assert len(surface) > 1000 and float((surface[:, 2] - WALL).abs().median()) < 0.05
    honest, liar, beyond = cross_view(others()), cross_view(others(told=1.4)), cross_view(others(told=4.0))
    assert reliability(honest, surface) > 0.8 and reliability(liar, surface) < 0.2 and reliability(beyond, surface) == 0
    assert reliability(liar, surface[:0]) == 1.0, "nothing speaks against it"
    silent = consistency(costs, [beyond], surface)
    assert silent is not None and float(silent.abs().max()) == 0
    full, weighed = consistency(costs, [honest, beyond]), consistency(costs, [honest, beyond], surface)
    half = consistency(costs, [honest])
    assert full is not None and weighed is not None and half is not None
    torch.testing.assert_close(weighed, 0.5 * reliability(honest, surface) * half)
