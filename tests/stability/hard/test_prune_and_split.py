"""Prune, split, resample: the same field before and after, on any unit of length, and what is left when nothing is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fieldfuse.errors import InputError
from fieldfuse.render.field import Field, density
from fieldfuse.render.rays import render_rays
from fieldfuse.training.losses import Rates
from fieldfuse.training.torch_engine import TorchEngine
from fieldfuse.volume.edit import corner_nodes, erase_empty_blocks, resample, split, with_corner_blocks
from fieldfuse.volume.lookup import corners, gather
from fieldfuse.volume.topology import VOXELS, Topology
from tests.stability.hard.errors import absolute, by_size, not_finite, refused
from tests.stability.hard.fields import aimed_rays, lattice, scattered_blocks, small_field
from tests.stability.hard.ranges import FEW
from tests.stability.hard.within import Within

GROUP = "prune and split"


def test_pictures_agree(within: Within) -> None:
    """Pictures before and after a split and a clean-up.

    With twice as many samples a brick before the split as after it, both march through the same places, but in a ray's last step.
    """
    field = replace(small_field(2), fine=16)
    origins, directions = aimed_rays(300, 3)
    before = render_rays(field, origins, directions)
    settled = render_rays(field.packed()(), origins, directions)
    topology, occupied, (raw, features) = split(field.topology, field.occupied, [field.density_rows, field.feature_rows])
    finer = Field(field.space, 64, topology, occupied, raw, features, field.decoder, field.background, field.near, field.fine // 2)
    after = render_rays(finer, origins, directions)
    within("colour after dropping empty blocks", absolute(settled.colour, before.colour), 1e-6)
    within("colour after a split, mean", float((after.colour - before.colour).abs().mean()), 1e-3)
    within("opacity after a split, mean", float((after.opacity - before.opacity).abs().mean()), 1e-3)
    within("values that are not finite", not_finite(after.colour, after.distance, after.opacity), 0.0)


def test_nothing_left(within: Within, tmp_path: Path) -> None:
    """Nothing left: pruned to the last voxel, split, saved, read, rendered."""
    field = small_field(1)
    none = torch.zeros_like(field.occupied)
    topology, occupied, rows = erase_empty_blocks(field.topology, none, [field.density_rows, field.feature_rows])
    finer, _, finer_rows = split(topology, occupied, rows)
    empty = Field(field.space, 32, topology, occupied, rows[0], rows[1], field.decoder, field.background)
    origins, directions = aimed_rays(10)
    seen = render_rays(empty, origins, directions)
    path = tmp_path / "field.safetensors"
    empty.save(path)
    again = render_rays(Field.load(path), origins, directions)
    within("blocks left", float(topology.blocks + finer.blocks), 0.0)
    within("rows left besides the zero row", float(sum(len(values) - 1 for values in (*rows, *finer_rows))), 0.0)
    within("colour that is not the background", absolute(seen.colour, field.background.expand(10, 3)), 0.0)
    within("colour after saving and reading", absolute(again.colour, seen.colour), 1e-6)
    within("opacity", float(seen.opacity.abs().max() + again.opacity.abs().max()), 0.0)
    within("a damaged file is taken", refused(lambda: _damaged(path), InputError), 0.0)


def _damaged(path: Path) -> Field:
    path.write_bytes(path.read_bytes()[:-8])
    return Field.load(path)


def test_extreme_file(within: Within, tmp_path: Path) -> None:
    """Densities at the clamp through a file and back."""
    field = small_field(4)
    field.density_rows[:-1] = torch.where(torch.rand(len(field.density_rows) - 1) < 0.5, 80.0, -80.0)
    field.feature_rows[:-1] *= 1e5  # float16 ends at 65504
    field.save(tmp_path / "field.safetensors")
    again = Field.load(tmp_path / "field.safetensors")
    origins, directions = aimed_rays(200, 1)
    before, after = render_rays(field, origins, directions), render_rays(again, origins, directions)
    within("opacity", absolute(after.opacity, before.opacity), 1e-6)
    within("colour", absolute(after.colour, before.colour), 5e-3)
    within("values that are not finite", not_finite(before.colour, after.colour, density(again.density_rows)), 0.0)


def test_optimiser_state(within: Within) -> None:
    """The optimiser's state survives pruning, and starts afresh at a split."""
    from fieldfuse.training.levels import finer, pruned
    from fieldfuse.training.pixels import Batch, PixelPool
    from fieldfuse.volume.host import TorchHost
    from tests.training.gradients import made_views

    field = small_field(3, 0.4)
    origins, directions = aimed_rays(200, 2)
    batch = Batch(origins, directions, torch.rand(200, 3), torch.zeros(200, dtype=torch.int64))
    rates, generator = Rates(0.05, 0.02, 1e-3, 0.01), torch.Generator().manual_seed(0)
    copied = replace(field, density_rows=field.density_rows.clone(), feature_rows=field.feature_rows.clone())
    optimiser = TorchEngine(copied, PixelPool(made_views()))
    for _ in range(3):
        optimiser.step_on(batch, rates, torch.rand(200, generator=generator))
    before = [optimiser.density.state.clone(), optimiser.feature.state.clone(), optimiser.field.density_rows.clone()]
    keep = torch.rand(len(field.occupied), generator=generator) < 0.5
    optimiser.go_on_with(pruned(optimiser.field, keep))
    after = [optimiser.density.state, optimiser.feature.state, optimiser.field.density_rows]
    lost = sum(absolute(new, old) for new, old in zip(after, before, strict=True))
    optimiser.step_on(batch, rates, torch.rand(200, generator=generator))
    grown = finer(optimiser.field, optimiser.field.occupied, 2 * field.resolution, TorchHost())
    optimiser.renew_rows(grown)
    fresh = float(optimiser.density.state.abs().sum() + optimiser.feature.state.abs().sum())
    optimiser.step_on(batch, rates, torch.rand(200, generator=generator))
    states = optimiser.decoder.state.values()
    decoder = [state[name] for state in states for name in ("exp_avg", "exp_avg_sq")]
    forgotten = min(int(state["step"]) for state in states) < 5 or not all(bool(value.any()) for value in decoder)
    within("rows' moments changed by pruning", lost, 0.0)
    within("rows' moments left at a split", fresh, 0.0)
    within("decoder's moments lost", float(forgotten), 0.0)
    within("values that are not finite", not_finite(*after, grown.density_rows, grown.feature_rows, *decoder), 0.0)


