"""The kernels for CUDA, in Triton's interpreter on the CPU: against the tensors that they stand for."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

if importlib.util.find_spec("triton") is None or torch.cuda.is_available():
    pytest.skip("needs Triton, interpreting; with a CUDA device see test_gpu_device.py", allow_module_level=True)
os.environ.setdefault("TRITON_INTERPRET", "1")

from fieldfuse.backends import dispatch
from fieldfuse.backends.triton import blocks as blocks_gpu
from fieldfuse.backends.triton import convolution, depth_reading, local_volume, plane_sweep
from fieldfuse.backends.triton import feature_lookup as lookup
from fieldfuse.backends.triton import volumes as volumes_gpu
from fieldfuse.nerfusion.block_conv import BlockConv3d, Prepared, block_conv3d
from fieldfuse.nerfusion.cameras import all_blocks
from fieldfuse.nerfusion.extras.cross_view_consistency import consistency, cross_view, own_estimate
from fieldfuse.nerfusion.extras.matching import patch_descriptors, smoothed_softmax
from fieldfuse.nerfusion.extras.plane_sweep import _table, cost_volume, sweep_planes, to_probability
from fieldfuse.nerfusion.fusion import Fusion, FusionOptions
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, cells, rows_of
from fieldfuse.nerfusion.unproject import KeyFrame, look_up, project
from fieldfuse.render.march import MarchGrid, march
from fieldfuse.volume.edit import corner_nodes, split
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import SMALL as SIZES
from tests.nerfusion.made import cameras, lattice, off, pictures, small_model
from tests.nerfusion.test_compiled import FAR, NEAR, boxed, everything
from tests.nerfusion.test_compiled_gru import trained, volumes
from tests.nerfusion.test_plane_sweep import wall

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def large_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter takes as long for a tile of four as for one of a thousand."""
    monkeypatch.setattr(plane_sweep, "TILE", (1024, 32))
    monkeypatch.setattr(plane_sweep, "PLANES", 16)
    monkeypatch.setattr(plane_sweep, "PIXELS", 1024)
    monkeypatch.setattr(depth_reading, "TILE", (1024, 32))
    monkeypatch.setattr(plane_sweep, "BLOCK", 1024)
    for module in (depth_reading, lookup, local_volume, volumes_gpu, blocks_gpu):
        monkeypatch.setattr(module, "BLOCK", 2048)
    for module, names in ((convolution, ("TILE", "SLOPES")), (blocks_gpu, ("TILE",)), (local_volume, ("PART",))):
        for name in names:
            monkeypatch.setattr(module, name, 512)


@pytest.fixture(autouse=True)
def unchecked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter looks for overflow at each sum and product of integers, half of its time: not where kernels follow each other that
    have tests of their own."""
    if request.function in (test_key_frames_are_fused, test_a_local_volume, test_a_sweep_and_its_witnesses):
        from triton.runtime.interpreter import interpreter_builder

        monkeypatch.setattr(interpreter_builder, "options", replace(interpreter_builder.options, sanitize_overflow=False))


SINGLE = (torch.float32,)


def _use_triton(monkeypatch: pytest.MonkeyPatch, kinds: tuple[torch.dtype, ...] | None = SINGLE, use: bool = True) -> None:
    """Where tensors of these kinds have to lie on CUDA for the kernels, say so of those on the CPU."""
    before = dispatch.can_use_triton

    def chosen(*values: torch.Tensor, dtypes: tuple[torch.dtype, ...] | None = SINGLE) -> bool:
        return use if dtypes == kinds else before(*values, dtypes=dtypes)

    monkeypatch.setattr(dispatch, "can_use_triton", chosen)


def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on the CPU take the way of those on CUDA."""
    off(monkeypatch)
    _use_triton(monkeypatch)


