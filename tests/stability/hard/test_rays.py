"""Marching through a bounded lattice against brute force: every lattice plane that a ray crosses, sorted, in float64."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fieldfuse.render.march import MarchGrid, march
from fieldfuse.volume.topology import BLOCK, VOXELS
from tests.stability.hard import reference
from tests.stability.hard.errors import largest, not_finite
from tests.stability.hard.fields import lattice_grid, random_rays, unit
from tests.stability.hard.ranges import QUICK
from tests.stability.hard.within import Within

GROUP = "rays"
ROUNDING = 2e-3  # of a voxel: how far float32 may move a sample over a border
SPLIT = 1e-2  # of a step: how well the samples' intervals must tile what they cover
BOUNDS = {
    "samples where nothing is occupied": 0.0,
    "samples told to be in another voxel": 0.0,
    "gap or overlap between samples, in steps": SPLIT,
    "gap at the ends of what is occupied, in steps": 1.0 + SPLIT,
    "length in occupied voxels, in steps a piece": 1.0 + SPLIT,
    "values that are not finite": 0.0,
}


def march_errors(
    grid: MarchGrid, origins: Tensor, directions: Tensor, near: float = 0.0, fine: int = 4, jitter: Tensor | None = None
) -> dict[str, float]:
    """Samples along (B, 3) rays against the exact pieces of these rays that lie in occupied voxels (no contraction)."""
    half, voxel = grid.space.half, grid.voxel
    samples = march(grid, origins, directions, near, fine, jitter)
    slots = {tuple(key): slot for slot, key in enumerate(grid.topology.keys.tolist())}
    occupied = grid.occupied.tolist()
    step = voxel * (BLOCK // 2) / fine  # normalised units
    worst = dict.fromkeys(BOUNDS, 0.0)
    worst["values that are not finite"] = not_finite(samples.distance, samples.length, samples.inside)
    of_ray: dict[int, list[tuple[float, float, int]]] = {}
    for ray, distance, length, cell in zip(
        samples.ray.tolist(), samples.distance.double().tolist(), samples.length.double().tolist(), samples.cell.tolist(), strict=True
    ):
        of_ray.setdefault(ray, []).append((distance / half, length, cell))
    for ray, (o, d) in enumerate(zip(origins.double().tolist(), directions.double().tolist(), strict=True)):
        origin = (o[0] / half, o[1] / half, o[2] / half)
        pieces = []
        for start, stop, (x, y, z) in reference.crossings(origin, (d[0], d[1], d[2]), (-1.0, -1.0, -1.0), voxel, grid.resolution):
            row = slots[x >> 3, y >> 3, z >> 3] * VOXELS + ((z & 7) * BLOCK + (y & 7)) * BLOCK + (x & 7)
            if occupied[row] and stop > near / half:
                pieces.append((max(start, near / half), stop, row))
        speed = math.dist((0, 0, 0), d)
        _compare(worst, pieces, of_ray.get(ray, []), step, voxel, speed)
    return worst


def _compare(
    worst: dict[str, float],
    pieces: list[tuple[float, float, int]],
    samples: list[tuple[float, float, int]],
    step: float,
    voxel: float,
    speed: float,
) -> None:
    """One ray: its occupied pieces (in, out, row) and its samples (distance, length, row), all in normalised units."""
    slack = ROUNDING * voxel / speed
    joined: list[list[float]] = []
    for start, stop, _ in pieces:
        if joined and start - joined[-1][1] < slack:
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    for distance, _, cell in samples:
        near_by = [row for start, stop, row in pieces if start - slack <= distance <= stop + slack]
        worst["samples where nothing is occupied"] += not near_by
        worst["samples told to be in another voxel"] += bool(near_by) and cell not in near_by
    solid = [piece for piece in joined if piece[1] - piece[0] > 2 * slack]
    covered = sum(length for _, length, _ in samples) / speed
    exact = sum(stop - start for start, stop in joined)
    if joined:
        share = abs(covered - exact) * speed / (step * len(joined))
        worst["length in occupied voxels, in steps a piece"] = max(worst["length in occupied voxels, in steps a piece"], share)
    for start, stop in solid:
        inside = [(t, length) for t, length, _ in samples if start - slack <= t <= stop + slack]
        marks = [start] + [t for t, _ in inside] + [stop]
        ends = max(marks[1] - start, stop - marks[-2]) if inside else stop - start
        key = "gap at the ends of what is occupied, in steps"
        worst[key] = max(worst[key], ends * speed / step)
        for (t, length), (following, other) in pairwise(inside):
            key = "gap or overlap between samples, in steps"
            worst[key] = max(worst[key], abs((following - t) * speed - 0.5 * (length + other)) / step)


def full() -> MarchGrid:
    return lattice_grid(32, 1.0)


def parallel() -> tuple[Tensor, Tensor]:
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).repeat_interleave(4, 0)
    offset = torch.rand(24, 3, generator=torch.Generator().manual_seed(0)) * 1.8 - 0.9
    return -3 * axes + offset * (axes == 0), axes


def along_edges() -> tuple[Tensor, Tensor]:
    voxel = full().voxel
    pairs = [(0, 8), (3, -8), (0, 0)]
    rays = [(torch.tensor([j * voxel, k * voxel, k * voxel]) * (axis == 0) - 3 * axis, axis) for axis in torch.eye(3) for j, k in pairs]
    corners = [torch.tensor([x, y, z]) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (0.0, 1.0)]
    rays += [(-2 * corner, corner) for corner in corners]
    return torch.stack([origin for origin, _ in rays]), unit(torch.stack([direction for _, direction in rays]))


def from_inside() -> tuple[Tensor, Tensor]:
    """From inside, from faces, from corners."""
    starts = torch.tensor(
        [[0.0, 0, 0], [0.31, -0.2, 0.77], [1.0, 0.1, 0.2], [-1.0, 0.1, 0.2], [0.25, 0.25, -1.0], [1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]]
    )
    aims = unit(torch.randn(6, 3, generator=torch.Generator().manual_seed(3)))
    return starts.repeat_interleave(6, 0), aims.repeat(len(starts), 1)


def tiny_components() -> tuple[Tensor, Tensor]:
    tiny = [0.0, -0.0, 1e-45, -1e-38, 1e-20, -1e-12, 1e-9, 1.1e-9, 1e-6]
    directions = torch.tensor([[1.0, a, b] for a in tiny for b in tiny[::2]])
    return torch.tensor([[-2.0, 0.11, -0.37]]).repeat(len(directions), 1), unit(directions)


def grazing() -> tuple[Tensor, Tensor]:
    offsets = [1 - 1e-3, 1 - 1e-5, -1 + 1e-3, -1 + 1e-5, -1.0]
    origins = torch.tensor([[-3.0, offset, 0.2] for offset in offsets] + [[0.4, -3.0, offset] for offset in offsets])
    directions = torch.tensor([[1.0, 0, 0]] * len(offsets) + [[0, 1.0, 0]] * len(offsets))
    return torch.cat([origins, origins]), torch.cat([directions, unit(directions + torch.tensor([0.0, 0, 1e-4]))])


def scaled(half: float) -> dict[str, float]:
    origins, directions = random_rays(20, 11)
    return march_errors(lattice_grid(32, 0.7, 3, half), origins * half, directions)


CASES: dict[str, Callable[[], dict[str, float]]] = {
    "random, through half-empty blocks": lambda: march_errors(lattice_grid(32, 0.5, 1), *random_rays(60, 2), fine=8),
    "random, through full blocks": lambda: march_errors(lattice_grid(64, 1.0), *random_rays(60, 3)),
    "parallel to faces, both ways along each axis": lambda: march_errors(lattice_grid(32, 0.6, 6), *parallel()),
    "along edges of voxels and blocks, and through corners": lambda: march_errors(full(), *along_edges()),
    "starting inside, on a face, on a corner": lambda: march_errors(lattice_grid(32, 0.8, 2), *from_inside()),
    "zero, negative zero and tiny components": lambda: march_errors(lattice_grid(32, 0.6, 8), *tiny_components()),
    "grazing the outer faces": lambda: march_errors(full(), *grazing()),
    "tiny and huge extents": lambda: largest(scaled(half) for half in (1e-6, 1e-3, 1e3, 1e6)),
    "8³ to 256³ voxels": lambda: largest(march_errors(lattice_grid(n, 0.9, 4), *random_rays(8, n)) for n in (8, 16, 128, 256)),
}


@pytest.mark.parametrize("case", CASES)
def test_rays(case: str, within: Within) -> None:
    """Samples lie where rays pass."""
    within.each(CASES[case](), others=BOUNDS)


def test_jittered(within: Within) -> None:
    """Jittered lattices of steps.

    A ray's first step begins up to a whole step before the lattice: its first sample lies at most half a step outside.
    """
    grid = lattice_grid(32, 0.7, 5)
    origins, directions = random_rays(40, 4)
    samples = march(grid, origins, directions, jitter=torch.linspace(0, 0.999, 40))
    outside = (origins[samples.ray] + samples.distance[:, None] * directions[samples.ray]).abs().amax(1) - 1
    within("first sample before the lattice, in steps", float(outside.max()) / grid.voxel, 0.5)
    within.each(march_errors(grid, origins, directions, jitter=torch.linspace(0, 0.49, 40)), others=BOUNDS)


def test_missing(within: Within) -> None:
    """Pointing away, missing by a hair, no ray at all."""
    origins, directions = random_rays(50, 9)
    hair = torch.tensor([[-3.0, 1.0001, 0], [-3.0, 0, -1.0001], [1.0001, 3.0, 0.5]])
    ahead, none = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [0, -1.0, 0]]), torch.zeros((0, 3))
    for name, start, way in (("behind the start", origins, -directions), ("of rays that miss", hair, ahead), ("without rays", none, none)):
        within(f"samples {name}", float(len(march(full(), start, way))), 0.0)


def test_nearest(within: Within) -> None:
    """Nothing nearer than `near`."""
    origins, directions = random_rays(30, 6, away=0.5)
    samples = march(full(), origins, directions, 0.4)
    within("before it, in voxels", float((0.4 - samples.distance).clamp_min(0).max() / full().voxel), 0.5 + ROUNDING)
    within.each(march_errors(full(), origins, directions, 0.4), others=BOUNDS)


def test_far_away(within: Within) -> None:
    """From 1e2 to 1e5 half sizes away.

    float32 places the samples of a ray that starts 1e5 away only to 0.008: what is stopped in all must still be right.
    """
    for away, steps in ((1e2, 1.0), (1e3, 1.0), (1e5, 2.0)):
        grid = full()
        origins, directions = random_rays(40, 5, away, 0.3)
        samples = march(grid, origins, directions)
        covered = torch.zeros(40, dtype=torch.float64).index_add_(0, samples.ray, samples.length.double())
        exact = [
            sum(b - a for a, b, _ in reference.crossings(tuple(o), tuple(d), (-1.0, -1.0, -1.0), grid.voxel, 32)) * math.dist((0, 0, 0), d)
            for o, d in zip(origins.double().tolist(), directions.double().tolist(), strict=True)
        ]
        worst = (covered - torch.tensor(exact, dtype=torch.float64)).abs().max() / grid.voxel
        within(f"length from {away:g} away, in steps", float(worst), steps + SPLIT)
        within(f"not finite from {away:g} away", not_finite(samples.distance, samples.length, samples.inside), 0.0)


@QUICK
@given(st.sampled_from([8, 16, 32]), st.floats(0, 1), st.integers(0, 1000), st.floats(0.2, 30), st.floats(-6, 6), st.integers(1, 8))
def test_marching(resolution: int, share: float, seed: int, away: float, power: float, fine: int) -> None:
    half = 10.0**power
    origins, directions = random_rays(6, seed, away)
    errors = march_errors(lattice_grid(resolution, share, seed, half), origins * half, directions, fine=fine)
    for name, bound in BOUNDS.items():
        assert errors[name] <= bound, (name, errors[name])
