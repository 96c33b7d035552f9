"""Prune, split, resample: the same field before and after, on any unit of length, and what is left when nothing is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from fieldfuse.errors import InputError
from fieldfuse.render.field import Field, density
from fieldfuse.render.rays import render_rays
from fieldfuse.training.losses import Rates
from fieldfuse.training.torch_engine import TorchEngine
from fieldfuse.volume.edit import erase_empty_blocks, split
from tests.stability.hard.errors import absolute, not_finite, refused
from tests.stability.hard.fields import aimed_rays, small_field
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
