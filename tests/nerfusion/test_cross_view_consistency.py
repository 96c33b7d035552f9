"""Key frames as each other's witnesses: against a slow loop, and on a wall that one of them cannot see for lack of texture."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import AGAINST, FOR, SHARE, certain, credit, evidence, witness
from fieldfuse.nerfusion.extras.plane_sweep import Compared, Sweep, compare, decide, sweep
from tests.nerfusion.test_plane_sweep import WALL, on_axis, wall

NEAR, FAR = 0.8, 6.0


def others(scale: float = 1.0, told: float = WALL) -> Sweep:
    """The sweep of the wall from its second view on."""
    described, seen_by = wall(4, scale=scale)
    order = [1, 0, 2, 3]
    depth = None if told == WALL else torch.full((72, 96), told * scale)
    return sweep([described[k] for k in order], seen_by[order], NEAR * scale, FAR * scale, depth)


def blind(scale: float = 1.0) -> Compared:
    """The first view, whose pictures show no texture."""
    described, seen_by = wall(3, scale=scale)
    return compare([torch.zeros_like(one) for one in described], seen_by, NEAR * scale, FAR * scale)


def wrong(made: Sweep, scale: float = 1.0) -> float:
    """Mean error of what voxels on the axis read, in truncations."""
    places, truncation = on_axis(torch.linspace(0.9, 5.0, 83)) * scale, torch.full((83,), 0.15 * scale)
    return float((made.look(places, truncation).signed - ((WALL * scale - places[:, 2]) / truncation).clamp(-1, 1)).abs().mean())


def test_a_witness_says_what_a_slow_loop_says() -> None:
    one, compared = witness(others()), blind()
    swept = others()
    planes, height, width = swept.table.shape[1:]
    nearer = [[[0.0] * width for _ in range(height)] for _ in range(planes)]
    for d in range(planes):
        for y in range(height):
            for x in range(width):
                nearer[d][y][x] = float(swept.table[0, d, y, x])
    for d, y, x in [(0, 3, 5), (1, 0, 0), (planes // 2, 20, 30), (planes - 2, 7, 1), (planes - 1, height - 1, width - 1)]:
        hidden = nearer[d + 2][y][x] if d + 2 < planes else 0.0
        free = 1 - nearer[d - 2][y][x] if d > 1 else 0.0
        expected = torch.tensor(FOR * max(0.0, 1 - hidden - free) + hidden + AGAINST).log()
        assert float(one.says[d, y, x]) == pytest.approx(float(expected), abs=1e-5)
    # A place in the middle of a cell reads that cell alone.
    local = torch.tensor([[(10.5 / width * 96 - 48) / 90, (20.5 / height * 72 - 36) / 90, 1.0]]) / (swept.lowest + 7 * swept.step)
    pose = swept.camera.world_from_camera[0]
    said, seen = one.ask(local @ pose[:3, :3].T + pose[:3, 3])
    assert bool(seen.all()) and float(said) == pytest.approx(float(one.says[7, 20, 10]), abs=1e-3)
    assert compared.cost.shape[0] == len(compared.inverses)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_view_without_texture_is_told_where_the_wall_is(scale: float) -> None:
    compared = blind(scale)
    said = evidence(compared, [witness(others(scale))])
    assert said is not None and bool(torch.isfinite(said).all())
    assert wrong(decide(compared, said=said), scale) < 0.15 < 0.3 < wrong(decide(compared), scale)


def test_pictures_that_tell_their_depth_are_not_talked_out_of_it() -> None:
    """One witness in error among three: the wall stays where it is."""
    described, seen_by = wall(3)
    compared = compare(described, seen_by, NEAR, FAR)
    liar = witness(others(told=1.4))
    assert wrong(decide(compared, said=evidence(compared, [liar, witness(others()), witness(others())]))) < 0.05
    assert wrong(decide(compared, said=evidence(compared, [witness(others())]))) < 0.05


def test_witnesses_come_in_any_order_and_say_nothing_of_what_they_do_not_see() -> None:
    compared = blind()
    one, two = witness(others()), witness(others(told=3.0))
    torch.testing.assert_close(evidence(compared, [one, two]), evidence(compared, [two, one]))
    away = one.camera.world_from_camera.clone()
    away[:, :3, :3] *= torch.tensor([-1.0, 1.0, -1.0])
    behind = replace(one, camera=Cameras(one.camera.intrinsics, one.camera.size, away))
    silent = evidence(compared, [behind])
    assert silent is not None and float(silent.abs().max()) == 0
    torch.testing.assert_close(evidence(compared, [one, behind]), evidence(compared, [one]))
    assert evidence(compared, []) is None
    assert torch.equal(decide(compared, said=silent).table, decide(compared).table)


def test_what_is_said_is_bounded() -> None:
    said = evidence(blind(), [witness(others())] * 5)
    assert said is not None
    low, high = (SHARE * float(torch.tensor(value).log()) for value in (AGAINST, FOR + AGAINST))
    assert low - 1e-5 <= float(said.min()) < 0 < float(said.max()) <= high + 1e-5


def test_a_witness_is_believed_as_far_as_it_confirms_what_is_sure() -> None:
    described, seen_by = wall(3)
    compared = compare(described, seen_by, NEAR, FAR)
    surface = certain(compared, decide(compared))
    assert len(surface) > 1000 and float((surface[:, 2] - WALL).abs().median()) < 0.05
    honest, liar, beyond = witness(others()), witness(others(told=1.4)), witness(others(told=4.0))
    assert credit(honest, surface) > 0.8 and credit(liar, surface) < 0.2 and credit(beyond, surface) == 0
    assert credit(liar, surface[:0]) == 1.0, "nothing speaks against it"
    silent = evidence(compared, [beyond], surface)
    assert silent is not None and float(silent.abs().max()) == 0
    full, weighed = evidence(compared, [honest, beyond]), evidence(compared, [honest, beyond], surface)
    half = evidence(compared, [honest])
    assert full is not None and weighed is not None and half is not None
    torch.testing.assert_close(weighed, 0.5 * credit(honest, surface) * half)


def test_what_tells_nothing_is_sure_of_no_place() -> None:
    described, seen_by = wall(1)
    alone = compare(described, seen_by, NEAR, FAR)
    assert certain(alone, decide(alone)).shape == (0, 3)
