"""The kernels for CUDA, in Triton's interpreter on the CPU: against the tensors that they stand for."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

if importlib.util.find_spec("triton") is None or torch.cuda.is_available():
    pytest.skip("needs Triton, interpreting; with a CUDA device see test_gpu_device.py", allow_module_level=True)
os.environ.setdefault("TRITON_INTERPRET", "1")

from tests.networks.made import SMALL as SIZES
from tests.networks.made import cameras, lattice, pictures, small_model
from tests.networks.test_compiled import everything
from tests.networks.test_compiled_gru import trained, volumes
from toolkit import gpu
from toolkit.networks import compiled, compiled_lookup
from toolkit.networks.block_conv import block_conv3d
from toolkit.networks.cull import all_blocks
from toolkit.networks.gpu import convolution, lookup, matching, observe, reading
from toolkit.networks.gpu import gru as compiled_rows
from toolkit.networks.lattice import cells
from toolkit.networks.matching import distribution, semi_global
from toolkit.networks.sweep import _table
from toolkit.networks.unproject import look_up, project
from toolkit.render.march import MarchGrid, march
from toolkit.volume import blocks_gpu
from toolkit.volume.edit import corner_nodes, split
from toolkit.volume.space import Space
from toolkit.volume.topology import Topology

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def large_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter takes as long for a tile of four as for one of a thousand."""
    monkeypatch.setattr(matching, "TILE", (1024, 32))
    monkeypatch.setattr(matching, "PLANES", 16)
    monkeypatch.setattr(matching, "PIXELS", 1024)
    monkeypatch.setattr(reading, "TILE", (1024, 32))
    for module, names in ((reading, ("BLOCK",)), (lookup, ("BLOCK",)), (observe, ("BLOCK",)), (compiled_rows, ("BLOCK",))):
        for name in names:
            monkeypatch.setattr(module, name, 2048)
    for module, names in ((convolution, ("TILE", "SLOPES")), (blocks_gpu, ("TILE",))):
        for name in names:
            monkeypatch.setattr(module, name, 512)


