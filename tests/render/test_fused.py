"""From latent volumes to fields: units of density, pruning, saving, and a small volume that learns from its pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from fieldfuse.camera import pixel_grid, rays
from fieldfuse.nerfusion.cameras import Cameras, all_blocks
from fieldfuse.nerfusion.extras.plane_sweep import sweep_planes
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.unproject import KeyFrame
from fieldfuse.render.field import Field
from fieldfuse.render.fused import make_field, without_empty_blocks
from fieldfuse.render.rays import render_rays, render_with_gradients
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import HEIGHT, INTRINSICS, WIDTH, lattice, small_model, wall_pictures


def full_volume(model: NerfusionModel, shell: float = 0.0, resolution: int = 32) -> LatentVolume:
    """Every corner of the space known, with one and the same latent."""
    where = Lattice(Space((0.1, 0.2, -0.1), 0.8, shell), resolution)
    topology = Topology(all_blocks(where))
    rows = torch.zeros((topology.zero_row + 1, model.config.channels))
    rows[:-1] = torch.linspace(-0.5, 0.5, model.config.channels)
    return LatentVolume(where, topology, rows, torch.ones(topology.zero_row))


@pytest.mark.parametrize("shell", [0.0, 1.0])
@pytest.mark.parametrize("resolution", [16, 32])
def test_thickness_is_counted_per_voxel(shell: float, resolution: int) -> None:
    """A ray through n voxels of thickness τ along an axis leaves exp(−n·τ), whatever the resolution."""
    model = small_model().eval()
    volume = full_volume(model, shell, resolution)
    with torch.no_grad():
        thickness = float(torch.exp(model.thickness(volume)[0]))
        field = make_field(model, volume, torch.zeros(3))
        # From the middle to the lattice's face: half of its voxels.
        origin = torch.tensor([[0.13, 0.21, -0.1]])
        seen = render_rays(field, origin, torch.tensor([[0.0, 0.0, 1.0]]), threshold=0.0)
    # The last voxel of a shell reaches to infinity and is not gone through to its end.
    most, least = resolution / 2 + 0.2, resolution / 2 - (1.2 if shell else 0.2)
    assert 1 - math.exp(-least * thickness) < float(seen.opacity) < 1 - math.exp(-most * thickness)


def test_a_field_of_a_volume_can_be_saved_and_read(tmp_path: Path) -> None:
    model = small_model().eval()
    with torch.no_grad():
        field = without_empty_blocks(make_field(model, full_volume(model, 1.0), torch.tensor([0.1, 0.2, 0.3]), near=0.2))
    field.save(tmp_path / "field.safetensors")
    again = Field.load(tmp_path / "field.safetensors")
    origins, directions = torch.zeros(50, 3), torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    one, two = render_rays(field, origins, directions), render_rays(again, origins, directions)
    torch.testing.assert_close(one.colour, two.colour, atol=5e-3, rtol=0)


def test_pruning_removes_see_through_cells_and_what_is_not_allowed() -> None:
    model = small_model().eval()
    volume = full_volume(model)
    volume.rows[: len(volume.rows) // 2] *= -1
    with torch.no_grad():
        thickness = model.thickness(volume)
        middle = float(torch.exp(torch.tensor([thickness[0], thickness[-2]]).mean()))
        whole = make_field(model, volume, torch.zeros(3))
        pruned = make_field(model, volume, torch.zeros(3), gamma=math.exp(-middle))
        allowed = torch.rand(len(volume.count)) < 0.5
        part = make_field(model, volume, torch.zeros(3), allowed=allowed)
    assert 0 < pruned.voxels < whole.voxels
    assert torch.equal(part.occupied, whole.occupied & allowed)
    smaller = without_empty_blocks(pruned)
    assert smaller.voxels == pruned.voxels and smaller.blocks < pruned.blocks


def wall_rays(images: torch.Tensor, world: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """All pixels: origins, directions, cosines, colours."""
    parts = [rays(INTRINSICS, pose, pixel_grid(WIDTH, HEIGHT)) for pose in world]
    origins, directions, cosine = (torch.cat([part[k] for part in parts]) for k in range(3))
    return origins, directions, cosine, images.permute(0, 2, 3, 1).reshape(-1, 3)


@cache
def learnt(misled: float = 0.0) -> tuple[list[float], list[float], float]:
    """A wall seen by three cameras, 60 steps from pictures alone: losses and relative depth errors of the steps; the colours' variance.

    `misled`: what the plane sweep is wrong by, in inverse depth.
    """
    torch.manual_seed(0)
    model = small_model(1)
    depth = 2.1
    images, world = wall_pictures(3, depth)
    seen_by = Cameras.of([INTRINSICS] * 3, world)
    where = replace(lattice(24), space=Space((0.0, 0.0, 0.0), 0.6, 0.0))
    origins, directions, cosine, colour = wall_rays(images, world)
    # Only rays that the volume holds from front to back have an answer.
    ahead = origins + directions * (depth / cosine)[:, None]
    held = (ahead[:, :2].abs() < 0.45).all(1)
    origins, directions, cosine, colour = origins[held], directions[held], cosine[held], colour[held]
    optimiser = torch.optim.Adam(model.parameters(), lr=5e-3)
    generator = torch.Generator().manual_seed(2)
    losses, errors = [], []
    for _ in range(60):
        pick = torch.randint(len(origins), (256,), generator=generator)
        views = model.encode(images, seen_by)
        distribution = sweep_planes([view.descriptors for view in views], seen_by, 1.0, 2.8)
        distribution = replace(distribution, lowest=distribution.lowest + misled)
        local = model.local_volume(KeyFrame(views, seen_by, 1.0, 2.8, distribution), where)
        field = make_field(model, local, torch.full((3,), 0.5))
        jitter, behind = torch.rand(256, generator=generator), torch.rand((256, 3), generator=generator)
        seen = render_with_gradients(field, origins[pick], directions[pick], jitter, behind)
        loss = (seen.colour - colour[pick]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
        errors.append(float(((seen.distance.detach() * cosine[pick]) / depth - 1).abs().median()))
    return losses, errors, float(colour.var(0).mean())


def test_a_small_volume_learns_from_its_pictures() -> None:
    """Four starts left 6 to 10% of the first loss, and 2 to 3% of the colours' variance."""
    losses, _, variance = learnt()
    first, last = np.mean(losses[:5]), np.mean(losses[-5:])
    assert last < 0.2 * first, f"the loss fell from {first:.4f} to {last:.4f} only"
    assert last < 0.05 * variance, f"{last / variance:.1%} of what the colours vary is not told"


def test_what_is_rendered_moves_to_where_the_wall_is() -> None:
    """A sweep that sees the wall 6% too near is corrected by colours alone, as far as the bounds on what is learned let them: to 3.7%, and
    to under 3.5% without bounds. A voxel is 2.4% of the wall's depth."""
    _, errors, _ = learnt(0.03)
    first, last = np.mean(errors[:5]), np.mean(errors[-5:])
    assert 0.045 < first < 0.075, f"the start was meant to be 6% off, not {first:.1%}"
    assert last < 0.7 * first, f"colours alone moved the wall from {first:.1%} to {last:.1%}"


def test_what_the_sweep_found_is_kept() -> None:
    _, errors, _ = learnt()
    first, last = np.mean(errors[:5]), np.mean(errors[-5:])
    assert first < 0.012, f"at the start the wall is {first:.1%} off, more than half a voxel"
    assert last < 0.024, f"the wall is {last:.1%} off, more than a voxel"
