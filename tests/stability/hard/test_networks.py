"""Networks: encodings, decoders, block convolution, aggregation and awkward views, at the edges of their range; lower precision."""

from __future__ import annotations

import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fieldfuse.nerfusion.aggregate import aggregate, evidence
from fieldfuse.nerfusion.block_conv import block_conv3d
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.nerfusion.encoding import positional, spherical_harmonics
from fieldfuse.nerfusion.unproject import MARGIN, project
from fieldfuse.volume.topology import Topology
from tests.stability.hard import reference
from tests.stability.hard.errors import absolute, by_size, not_finite, relative
from tests.stability.hard.fields import lattice, scattered_blocks
from tests.stability.hard.ranges import FEW, KEYS, QUICK
from tests.stability.hard.within import Within

GROUP = "networks"
LOW = 16  # roundings of the lower precision that a gradient through a few layers may carry
TURNS = 8  # times that, behind the sines and cosines of the paper's decoder


def _directions() -> Tensor:
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    tiny = torch.nn.functional.normalize(torch.tensor([[1.0, 1e-20, -1e-30], [1e-8, 1.0, 1e-8]]), dim=1)
    return torch.cat([axes, tiny, torch.nn.functional.normalize(torch.randn(200, 3), dim=1)])


def test_encodings(within: Within) -> None:
    """Encodings of directions and features against float64."""
    directions = _directions()
    basis = spherical_harmonics(directions.double())
    share = 4 * math.pi * (basis[8:].T @ basis[8:]) / 200  # orthonormal up to the noise of 200 directions
    values = torch.cat([torch.linspace(-1, 1, 101), torch.tensor([0.0, -0.0, 1e-30])])[:, None]
    exact = []
    for value in values[:, 0].double().tolist():
        angles = [2**k * math.pi * value for k in range(5)]
        exact.append([value, *map(math.sin, angles), *map(math.cos, angles)])
    large = positional(torch.tensor([[1e4], [3e7], [-1e30]]), 5)
    within("harmonics", absolute(spherical_harmonics(directions), basis), 5e-7)
    within("harmonics that are not orthonormal", absolute(share, torch.eye(basis.shape[1])), 0.6)
    within("sines and cosines", absolute(positional(values, 5), exact), 1e-5)
    within("of huge features: beyond [-1, 1] or not finite", not_finite(large) + float((large[:, 1:].abs() > 1).sum()), 0.0)


def test_decoders(within: Within) -> None:
    """Decoders on huge, tiny and zero features, in float32 and under autocast."""
    directions = _directions()
    for kind in ("deferred", "per_sample"):
        torch.manual_seed(3)
        net = make_decoder(kind, 8, 32)
        for parameter in net.parameters():
            parameter.data.add_(0.1 * torch.randn(parameter.shape))
        double = make_decoder(kind, 8, 32).double()
        double.load_state_dict({name: value.double() for name, value in net.state_dict().items()})
        worst, wrong = 0.0, 0.0
        for size in (0.0, 1e-20, 1.0, 1e4):
            features = (torch.randn(len(directions), 8) * size).requires_grad_(True)
            got = net(features, directions)
            exact = double(features.double(), directions.double())
            got, exact = (got, exact) if kind == "deferred" else (got[1], exact[1])
            got.sum().backward()
            assert features.grad is not None
            # Features of 1e4 turn by thousands of periods in the paper's encoding: only finiteness is checked there.
            worst = max(worst, absolute(got, exact) if size <= 1 else 0.0)
            wrong += not_finite(got, features.grad) + float(((got < 0) | (got > 1)).sum())
            for reduced in (torch.bfloat16, torch.float16):
                with torch.autocast("cpu", dtype=reduced):
                    low = net(features.detach(), directions)
                low = low if kind == "deferred" else low[1]
                wrong += not_finite(low.float())
                if size <= 1:
                    name = f"{kind}, features ×{size:g}, {str(reduced)[6:]}"
                    within(name, absolute(low.float(), exact), 8 * float(torch.finfo(reduced).eps))
        within(f"{kind}: colour", worst, 5e-6)
        within(f"{kind}: not finite or outside [0, 1]", wrong, 0.0)