def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on the CPU take the way of those on CUDA."""
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    monkeypatch.setattr(gpu, "fits", lambda *values: True)


@pytest.mark.parametrize("shape", [(40, 5, 6), (3, 6, 1), (64, 1, 3)])
def test_matching(shape: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    cost = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    smooth, likely = semi_global(cost), distribution(cost)
    table = _table(likely, 0.1)
    forced(monkeypatch)
    torch.testing.assert_close(semi_global(cost), smooth, atol=1e-6, rtol=0)
    torch.testing.assert_close(distribution(cost), likely, atol=1e-5, rtol=0)
    made = _table(likely, 0.1)
    torch.testing.assert_close(made, table, atol=1e-5, rtol=0)
    assert made.stride() == table.stride()


def test_a_sweep_and_its_witnesses(monkeypatch: pytest.MonkeyPatch) -> None:
    views = 3
    monkeypatch.setattr("toolkit.networks.sweep.SPACING", 9)  # the interpreter is slow
    monkeypatch.setattr("toolkit.networks.sweep.PLANES", (8, 16))
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    slow = everything(views, 1000)
    forced(monkeypatch)
    for name, quick in everything(views, 1000).items():
        torch.testing.assert_close(quick, slow[name], atol=2e-4, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")


@pytest.mark.parametrize(("inside", "outside"), [(4, 8), (32, 16)])
def test_convolution_and_its_gradients(inside: int, outside: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    topology = Topology(torch.tensor([[0, 0, 0], [1, 0, 0], [1, 1, 0]]))
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
    monkeypatch.setattr(gpu, "takes", lambda values: True)
    for quick, expected in zip(everything(), slow, strict=True):
        torch.testing.assert_close(quick, expected, atol=2e-3, rtol=1e-4)


def test_lookup(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    model, seen_by = small_model(), cameras(3)
    views = model.encode(pictures(3), seen_by)
    points = torch.rand(300, 3, generator=generator) * 2 - 1
    projection = project(points, torch.rand(300, generator=generator) * 0.4, seen_by, 0.0, 9.0)
    step = torch.rand(300, generator=generator) * 6
    monkeypatch.setattr(compiled_lookup, "fits", lambda *values: False)
    with torch.no_grad():
        slow = look_up(views, projection, step)
        monkeypatch.setattr(gpu, "fits", lambda *values: True)
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
    monkeypatch.setattr(gpu, "fits", lambda *values: True)
    for quick, expected in zip(gradients(), slow, strict=True):
        torch.testing.assert_close(quick, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("shell", "variance", "count"), [(0.0, True, 3), (1.0, True, 2), (1.0, False, 1)])
def test_what_corners_are_seen_to_be(shell: float, variance: bool, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model(config=replace(SIZES, hidden=16, variance=variance))
    seen_by, space = cameras(count), lattice(16, shell)
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    monkeypatch.setattr(compiled_lookup, "fits", lambda *values: False)
    with torch.no_grad():
        for parameter in model.local.project.parameters():
            parameter.normal_(generator=torch.Generator().manual_seed(1))
        views = model.encode(pictures(count), seen_by)
        swept = model.sweep(views, seen_by, 0.8, 4.0)
        topology = Topology(all_blocks(space)[:3])
        given = views, seen_by, space, topology
        few = torch.rand(topology.zero_row, generator=torch.Generator().manual_seed(2)) < 0.4
        for wanted in (None, few):
            slow = model._seen(*given, wanted, 0.1, 4.0, swept)
            with monkeypatch.context() as patch:
                patch.setattr(gpu, "fits", lambda *values: True)
                quick = model._seen(*given, wanted, 0.1, 4.0, swept)
            assert torch.equal(quick[0], slow[0]) and len(slow[0])
            for mine, expected in zip(quick[1:], slow[1:], strict=True):
                torch.testing.assert_close(mine, expected, atol=2e-4, rtol=2e-4)


@pytest.mark.parametrize("busy", [0, 1, 8])
def test_a_step_of_the_gru(busy: int, monkeypatch: pytest.MonkeyPatch) -> None:
    part, local = volumes(busy, busy)
    made = trained()
    monkeypatch.setattr("toolkit.networks.model.fits", lambda *_: False)
    with torch.no_grad():
        expected = made.fuse_part(part, local)
        monkeypatch.setattr(gpu, "fits", lambda *values: True)
        monkeypatch.setattr("toolkit.networks.gru.on_cpu", lambda device: False)
        found = made.fuse_part(part, local)
    torch.testing.assert_close(found.rows, expected.rows, atol=3e-5, rtol=0)
    torch.testing.assert_close(found.count, expected.count)


@pytest.mark.parametrize("believed", [False, True])
def test_a_finer_lattice(believed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where keys are believed to be what they are, and nothing is asked of the device."""
    generator = torch.Generator().manual_seed(0)
    keys = torch.tensor([[1, 0, 2]])
    topology = Topology(keys)
    occupied = torch.rand(topology.zero_row, generator=generator) < 0.01
    rows = torch.cat([torch.rand(topology.zero_row, 5, generator=generator), torch.zeros(1, 5)])
    slow, inside, (values,) = split(topology, occupied, [rows])
    nodes = corner_nodes(slow, inside)
    if believed:
        topology = Topology(keys, bounds=((-1, -1, -1), (5, 5, 5)))
        for module in ("toolkit.volume.edit", "toolkit.volume.topology"):
            monkeypatch.setattr(f"{module}.asks_freely", lambda device: False)
    monkeypatch.setattr(gpu, "fits", lambda *values: True)
    monkeypatch.setattr(gpu, "there", lambda values: True)
    quick, inside_quick, (made,) = split(topology, occupied, [rows])
    place = quick.find(slow.keys)
    assert len(quick.keys) == len(slow.keys) and bool((place >= 0).all())
    order = (place[:, None] * 512 + torch.arange(512)).view(-1)
    assert torch.equal(inside_quick[order], inside) and torch.equal(corner_nodes(quick, inside_quick)[order], nodes)
    torch.testing.assert_close(made[:-1][order], values[:-1], atol=1e-5, rtol=1e-5)
    for every in (False, True):
        mask = torch.rand(slow.zero_row, generator=generator) < 0.5
        with monkeypatch.context() as patch:
            patch.setattr(gpu, "there", lambda values: False)
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
    monkeypatch.setattr(gpu, "fits", lambda *values: True)
    quick = march(grid, origins, directions, 0.1, 4, jitter)
    for name in ("ray", "cell"):
        assert torch.equal(getattr(quick, name), getattr(slow, name))
    for name in ("distance", "span", "length", "place", "inside"):
        torch.testing.assert_close(getattr(quick, name), getattr(slow, name), atol=1e-4, rtol=1e-4)


def test_kernels_are_compiled_a_few_times_whatever_the_sizes() -> None:
    """Each takes seconds: a new one for other pictures or key frames would cost more than the kernels save."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.networks.gpu_ahead"], env=environment, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    counts = {name: int(count) for name, count, _ in map(str.split, done.stdout.splitlines())}
    assert len(counts) == 25 and max(counts.values()) <= 4, counts