def sparse_volume(seed: int, blocks: int = 6, share: float = 0.1) -> tuple[Topology, Tensor, Tensor]:
    """Blocks with `share` of their voxels occupied, corners included, and (M · 512 + 1, 2) values at corners."""
    generator = torch.Generator().manual_seed(seed)
    topology = scattered_blocks(blocks, seed)
    topology, occupied = with_corner_blocks(topology, torch.rand(topology.zero_row, generator=generator) < share)
    values = torch.randn(topology.zero_row + 1, 2, generator=generator)
    values[:-1][~corner_nodes(topology, occupied)] = 0
    values[-1] = 0
    return topology, occupied, values


def read(topology: Topology, occupied: Tensor, values: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Values at (N, 3) lattice places (float64) and whether an occupied voxel holds them."""
    cell = place.floor().long()
    local = cell & 7
    slot = topology.find(cell >> 3)
    row = slot.clamp_min(0) * VOXELS + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
    held = (slot >= 0) & occupied[row]
    return gather(values, *corners(topology, row, (place - cell).float())), held


def split_errors(seed: int) -> dict[str, float]:
    """A split volume against the one before, at random places of it."""
    topology, occupied, values = sparse_volume(seed)
    finer, finer_occupied, (finer_values,) = split(topology, occupied, [values])
    cells = occupied.nonzero().squeeze(1)
    pick = cells[torch.randint(len(cells), (3000,), generator=torch.Generator().manual_seed(seed))]
    place = lattice(topology)[pick].double() + torch.rand(3000, 3, dtype=torch.float64) * 0.998 + 0.001
    before, _ = read(topology, occupied, values, place)
    after, held = read(finer, finer_occupied, finer_values, 2 * place)
    return {
        "value in occupied voxels": by_size(after, before),
        "occupied places lost": float((~held).sum()),
        "voxels that are not eight times as many": abs(float(finer_occupied.sum()) - 8 * float(occupied.sum())),
        "values that are not finite": not_finite(finer_values),
    }


def test_trilinear_split(within: Within) -> None:
    """A trilinear split leaves the field as it was."""
    errors = split_errors(3)
    for name, error in errors.items():
        within(name, error, 1e-6 if name.startswith("value in") else 0.0)


def test_resampled(within: Within) -> None:
    """Resampling to another voxel size and back to the same one."""
    topology, occupied, values = sparse_volume(7, share=1.0)
    (same,) = resample(topology, occupied, [values], topology.keys, 1.0)
    nodes = corner_nodes(topology, occupied)
    constant = torch.ones_like(values)
    within("same voxel size", absolute(same[:-1][nodes], values[:-1][nodes]), 0.0)
    for scale in (0.37, 0.5, 0.9, 1.7):
        keys = torch.unique((topology.keys.double() / scale).floor().long(), dim=0)
        (other,) = resample(topology, occupied, [constant], keys, scale)
        away = torch.minimum((other - 1).abs(), other.abs())  # a constant stays the constant, or zero where nothing is near
        within(f"a constant at {scale} of the voxel size", float(away.max()), 1e-6)
        within(f"not finite at {scale}", not_finite(other), 0.0)


@FEW
@given(st.integers(0, 10_000))
def test_splits(seed: int) -> None:
    errors = split_errors(seed)
    assert errors.pop("value in occupied voxels") < 1e-6
    assert not any(errors.values()), errors