def convolution_errors(topology: Topology, occupied: Tensor, seed: int) -> dict[str, float]:
    """Errors of a block convolution and of its input's gradient against dictionaries of voxels."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(topology.zero_row, 2, generator=generator)
    rows[~occupied] = 0
    weight, bias = torch.randn(3, 2, 3, 3, 3, generator=generator), torch.randn(3, generator=generator)
    pull = torch.randn(topology.zero_row, 3, generator=generator)
    places = [tuple(place) for place in lattice(topology).tolist()]
    held = occupied.tolist()
    values = {place: row for place, row, one in zip(places, rows.double().tolist(), held, strict=True) if one}
    pulls = {place: row for place, row, one in zip(places, pull.double().tolist(), held, strict=True) if one}
    pick = occupied.nonzero().squeeze(1)[:: max(1, int(occupied.sum()) // 60)].tolist()
    exact = [reference.convolution(values, weight.double().tolist(), bias.double().tolist(), places[row]) for row in pick]
    turned = weight.double().flip(2, 3, 4).transpose(0, 1).tolist()
    back = [reference.convolution(pulls, turned, [0.0, 0.0], places[row]) for row in pick]
    leaf = rows.clone().requires_grad_(True)
    out = block_conv3d(leaf, topology, weight, bias, occupied)
    (out * pull).sum().backward()
    assert leaf.grad is not None
    out = out.detach()
    return {
        "value": by_size(out[pick], exact) if pick else 0.0,
        "gradient": by_size(leaf.grad[pick], back) if pick else 0.0,
        "values at empty voxels": float(out[~occupied].abs().sum()),
        "values that are not finite": not_finite(out, leaf.grad),
    }


def test_convolution(within: Within) -> None:
    """Block convolution: touching, lonely and empty blocks."""
    for name, topology, share in (
        ("touching", scattered_blocks(8, 1, 1), 0.4),
        ("lonely", Topology(torch.tensor([[0, 0, 0], [900, -900, 7]])), 1.0),
        ("empty", scattered_blocks(3, 2), 0.0),
    ):
        occupied = torch.rand(topology.zero_row, generator=torch.Generator().manual_seed(2)) < share
        for what, error in convolution_errors(topology, occupied, 3).items():
            within(f"{name}: {what}", error, 2e-6 if what in ("value", "gradient") else 0.0)
    topology = scattered_blocks(8, 1, 1)
    rows, weight = torch.randn(topology.zero_row, 4), torch.randn(4, 4, 3, 3, 3) * 0.1
    exact = block_conv3d(rows.double(), topology, weight.double())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        low = block_conv3d(rows, topology, weight)
    within("under bfloat16 autocast, by the largest", by_size(low.float(), exact), 4 * float(torch.finfo(torch.bfloat16).eps))
    none = Topology(torch.zeros((0, 3), dtype=torch.int32))
    within("rows of no blocks", float(len(block_conv3d(torch.zeros(1, 4), none, weight)) - 1), 0.0)


def aggregation_errors(values: Tensor, visible: Tensor) -> dict[str, float]:
    """Mean and variance over views against sums of float64 numbers, by the size of the values."""
    leaf = values.clone().requires_grad_(True)
    mean, variance, count = aggregate(leaf, visible)
    (mean.sum() + variance.sum()).backward()
    assert leaf.grad is not None
    mean, variance = mean.detach(), variance.detach()
    wide = values.double()
    means, variances = torch.zeros(values.shape[1:], dtype=torch.float64), torch.zeros(values.shape[1:], dtype=torch.float64)
    for voxel in range(values.shape[1]):
        seen = wide[visible[:, voxel], voxel]
        means[voxel] = seen.sum(0) / len(seen)
        variances[voxel] = ((seen - means[voxel]) ** 2).sum(0) / len(seen)
    read = evidence(mean, variance, count, torch.full((values.shape[1],), 3.0), torch.zeros(values.shape[1]))
    size = float(wide.abs().max())
    rounding = 1e-6 * variances + (3e-7 * size) ** 2 + 4e-7 * size * variances.sqrt()  # of the values themselves, carried on
    return {
        "mean, by the largest value": absolute(mean, means) / size,
        "variance, beyond the rounding of its inputs": float(((variance.double() - variances).abs() / rounding).max()),
        "variance seen once that is not zero": float(variance[count == 1].abs().sum()),
        "negative variances": float((variance < 0).sum()),
        "values that are not finite": not_finite(mean, variance, read, leaf.grad),
    }


def test_aggregation(within: Within) -> None:
    """Aggregation: one view, identical views, mean 1e4 with variance 1e-4."""
    torch.manual_seed(5)
    one = torch.zeros(3, 40, dtype=torch.bool)
    one[1] = True
    some = torch.rand(3, 40) < 0.6
    some[0] |= ~some.any(0)
    every = torch.ones(3, 40, dtype=torch.bool)
    sets = {
        "seen once": (torch.randn(3, 40, 4), one),
        "identical": (torch.randn(1, 40, 4).expand(3, 40, 4).contiguous(), every),
        "mean 1e4, variance 1e-4": (1e4 + 1e-2 * torch.randn(3, 40, 4), every),
        "tiny": (torch.randn(3, 40, 4) * 1e-18, some),
        "some unseen": (torch.randn(3, 40, 4), some),
    }
    bounds = {"mean, by the largest value": 1e-6, "variance, beyond the rounding of its inputs": 1.0}
    for name, (values, visible) in sets.items():
        for what, error in aggregation_errors(values, visible).items():
            within(f"{name}: {what}", error, bounds.get(what, 0.0))


WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
SIDE = 0.05  # of a voxel


@FEW
@given(st.lists(KEYS, min_size=1, max_size=4, unique=True), st.floats(0, 1), st.integers(0, 100))
def test_block_convolution(keys: list[tuple[int, int, int]], share: float, seed: int) -> None:
    topology = Topology(torch.tensor(keys))
    occupied = torch.rand(topology.zero_row, generator=torch.Generator().manual_seed(seed)) < share
    errors = convolution_errors(topology, occupied, seed)
    assert errors["value"] < 3e-6 and errors["gradient"] < 3e-6
    assert errors["values at empty voxels"] == 0 and errors["values that are not finite"] == 0


@QUICK
@given(st.floats(-15, 15), st.floats(-6, 0), st.integers(1, 5), st.integers(0, 1000))
def test_aggregation_of_any_size(mean: float, spread: float, views: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    size = math.copysign(10.0 ** abs(mean / 3), mean)
    values = size * (1 + 10.0**spread * torch.randn(views, 8, 3, generator=generator))
    visible = torch.rand(views, 8, generator=generator) < 0.7
    visible[0] |= ~visible.any(0)
    errors = aggregation_errors(values, visible)
    assert errors.pop("mean, by the largest value") < 1e-6 and errors.pop("variance, beyond the rounding of its inputs") <= 1
    assert not any(errors.values()), errors


def awkward_views() -> dict[str, Tensor]:
    """(4, 4) poses, each looking along +z at the origin unless given otherwise."""
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


def test_seen_by_views(within: Within) -> None:
    """Views at infinity, behind, inside, identical, at the border of the picture."""
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
    within("voxels seen by the wrong views", float(wrong), 0.0)
    within("pixels, relative", worst, 4e-6)
    within("seen from infinity, from behind or from beside", float(found.visible[[2, 3, 5]].sum()), 0.0)
    within("identical views that differ", absolute(found.pixels[0], found.pixels[1]), 0.0)
    within("negative variances", float((variance < 0).sum()), 0.0)
    within("gradients of what no view sees", float(values.grad[~found.visible].abs().sum()), 0.0)
    within("values that are not finite", not_finite(found.pixels, found.footprint, mean, variance, read, values.grad), 0.0)


def test_reduced_gradients(within: Within) -> None:
    """Gradients under bfloat16 and float16 autocast against float64."""
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
            within(f"decoder {decoder}, {name}, by the largest", by_size(low.grad, exact.grad), steep * bound)
        low, exact = rows.clone().requires_grad_(True), rows.double().requires_grad_(True)
        with torch.autocast("cpu", dtype=kind):
            block_conv3d(low, topology, weight).float().mul(pull).sum().backward()
        block_conv3d(exact, topology, weight.double()).mul(pull.double()).sum().backward()
        assert low.grad is not None and exact.grad is not None
        within(f"block convolution, {name}, by the largest", by_size(low.grad, exact.grad), bound)
        low, exact = views.clone().requires_grad_(True), views.double().requires_grad_(True)
        with torch.autocast("cpu", dtype=kind):
            mean, variance, _ = aggregate(low, visible)
        (mean.float().sum() + variance.float().sum()).backward()
        sums = aggregate(exact, visible)
        (sums[0].sum() + sums[1].sum()).backward()
        assert low.grad is not None and exact.grad is not None
        within(f"aggregation, {name}, by the largest", by_size(low.grad, exact.grad), bound)
