"""Networks, continued: voxels seen by awkward views, gradients under lower precision, state that survives pruning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from fieldfuse.evaluation.selftest.case import Measure, absolute, by_size, case, not_finite, relative
from fieldfuse.evaluation.selftest.edit import aimed_rays, small_field
from fieldfuse.evaluation.selftest.lookup import scattered_blocks
from fieldfuse.evaluation.selftest.network import GROUP
from fieldfuse.nerfusion.aggregate import aggregate, evidence
from fieldfuse.nerfusion.block_conv import block_conv3d
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.nerfusion.unproject import MARGIN, project
from fieldfuse.training.step import Optimiser, Rates

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
SIDE = 0.05  # of a voxel
LOW = 16  # roundings of the lower precision that a gradient through a few layers may carry
TURNS = 8  # times that, behind the sines and cosines of the paper's decoder


def awkward_views() -> dict[str, Tensor]:
    """(4, 4) poses, each looking along +z at the origin unless it is told otherwise."""
    ahead = torch.eye(4)
    ahead[2, 3] = -3
    behind = torch.eye(4)
    behind[2, 3] = 3
    infinity = torch.eye(4)
    infinity[2, 3] = -1e5
    inside = torch.eye(4)
    beside = torch.eye(4)
    beside[0, 3], beside[2, 3] = 1e5, -3
    return {"ahead": ahead, "ahead again": ahead.clone(), "behind": behind, "at infinity": infinity, "inside": inside, "beside": beside}


@case(GROUP, "views at infinity, behind, inside, identical, at the border of the picture")
def seen_by_views(folder: Path) -> list[Measure]:
    poses = awkward_views()
    count = len(poses)
    cameras = Cameras.same_size(
        torch.tensor([[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]]).repeat(count, 1), torch.stack([*poses.values()]), WIDTH, HEIGHT
    )
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(400, 3, generator=generator) * 2 - 1
    across, down = 3 * 32 / FOCAL + MARGIN * SIDE, 3 * 24 / FOCAL + MARGIN * SIDE
    edge = torch.tensor([[across, 0, 0], [-across, 0, 0], [0, down, 0], [0, -down, 0]])  # on the border of what counts as seen from ahead
    points = torch.cat([points, edge, edge * 1.0001, torch.zeros(1, 3)])
    found = project(points, torch.full((len(points),), SIDE), cameras, 0.1, 10.0)
    wrong, worst = 0, 0.0
    for index, pose in enumerate(poses.values()):
        local = points.double() - pose[:3, 3].double()
        depth = local[:, 2]
        pixels = local[:, :2] / depth[:, None] * FOCAL + torch.tensor([WIDTH / 2, HEIGHT / 2])
        beside = MARGIN * SIDE * FOCAL / depth.clamp_min(0.1)  # cells that reach over the border count as seen
        margin = torch.minimum(pixels, torch.tensor([WIDTH, HEIGHT]) - pixels).amin(1) + beside
        seen = (depth > 0.1) & (depth <= 10) & (margin >= 0)
        sure = (margin.abs() > 1e-3) & ((depth - 0.1).abs() > 1e-6)
        wrong += int((found.visible[index] != seen)[sure].sum())
        both = seen & found.visible[index]
        worst = max(worst, relative(found.pixels[index][both], pixels[both], 1.0))
    values = torch.randn(count, len(points), 4, generator=generator).requires_grad_(True)
    mean, variance, views = aggregate(values, found.visible)
    read = evidence(mean, variance, views, torch.full((len(points),), 3.0), torch.zeros(len(points)))
    (mean.sum() + variance.sum()).backward()
    assert values.grad is not None
    return [
        Measure("voxels seen by the wrong views", float(wrong), 0.0),
        Measure("pixels, relative", worst, 4e-6),
        Measure("seen from infinity, from behind or from beside", float(found.visible[[2, 3, 5]].sum()), 0.0),
        Measure("identical views that differ", absolute(found.pixels[0], found.pixels[1]), 0.0),
        Measure("negative variances", float((variance < 0).sum()), 0.0),
        Measure("gradients of what no view sees", float(values.grad[~found.visible].abs().sum()), 0.0),
        Measure("values that are not finite", not_finite(found.pixels, found.footprint, mean, variance, read, values.grad), 0.0),
    ]


@case(GROUP, "gradients under bfloat16 and float16 autocast against float64")
def reduced_gradients(folder: Path) -> list[Measure]:
    out = []
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    features = torch.randn(200, 8)
    topology = scattered_blocks(6, 1, 1)
    rows, weight = torch.randn(topology.zero_row, 4), torch.randn(4, 4, 3, 3, 3) * 0.1
    pull = torch.randn(topology.zero_row, 4)
    views, visible = torch.randn(3, 100, 4), torch.rand(3, 100) < 0.7
    visible[0] |= ~visible.any(0)
    for kind in (torch.bfloat16, torch.float16):
        name, bound = str(kind).removeprefix("torch."), LOW * float(torch.finfo(kind).eps)
        for decoder in ("deferred", "per_sample"):
            torch.manual_seed(1)
            net = make_decoder(decoder, 8, 32)
            double = make_decoder(decoder, 8, 32).double()
            double.load_state_dict({key: value.double() for key, value in net.state_dict().items()})
            low, exact = features.clone().requires_grad_(True), features.double().requires_grad_(True)
            with torch.autocast("cpu", dtype=kind):
                got = net(low, directions)
            want = double(exact, directions.double())
            (got if decoder == "deferred" else got[1]).float().sum().backward()
            (want if decoder == "deferred" else want[1]).sum().backward()
            assert low.grad is not None and exact.grad is not None
            steep = 1 if decoder == "deferred" else TURNS  # the paper's encoding multiplies what is rounded by up to 16 π
            out.append(Measure(f"decoder {decoder}, {name}, by the largest", by_size(low.grad, exact.grad), steep * bound))
        low, exact = rows.clone().requires_grad_(True), rows.double().requires_grad_(True)
        with torch.autocast("cpu", dtype=kind):
            block_conv3d(low, topology, weight).float().mul(pull).sum().backward()
        block_conv3d(exact, topology, weight.double()).mul(pull.double()).sum().backward()
        assert low.grad is not None and exact.grad is not None
        out.append(Measure(f"block convolution, {name}, by the largest", by_size(low.grad, exact.grad), bound))
        low, exact = views.clone().requires_grad_(True), views.double().requires_grad_(True)
        with torch.autocast("cpu", dtype=kind):
            mean, variance, _ = aggregate(low, visible)
        (mean.float().sum() + variance.float().sum()).backward()
        sums = aggregate(exact, visible)
        (sums[0].sum() + sums[1].sum()).backward()
        assert low.grad is not None and exact.grad is not None
        out.append(Measure(f"aggregation, {name}, by the largest", by_size(low.grad, exact.grad), bound))
    return out


@case("prune and split", "the optimiser's state survives pruning, and starts afresh at a split")
def optimiser_state(folder: Path) -> list[Measure]:
    from fieldfuse.training.levels import finer, pruned
    from fieldfuse.training.rays import Batch
    from fieldfuse.volume.host import TorchHost

    field = small_field(3, 0.4)
    origins, directions = aimed_rays(200, 2)
    batch = Batch(origins, directions, torch.rand(200, 3), torch.zeros(200, dtype=torch.int64))
    rates, generator = Rates(0.05, 0.02, 1e-3, 0.01), torch.Generator().manual_seed(0)
    optimiser = Optimiser(replace(field, density_rows=field.density_rows.clone(), feature_rows=field.feature_rows.clone()))
    for _ in range(3):
        optimiser.step(batch, rates, generator)
    before = [optimiser.density.state.clone(), optimiser.feature.state.clone(), optimiser.field.density_rows.clone()]
    keep = torch.rand(len(field.occupied), generator=generator) < 0.5
    optimiser.go_on_with(pruned(optimiser.field, keep))
    after = [optimiser.density.state, optimiser.feature.state, optimiser.field.density_rows]
    lost = sum(absolute(new, old) for new, old in zip(after, before, strict=True))
    optimiser.step(batch, rates, generator)
    grown = finer(optimiser.field, optimiser.field.occupied, 2 * field.resolution, TorchHost())
    optimiser.renew_rows(grown)
    fresh = float(optimiser.density.state.abs().sum() + optimiser.feature.state.abs().sum())
    optimiser.step(batch, rates, generator)
    states = optimiser.decoder.state.values()
    decoder = [state[name] for state in states for name in ("exp_avg", "exp_avg_sq")]
    forgotten = min(int(state["step"]) for state in states) < 5 or not all(bool(value.any()) for value in decoder)
    return [
        Measure("rows' moments changed by pruning", lost, 0.0),
        Measure("rows' moments left at a split", fresh, 0.0),
        Measure("decoder's moments lost", float(forgotten), 0.0),
        Measure("values that are not finite", not_finite(*after, grown.density_rows, grown.feature_rows, *decoder), 0.0),
    ]
