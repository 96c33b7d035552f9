"""Projection into views against the toolkit's own camera, visibility, culling, and that nothing depends on scale."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import project as project_one
from fieldfuse.nerfusion.cameras import Cameras, all_blocks, frustum
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.nerfusion.unproject import KeyFrame, look_up, project
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import HEIGHT, INTRINSICS, WIDTH, cameras, lattice, pictures, small_model


def random_pose(generator: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = q * np.sign(np.linalg.det(q))
    pose[:3, 3] = generator.normal(size=3)
    return pose


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_against_the_camera(seed: int) -> None:
    generator = np.random.default_rng(seed)
    world = np.stack([random_pose(generator) for _ in range(3)])
    points = generator.normal(size=(50, 3)) * 2
    near, far = 0.3, 2.5
    seen = project(torch.from_numpy(points).float(), torch.full((50,), 0.1), Cameras.of([INTRINSICS] * 3, world), near, far)
    for view in range(3):
        pixels, depth = project_one(INTRINSICS, world[view], points)
        # A view tells of what is a voxel beside its picture.
        voxel = (0.1 * INTRINSICS.fx / np.where(depth > near, depth, 1.0))[:, None]  # pixels
        past = pixels - np.array([WIDTH, HEIGHT])
        inside = (depth > near) & (depth <= far) & np.all((pixels >= -voxel) & (past <= voxel), axis=1)
        assert np.array_equal(seen.visible[view].numpy(), inside)
        np.testing.assert_allclose(seen.pixels[view].numpy()[inside], pixels[inside], atol=2e-3)
        np.testing.assert_allclose(seen.footprint[view].numpy()[inside], 0.1 * INTRINSICS.fx / depth[inside], rtol=1e-4)
    assert bool(torch.isfinite(seen.pixels).all())


def test_directions_point_at_what_a_pixel_shows() -> None:
    world = np.stack([random_pose(np.random.default_rng(3))])
    pixels = torch.tensor([[3.5, 7.5], [40.0, 20.0]])
    directions = Cameras.of([INTRINSICS], world).directions(0, pixels)
    found, depth = project_one(INTRINSICS, world[0], world[0, :3, 3] + 2.5 * directions.double().numpy())
    np.testing.assert_allclose(found, pixels.numpy(), atol=1e-3)
    assert np.all(depth > 0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 1.0]), st.sampled_from([2.0, math.inf]))
def test_culling_never_loses_a_voxel(seed: int, shell: float, far: float) -> None:
    generator = np.random.default_rng(seed)
    seen_by = Cameras.of([INTRINSICS], random_pose(generator)[None])
    place = replace(lattice(32, shell), space=Space((0.1, -0.2, 0.3), 0.9, shell))
    topology = Topology(all_blocks(place))
    kept = frustum(place, seen_by, 0.2, far).slots_of(topology) >= 0
    points, size = place.working(place.contracted(topology.keys, torch.arange(topology.zero_row)))
    seen = project(points, size, seen_by, 0.2, far).visible.any(0).view(-1, 512).any(1)
    assert not bool((seen & ~kept).any()), "a block with a visible corner was culled"
    assert int(kept.sum()) < topology.blocks or bool(seen.all())


def test_voxels_outside_the_region_are_as_large_as_they_look() -> None:
    place = lattice(64, 1.0)
    contracted = torch.tensor([[0.2, 0.1, -0.3], [1.6, 0.4, -0.2], [-1.2, 1.9, 0.3]])
    points, size = place.working(contracted)
    assert float(size[0]) == pytest.approx(place.voxel_size)
    for row in (1, 2):
        # A step across the radial direction, as long as a voxel.
        across = contracted[row].roll(1) * (contracted[row].abs() < contracted[row].abs().max())
        axis = int((contracted[row].abs() + 10 * (contracted[row].abs() == contracted[row].abs().max())).argmin())
        across = torch.zeros(3).index_fill(0, torch.tensor([axis]), 1e-3)
        moved, _ = place.working((contracted[row] + across)[None])
        step = float((moved[0] - points[row]).norm()) / 1e-3 * place.voxel
        assert float(size[row]) == pytest.approx(step, rel=0.02)


def test_nothing_depends_on_the_unit_of_length() -> None:
    model = small_model().eval()
    seen_by = cameras()
    views = model.encode(pictures(), seen_by)
    small = model.local_volume(KeyFrame(views, seen_by, 0.5, 2.4), lattice())
    pose = seen_by.world_from_camera.clone()
    pose[:, :3, 3] *= 16
    large_by = replace(seen_by, world_from_camera=pose)
    large_lattice = Lattice(Space((0.0, 0.0, 0.0), 0.8 * 16, 0.0), 32)
    large = model.local_volume(KeyFrame(model.encode(pictures(), large_by), large_by, 8.0, 2.4 * 16), large_lattice)
    assert torch.equal(small.count, large.count) and float(small.count.max()) == 3
    torch.testing.assert_close(small.rows, large.rows, atol=1e-4, rtol=1e-3)


def test_what_views_show_is_the_same_with_gradients_and_without() -> None:
    world = np.stack([random_pose(np.random.default_rng(seed)) for seed in range(3)])
    seen_by = Cameras.of([INTRINSICS] * 3, world)
    with torch.no_grad():
        views = small_model().eval().encode(pictures(3), seen_by)
    points = torch.randn((300, 3), generator=torch.Generator().manual_seed(0)) * 2
    projection, step = project(points, torch.full((300,), 0.1), seen_by, 0.3, 2.5), torch.linspace(0.1, 9.0, 300)
    assert 0 < float(projection.visible.float().mean()) < 1
    quick = look_up(views, projection, step)
    asked = [replace(view, features=replace(view.features, rows=view.features.rows.requires_grad_())) for view in views]
    slow = look_up(asked, projection, step)
    assert slow.requires_grad and not quick.requires_grad
    torch.testing.assert_close(quick, slow.detach(), atol=1e-5, rtol=1e-5)


def test_fewer_digits_move_no_pixel() -> None:
    seen_by = cameras(3)
    points = torch.randn((500, 3), generator=torch.Generator().manual_seed(1))
    pixels = torch.rand((50, 2)) * torch.tensor([WIDTH, HEIGHT])
    exact = project(points, torch.full((500,), 0.1), seen_by, 0.3, 2.5), seen_by.directions(1, pixels)
    with torch.autocast("cpu", torch.bfloat16):
        low = project(points, torch.full((500,), 0.1), seen_by, 0.3, 2.5), seen_by.directions(1, pixels)
    assert torch.equal(low[0].pixels, exact[0].pixels) and torch.equal(low[0].visible, exact[0].visible)
    assert torch.equal(low[1], exact[1])
