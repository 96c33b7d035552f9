"""The plane sweep: against slow references, and on a wall whose place is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.matching import LARGE, SIDE, SMALL, difference, patch_descriptors, semi_global, smoothed_softmax, together
from fieldfuse.nerfusion.extras.plane_sweep import (
    PLANES,
    DepthDistribution,
    _table,
    cost_volume,
    measured,
    sweep_planes,
    to_probability,
)

WALL = 2.0


def textured(size: int = 128, seed: int = 0) -> torch.Tensor:
    """(3, size, size) smooth noise in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return F.interpolate(torch.rand((1, 3, size // 4, size // 4), generator=generator), (size, size), mode="bicubic")[0].clamp(0, 1)


def wall(count: int = 3, depth: float = WALL, scale: float = 1.0) -> tuple[list[torch.Tensor], Cameras]:
    """Descriptors of views of a textured wall across the first camera's axis, and the cameras, side by side."""
    texture, width, height, focal = textured(), 96, 72, 90.0
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = scale * np.array([0.0, 0.15, -0.2, 0.1])[:count]
    poses[:, 1, 3] = scale * np.array([0.0, 0.05, 0.05, -0.1])[:count]
    seen_by = Cameras.same_size(
        torch.tensor([[focal, focal, width / 2, height / 2]]).repeat(count, 1), torch.from_numpy(poses).float(), width, height
    )
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    images = []
    for view in range(count):
        x = (u - width / 2) / focal * depth + poses[view, 0, 3] / scale
        y = (v - height / 2) / focal * depth + poses[view, 1, 3] / scale
        images.append(F.grid_sample(texture[None], torch.stack([x, y], -1)[None].float() / 1.6, align_corners=False)[0])
    return list(patch_descriptors(torch.stack(images))), seen_by


def on_axis(depths: torch.Tensor) -> torch.Tensor:
    """(N, 3) points straight ahead of the first camera."""
    return torch.stack([torch.zeros_like(depths), torch.zeros_like(depths), depths], 1)


def slow_paths(cost: np.ndarray) -> np.ndarray:
    """Semi-global matching along four directions as its recurrence is written, one pixel and plane after the other."""
    planes, height, width = cost.shape
    total = np.zeros_like(cost)
    for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros_like(cost)
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                before = (y - dy, x - dx)
                inside = 0 <= before[0] < height and 0 <= before[1] < width
                for d in range(planes):
                    if not inside:
                        path[d, y, x] = cost[d, y, x]
                        continue
                    line = path[:, before[0], before[1]]
                    ways = [line[d], line.min() + LARGE]
                    ways += [line[d + k] + SMALL for k in (-1, 1) if 0 <= d + k < planes]
                    path[d, y, x] = cost[d, y, x] + min(ways) - line.min()
        total += path
    return total / 4


def test_semi_global_matching_against_its_recurrence() -> None:
    cost = np.random.default_rng(0).random((7, 5, 6))
    found = semi_global(torch.from_numpy(cost))
    np.testing.assert_allclose(found.numpy(), slow_paths(cost), atol=1e-12)
    likely = smoothed_softmax(torch.from_numpy(cost))
    torch.testing.assert_close(likely.sum(0), torch.ones_like(likely[0]))


def test_what_a_voxel_reads_against_the_expectation_itself() -> None:
    generator = torch.Generator().manual_seed(0)
    planes, low, step = 60, 0.2, 0.02
    likely = torch.softmax(3 * torch.randn((planes, 1, 1), generator=generator), 0)
    one = Cameras.same_size(torch.tensor([[10.0, 10.0, 4.0, 3.0]]), torch.eye(4)[None], 8, 6)
    made = DepthDistribution(one, _table(likely, step), low, step)
    depth = torch.tensor([0.9, 1.1, 1.5, 2.5, 4.0])
    truncation = 0.25 * depth
    found = made.look(on_axis(depth), truncation)
    # The surface lies anywhere about its plane.
    spread = torch.linspace(-0.5, 0.5, 201)[1:-1]
    surface = (low + (torch.arange(planes)[:, None] + spread) * step).view(-1)
    weight = (likely.view(-1, 1) / len(spread)).expand(planes, len(spread)).reshape(-1)
    for k in range(len(depth)):
        half = truncation[k] / depth[k] ** 2
        expected = (weight * ((1 / depth[k] - surface) / half).clamp(-1, 1)).sum()
        assert float(found.expected_sdf[k]) == pytest.approx(float(expected), abs=0.01)
        assert float(found.visibility[k]) == pytest.approx(float(weight[surface < 1 / depth[k] + half].sum()), abs=0.02)


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_wall_is_found_where_it_is(count: int, scale: float) -> None:
    descriptors, seen_by = wall(count, scale=scale)
    made = sweep_planes(descriptors, seen_by, 0.7 * scale, 8.0 * scale)
    assert PLANES[0] <= made.table.shape[1] <= PLANES[1]
    likely = -torch.diff(made.table[0], dim=0)
    inverse = made.lowest + (likely.argmax(0) + 0.5) * made.step
    error = (inverse - 1 / (WALL * scale)).abs() / made.step  # planes; likelihoods between planes are told to half of one
    assert float(error.median()) < 1 and float((error < 1.6).float().mean()) > 0.9
    before, there, behind = 1.7 * scale, WALL * scale, 2.4 * scale
    read = made.look(on_axis(torch.tensor([before, there, behind])), torch.full((3,), 0.15 * scale))
    assert float(read.expected_sdf[0]) > 0.9 and abs(float(read.expected_sdf[1])) < 0.4 and float(read.expected_sdf[2]) < -0.9
    assert float(read.visibility[0]) > 0.95 and float(read.visibility[1]) > 0.8 and float(read.visibility[2]) < 0.1
    assert float(read.confidence.min()) > 0.5


def test_the_order_of_the_other_views_does_not_matter() -> None:
    descriptors, seen_by = wall(4)
    order = [0, 3, 1, 2]
    one = sweep_planes(descriptors, seen_by, 0.7, 8.0)
    two = sweep_planes([descriptors[k] for k in order], seen_by[order], 0.7, 8.0)
    torch.testing.assert_close(one.table, two.table, atol=1e-5, rtol=1e-4)


def test_a_range_of_nothing_is_refused() -> None:
    descriptors, seen_by = wall(3)
    assert bool(torch.isfinite(sweep_planes(descriptors, seen_by, 0.5, math.inf).table).all())
    with pytest.raises(ValueError, match="nearest or a farthest"):
        sweep_planes(descriptors, seen_by, 0.0, math.inf)
    for near, far in ((1.0, 1.0), (2.0, 1.0)):
        with pytest.raises(ValueError, match="looks at nothing"):
            sweep_planes(descriptors, seen_by, near, far)


def test_descriptors_forgive_exposure_and_are_small() -> None:
    images = torch.stack([textured(300)[:, :200], textured(300)[:, :200] * 0.6 + 0.1])
    descriptors = patch_descriptors(images)
    assert descriptors.shape == (2, 21, round(SIDE * 2 / 3), SIDE) and not descriptors.requires_grad
    flat = descriptors.flatten(2).transpose(1, 2)
    patches = flat[..., 3:]
    apart = (patches[0] - patches[1]).square().mean()
    other = (patches[0] - patches[0].roll(997, 0)).square().mean()
    assert float(apart) < 0.05 * float(other)
    assert float(difference(flat[0], flat[0]).max()) == 0


def test_costs_go_together_in_any_order_and_say_when_nobody_sees() -> None:
    costs, visible = torch.rand(3, 50), torch.rand(3, 50) < 0.6
    found = together(costs, visible)
    torch.testing.assert_close(found, together(costs[[2, 0, 1]], visible[[2, 0, 1]]))
    none = ~visible.any(0)
    assert bool(none.any()) and len(found[none].unique()) == 1
    everywhere = torch.ones_like(visible)
    torch.testing.assert_close(together(costs, everywhere), 0.5 * (costs.mean(0) + costs.min(0).values))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_measured_depth_is_where_the_surface_is(scale: float) -> None:
    """One view alone: pictures say nothing, the sensor tells two surfaces on the left, and on the right nothing."""
    descriptors, seen_by = wall(1, scale=scale)
    depth = torch.full((72, 96), torch.nan)
    depth[:, :24], depth[:, 24:48], depth[:36, 48:] = 1.5 * scale, 3.0 * scale, 0.0
    found, blind = (sweep_planes(descriptors, seen_by, 0.8 * scale, 5.0 * scale, given) for given in (depth, None))
    truncation = torch.full((3,), 0.2 * scale)
    for column, surface in ((12.0, 1.5), (36.0, 3.0)):
        z = surface * scale * torch.tensor([0.97, 1.0, 1.03])
        points = torch.stack([(column - 48) / 90 * z, torch.zeros(3), z], 1)
        told = found.look(points, truncation)
        assert torch.allclose(told.expected_sdf * 0.2, surface * torch.tensor([0.03, 0.0, -0.03]), atol=0.02 * surface), column
        assert float(told.confidence.min()) > 0.9
        beyond, before = found.look(points * 1.4, truncation), found.look(points * 0.7, truncation)
        assert float(beyond.visibility.max()) < 0.05 and float(before.visibility.min()) > 0.95
    unknown = torch.tensor([[0.25, 0.05, 1.0], [0.25, -0.05, 1.0], [0.6, 0.1, 2.0]]) * scale
    for one, other in zip(vars(found.look(unknown, truncation)).values(), vars(blind.look(unknown, truncation)).values(), strict=True):
        assert torch.allclose(one, other, atol=0.02)  # of another grid, else the same


def test_measured_depths_out_of_range_count_as_its_ends() -> None:
    descriptors, seen_by = wall(2)
    truncation = torch.full((1,), 0.1)
    far, near, junk = (sweep_planes(descriptors, seen_by, 1.0, 4.0, torch.full((72, 96), value)) for value in (1e4, 1e-4, -torch.inf))
    assert float(far.look(on_axis(torch.tensor([3.0])), truncation).visibility) > 0.95
    assert float(near.look(on_axis(torch.tensor([1.5])), truncation).visibility) < 0.05
    without = sweep_planes(descriptors, seen_by, 1.0, 4.0)
    places = on_axis(torch.linspace(1.0, 4.0, 31))
    assert torch.allclose(junk.look(places, truncation).expected_sdf, without.look(places, truncation).expected_sdf, atol=0.15)


def test_a_sensor_mends_what_pictures_do_not_tell() -> None:
    """Without texture the sweep finds no wall; the sensor does, and where both speak the wall stays where it is."""
    descriptors, seen_by = wall(3)
    flat = [torch.full_like(one, 0.0) for one in descriptors]
    depth, places = torch.full((72, 96), WALL), on_axis(torch.linspace(0.9, 3.5, 53))
    truncation = torch.full((53,), 0.15)
    wanted = ((WALL - places[:, 2]) / 0.15).clamp(-1, 1)

    def wrong(pictures: list[torch.Tensor], given: torch.Tensor | None) -> float:
        return float((sweep_planes(pictures, seen_by, 0.8, 4.0, given).look(places, truncation).expected_sdf - wanted).abs().mean())

    assert wrong(flat, depth) < 0.05 < 0.3 < wrong(flat, None)
    assert wrong(descriptors, depth) < 0.05


def test_a_silhouette_tells_where_no_surface_is() -> None:
    """Without texture, but with all empty that is not near the wall, it is found; what is ahead of an empty place is left as it was."""
    descriptors, seen_by = wall(3)
    flat = [torch.full_like(one, 0.0) for one in descriptors]
    places, truncation = on_axis(torch.linspace(0.9, 3.5, 53)), torch.full((53,), 0.15)
    wanted = ((WALL - places[:, 2]) / 0.15).clamp(-1, 1)

    def thin(points: torch.Tensor) -> torch.Tensor:
        return (points[:, 2] - WALL).abs() > 0.1

    found = sweep_planes(flat, seen_by, 0.8, 4.0, empty=thin).look(places, truncation)
    assert float((found.expected_sdf - wanted).abs().mean()) < 0.1
    plain = sweep_planes(descriptors, seen_by, 0.8, 4.0)
    held = sweep_planes(descriptors, seen_by, 0.8, 4.0, empty=lambda points: points[:, 2] < 1.0)  # nothing was likely there
    torch.testing.assert_close(held.look(places, truncation).expected_sdf, plain.look(places, truncation).expected_sdf, atol=0.02, rtol=0)
    nothing = sweep_planes(descriptors, seen_by, 0.8, 4.0, empty=lambda points: torch.ones(len(points), dtype=torch.bool))
    free = nothing.look(places[:45], truncation[:45])  # up to a truncation before the farthest plane
    assert float(free.expected_sdf.min()) > 0.99 and float(free.visibility.min()) > 0.99


def slab(left: float, right: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """All is empty but a part of the wall, between two places across."""

    def empty(points: torch.Tensor) -> torch.Tensor:
        return ((points[:, 2] - WALL).abs() > 0.3) | (points[:, 0] < left) | (points[:, 0] > right)

    return empty


def test_only_what_silhouettes_leave_is_compared() -> None:
    """The table covers the part of the picture about it, and says of all places what a table of the whole picture says."""
    descriptors, seen_by = wall(3)
    part, all_of_it = (cost_volume(descriptors, seen_by, 0.8, 4.0, slab(*edges)) for edges in ((0.1, 0.4), (-9.0, 9.0)))
    assert all_of_it.window == (0.0, 0.0, 1.0, 1.0) and all_of_it.cost.shape[1:] == (72, 96)
    left, upper, right, lower = part.window
    assert (upper, lower) == (0.0, 1.0) and part.cost.shape[1:] == (72, round((right - left) * 96))
    nearest, farthest = 0.5 + 0.4 * 90 / 96 / (WALL - 0.3), 0.5 + 0.1 * 90 / 96 / (WALL + 0.3)
    assert abs(right - nearest) < 2.5 / 96 and abs(left - farthest) < 2.5 / 96  # a cell of margin on each side
    assert part.empty is not None and bool(part.empty[:, :, [0, -1]].all())
    points = torch.rand((4000, 3), generator=torch.Generator().manual_seed(0))
    points, truncation = points * torch.tensor([2.4, 1.8, 3.0]) - torch.tensor([1.2, 0.9, -0.9]), torch.full((4000,), 0.1)
    nothing = slab(0.1, 0.4)((all_of_it.rays[:, None] / all_of_it.inverses[:, None]).view(-1, 3))
    whole = replace(all_of_it, empty=nothing.view(72, 96, -1).permute(2, 0, 1))
    one, other = to_probability(part).look(points, truncation), to_probability(whole).look(points, truncation)
    apart = (one.expected_sdf - other.expected_sdf).abs()
    assert float((apart < 0.02).float().mean()) > 0.98  # pixels beside the window are matched in one, and left out in the other
    assert float((one.visibility - other.visibility).abs().mean()) < 0.01


@pytest.mark.parametrize("window", [(0.25, 0.5, 0.75, 1.0), (0.0, 0.0, 1.0, 1.0)])
def test_a_measured_depth_is_cut_as_the_window_is(window: tuple[float, float, float, float]) -> None:
    depth = 1 + torch.arange(96.0)[None] / 96 + torch.arange(72.0)[:, None] / 36
    inverses, (left, upper, right, lower) = torch.linspace(0.2, 1, 200), window
    shape = round(72 * (lower - upper)), round(96 * (right - left))
    spans = [(72 * upper, 72 * (lower - upper)), (96 * left, 96 * (right - left))]
    found = measured(torch.full((200, *shape), 1 / 200), inverses, depth, shape, spans)
    told = 1 / inverses[found.argmax(0)]
    wanted = depth[round(72 * upper) : round(72 * lower), round(96 * left) : round(96 * right)]
    assert found.shape[1:] == shape and float((told / wanted - 1).abs().max()) < 0.02