@pytest.mark.parametrize("shape", [(40, 5, 6), (3, 6, 1), (64, 1, 3)])
def test_matching(shape: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    cost = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    off(monkeypatch)
    likely = smoothed_softmax(cost)
    table = _table(likely, 0.1)
    forced(monkeypatch)
    torch.testing.assert_close(smoothed_softmax(cost), likely, atol=1e-5, rtol=0)
    made = _table(likely, 0.1)
    torch.testing.assert_close(made, table, atol=1e-5, rtol=0)
    assert made.stride() == table.stride()


def test_a_sweep_and_its_witnesses(monkeypatch: pytest.MonkeyPatch) -> None:
    views = 3
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.SPACING", 14)  # the interpreter is slow
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.PLANES", (8, 16))
    off(monkeypatch)
    slow = everything(views, 1000)
    forced(monkeypatch)
    for name, quick in everything(views, 1000).items():
        torch.testing.assert_close(quick, slow[name], atol=2e-4, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")


@pytest.mark.parametrize(("size", "last"), [((40, 30), False), ((40, 30), True), ((280, 2), True)])
def test_what_pictures_are_compared_by(size: tuple[int, int], last: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of pictures whose colours lie next to each other in memory, and of such that are made smaller first."""
    images = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
    images = images.contiguous(memory_format=torch.channels_last) if last else images
    slow = patch_descriptors(images)
    forced(monkeypatch)
    quick = patch_descriptors(images)
    assert quick.is_contiguous()
    torch.testing.assert_close(quick, slow, atol=1e-5, rtol=0)


def test_pictures_of_several_sizes_and_silhouettes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.WITHIN", 7)
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.PLANES", (8, 16))
    off(monkeypatch)
    descriptors, seen_by = wall(3)
    descriptors = [descriptors[0], descriptors[1][:, ::2].contiguous(), descriptors[2][:, :, ::3]]

    def everything() -> list[torch.Tensor]:
        costs = cost_volume(descriptors, seen_by, NEAR, FAR, boxed)
        assert costs.empty is not None
        return [costs.rays, costs.inverses, costs.cost, costs.empty.float(), to_probability(costs).table]

    slow = everything()
    forced(monkeypatch)
    for quick, expected in zip(everything(), slow, strict=True):
        torch.testing.assert_close(quick, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("within", [False, True])
def test_what_a_sensor_measured(within: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.SPACING", 8)
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.WITHIN", 7)
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.PLANES", (8, 16))
    off(monkeypatch)
    descriptors, seen_by = wall(2)
    depth = 1.5 + torch.rand(31, 45, generator=torch.Generator().manual_seed(0))
    depth[::3], depth[1, ::2], depth[2, ::3], depth[4, 5], depth[5, 7] = 0, torch.inf, torch.nan, 0.1, 99.0

    def made() -> torch.Tensor:
        return to_probability(cost_volume(descriptors, seen_by, NEAR, FAR, boxed if within else None), depth).table

    slow = made()
    forced(monkeypatch)
    torch.testing.assert_close(made(), slow, atol=1e-4, rtol=1e-4)


def test_what_witnesses_say_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of their own pictures alone and not, from elsewhere, with other planes, and on a grid with an odd number of rows."""
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.SPACING", 14)
    monkeypatch.setattr("fieldfuse.nerfusion.extras.plane_sweep.PLANES", (8, 16))
    monkeypatch.setattr("fieldfuse.nerfusion.extras.cross_view_consistency.SURE", 0.4)
    off(monkeypatch)
    monkeypatch.setattr(depth_reading, "BLOCK", 32)
    monkeypatch.setattr(depth_reading, "PARTS", 2)
    descriptors, seen_by = wall(3)

    def everything() -> list[torch.Tensor]:
        costs = cost_volume(descriptors, seen_by, NEAR, FAR)
        mine, surface = own_estimate(costs)
        other = cross_view(to_probability(cost_volume([descriptors[1], descriptors[0]], seen_by[[1, 0]], NEAR, 2 * FAR)))
        theirs = [mine, other, replace(mine, camera=seen_by[2])]
        believed, weighed = (consistency(costs, [theirs[k] for k in (2, 0, 1)], at) for at in (None, surface))
        assert believed is not None and weighed is not None
        sure = surface[surface.isfinite().all(1)]
        return [mine.log_odds, sure, believed, weighed, to_probability(costs, correction=weighed).table]

    slow = everything()
    assert len(slow[1]) and slow[2].shape[1] % 2 == 1
    forced(monkeypatch)
    for quick, expected in zip(everything(), slow, strict=True):
        torch.testing.assert_close(quick, expected, atol=2e-4, rtol=1e-4)


@pytest.mark.parametrize(("inside", "outside"), [(4, 8), (32, 16)])
def test_convolution_and_its_gradients(inside: int, outside: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    topology = Topology(torch.tensor([[0, 0, 0], [1, 0, 0]]))
    rows = torch.randn(topology.zero_row + 1, inside, generator=generator)
    occupied = torch.rand(topology.zero_row, generator=generator) < 0.6
    rows[:-1] *= occupied[:, None]
    rows[-1] = 0
    weight, bias = torch.randn(outside, inside, 3, 3, 3, generator=generator), torch.randn(outside, generator=generator)
    slopes = torch.randn(len(rows), outside, generator=generator)

    def everything() -> list[torch.Tensor]:
        given = [value.clone().requires_grad_() for value in (rows, weight, bias)]
        out = block_conv3d(given[0], topology, given[1], given[2], occupied)
        out.backward(slopes)
        return [out.detach(), *(value.grad for value in given)]

    slow = everything()
    _use_triton(monkeypatch, dispatch.FLOATS)
    for quick, expected in zip(everything(), slow, strict=True):
        torch.testing.assert_close(quick, expected, atol=2e-3, rtol=1e-4)


def test_convolutions_side_by_side() -> None:
    """Two of the same channels, then two of their own each; and again when a parameter has changed."""
    topology = Topology(torch.tensor([[0, 0, 0], [0, 0, 1]]))
    generator = torch.Generator().manual_seed(0)
    rows = torch.cat([torch.randn(topology.zero_row, 4, generator=generator), torch.zeros(1, 4)])
    seen = torch.rand(topology.zero_row, generator=generator) < 0.6
    stages, prepared = [[BlockConv3d(4, 3) for _ in range(2)], [BlockConv3d(3, 2) for _ in range(2)]], Prepared()
    for _ in range(2):
        with torch.no_grad():
            parts = [second(first(rows, topology, seen), topology, seen, True) for first, second in zip(*stages, strict=True)]
            found = prepared.convolve(stages, rows, topology, seen)
            stages[1][1].weight.mul_(-2.0)
        torch.testing.assert_close(found, torch.cat(parts, 1), atol=1e-4, rtol=1e-4)


def test_lookup(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    model, seen_by = small_model(), cameras(3)
    views = model.encode(pictures(3), seen_by)
    points = torch.rand(300, 3, generator=generator) * 2 - 1
    projection = project(points, torch.rand(300, generator=generator) * 0.4, seen_by, 0.0, 9.0)
    step = torch.rand(300, generator=generator) * 6
    off(monkeypatch)
    with torch.no_grad():
        slow = look_up(views, projection, step)
        _use_triton(monkeypatch)
        torch.testing.assert_close(look_up(views, projection, step), slow, atol=1e-5, rtol=1e-5)


def test_the_gradient_of_lookup(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    model, seen_by = small_model(), cameras(2)
    points = torch.rand(100, 3, generator=generator) * 2 - 1
    projection = project(points, torch.rand(100, generator=generator) * 0.4, seen_by, 0.0, 9.0)
    step = torch.rand(100, generator=generator) * 6

    def gradients() -> list[torch.Tensor]:
        views = model.encode(pictures(2), seen_by)
        shown = look_up(views, projection, step)
        slopes = torch.rand(shown.shape, generator=torch.Generator().manual_seed(1))
        return list(torch.autograd.grad(shown, list(model.sample.parameters()), slopes))

    slow = gradients()
    _use_triton(monkeypatch)
    for quick, expected in zip(gradients(), slow, strict=True):
        torch.testing.assert_close(quick, expected, atol=1e-4, rtol=1e-4)


def convolved(
    rows: torch.Tensor, around: torch.Tensor, taps: torch.Tensor, bias: torch.Tensor, occupied: torch.Tensor, relu: bool = False
) -> torch.Tensor:
    """`convolution.convolve` in tensors: in the interpreter the kernel, which has tests of its own, takes a minute for what follows."""
    groups, _, inside, outside = taps.shape
    given = SimpleNamespace(around=around, zero_row=len(around) * 512, device=around.device)
    halo = Topology._rows(given, 0, len(around), -1, 10)  # type: ignore[arg-type]
    cubes = (torch.relu(rows) if relu else rows)[halo.long()].view(-1, 10, 10, 10, rows.shape[1]).permute(0, 4, 1, 2, 3)
    weight = taps.view(groups, 3, 3, 3, inside, outside).permute(0, 5, 4, 1, 2, 3).flatten(0, 1)
    out = torch.nn.functional.conv3d(cubes, weight, bias, groups=groups).permute(0, 2, 3, 4, 1).reshape(-1, groups * outside)
    return torch.cat([out * occupied[:, None], out.new_zeros(1, groups * outside)])


def on_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of what tensors on CUDA make different, but for the convolution."""
    forced(monkeypatch)
    monkeypatch.setattr(convolution, "convolve", convolved)
    _use_triton(monkeypatch, dispatch.FLOATS)
    _use_triton(monkeypatch, None)
    nerfusion = ("fusion", "lattice", "model", "gru")
    for module in (*(f"nerfusion.{name}" for name in nerfusion), "volume.topology", "volume.edit"):
        monkeypatch.setattr(f"fieldfuse.{module}.is_cpu", lambda device: False)


def same(one: LatentVolume, other: LatentVolume, names: tuple[str, ...]) -> None:
    """The same blocks, in any order, of the same numbers."""
    place = one.topology.find(other.topology.keys)
    assert one.topology.blocks == other.topology.blocks > 0 and bool((place >= 0).all())
    assert np.array_equal(one.topology.host, one.topology.keys.numpy())
    rows = rows_of(place, one.topology.zero_row)
    for name in names:
        mine, expected = getattr(one, name), getattr(other, name)
        torch.testing.assert_close(
            mine[rows[: len(expected)]], expected, atol=2e-4, rtol=2e-4, msg=lambda text, name=name: f"{name}: {text}"
        )


@pytest.mark.parametrize(("shell", "variance", "count"), [(0.0, True, 3), (1.0, True, 2), (1.0, False, 1)])
def test_a_local_volume(shell: float, variance: bool, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model(config=replace(SIZES, hidden=16, variance=variance))
    seen_by, space = cameras(count), lattice(16, shell)
    with torch.no_grad():
        for parameter in model.local.parameters():
            parameter.normal_(0, 0.2, generator=torch.Generator().manual_seed(1))
        views = model.encode(pictures(count), seen_by)
        distribution = sweep_planes([view.descriptors for view in views], seen_by, 0.8, 4.0)
        frame, keys = KeyFrame(views, seen_by, 0.1, 4.0, distribution), all_blocks(space)[:3]
        few = torch.rand(len(keys) * 512, generator=torch.Generator().manual_seed(2)) < 0.4
        for wanted in (None, few):
            slow = model.local_volume(frame, space, Topology(keys), wanted)
            with monkeypatch.context() as patch:
                on_device(patch)
                topology = Topology(keys, bounds=space.bounds("cpu"))
                quick = model.local_volume(frame, space, topology, wanted)
                assert quick.near_surface.blocks == slow.near_surface.blocks > 0
                same(quick, slow, ("rows", "count", "raw", "weight"))


def test_key_frames_are_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of them, of two views each, on two lattices, and what is left of them when blocks are forgotten."""
    model = small_model(config=replace(SIZES, hidden=16))
    seen_by, space = cameras(4), Lattice(Space((0.0, 0.0, 0.0), 0.8, 0.0, (0.7, 0.7, 0.7)), 16)  # one coarse block, of up to eight
    with torch.no_grad():
        for parameter in (*model.local.parameters(), *model.fusion.parameters()):
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(parameter.numel())))
        views = model.encode(pictures(4), seen_by)
        distribution = [sweep_planes([views[k].descriptors for k in group], seen_by[group], 0.8, 4.0) for group in ([0, 1], [3, 2])]

    def fused() -> Fusion:
        fusion = Fusion(model, space, FusionOptions(2, 0.1, 4.0))
        for group, one in zip(([0, 1], [3, 2]), distribution, strict=True):
            fusion.add([views[k] for k in group], seen_by[group], None, one)
        return fusion

    slow = fused()
    with monkeypatch.context() as patch:
        on_device(patch)
        quick = fused()
        for mine, expected in zip(quick.stores, slow.stores, strict=True):
            same(mine.volume(), expected.volume(), ("rows", "count"))
        quick.prune()
    slow.prune()
    same(quick.volume, slow.volume, ("rows", "count"))


@pytest.mark.parametrize("busy", [0, 1, 8])
def test_a_step_of_the_gru(busy: int, monkeypatch: pytest.MonkeyPatch) -> None:
    part, local = volumes(busy, busy)
    made = trained()
    off(monkeypatch)
    with torch.no_grad():
        expected = made.fuse_part(part, local)
        on_device(monkeypatch)
        found = made.fuse_part(part, local)
    torch.testing.assert_close(found.rows, expected.rows, atol=3e-5, rtol=0)
    torch.testing.assert_close(found.count, expected.count)


@pytest.mark.parametrize("believed", [False, True])
def test_a_finer_lattice(believed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where keys are believed to be what they are, and nothing is asked of the device."""
    generator = torch.Generator().manual_seed(0)
    keys = torch.tensor([[1, 0, 2]])
    topology = Topology(keys)
    occupied = torch.rand(topology.zero_row, generator=generator) < 0.03
    occupied[256:] = False  # the interpreter takes long for each block of the finer lattice
    rows = torch.cat([torch.rand(topology.zero_row, 5, generator=generator), torch.zeros(1, 5)])
    slow, inside, (values,) = split(topology, occupied, [rows])
    nodes = corner_nodes(slow, inside)
    if believed:
        topology = Topology(keys, bounds=((-1, -1, -1), (5, 5, 5)))
        for module in ("fieldfuse.volume.edit", "fieldfuse.volume.topology"):
            monkeypatch.setattr(f"{module}.is_cpu", lambda device: False)
    _use_triton(monkeypatch)
    _use_triton(monkeypatch, None)
    quick, inside_quick, (made,) = split(topology, occupied, [rows])
    place = quick.find(slow.keys)
    assert len(quick.keys) == len(slow.keys) and bool((place >= 0).all())
    order = (place[:, None] * 512 + torch.arange(512)).view(-1)
    assert torch.equal(inside_quick[order], inside) and torch.equal(corner_nodes(quick, inside_quick)[order], nodes)
    torch.testing.assert_close(made[:-1][order], values[:-1], atol=1e-5, rtol=1e-5)
    for every in (False, True):
        mask = torch.rand(slow.zero_row, generator=generator) < 0.5
        with monkeypatch.context() as patch:
            _use_triton(patch, None, False)
            expected = cells(slow, mask, every)
        assert torch.equal(cells(slow, mask, every), expected)


def test_coarse_steps_of_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.rand(40, 3, generator=generator) - 0.5
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator), dim=1)
    topology = Topology(torch.tensor([[1, 1, 1], [2, 2, 2]]))
    grid = MarchGrid(Space((0.0, 0.0, 0.0), 0.7, 1.0), 32, topology, torch.ones(topology.zero_row, dtype=torch.bool))
    jitter = torch.rand(40, generator=generator)
    slow = march(grid, origins, directions, 0.1, 4, jitter)
    _use_triton(monkeypatch)
    quick = march(grid, origins, directions, 0.1, 4, jitter)
    for name in ("ray", "cell"):
        assert torch.equal(getattr(quick, name), getattr(slow, name))
    for name in ("distance", "span", "length", "place", "inside"):
        torch.testing.assert_close(getattr(quick, name), getattr(slow, name), atol=1e-4, rtol=1e-4)


def test_kernels_are_compiled_a_few_times_whatever_the_sizes() -> None:
    """Each takes seconds: a new one for other pictures or key frames would cost more than the kernels save."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.nerfusion.gpu_ahead"], env=environment, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    counts = {name: int(count) for name, count, _ in map(str.split, done.stdout.splitlines())}
    assert len(counts) == 37 and max(counts.values()) <= 4, counts
