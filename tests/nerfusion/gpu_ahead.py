"""Compiles the networks' kernels for a GPU that need not be there, with what launches of several sizes give them; run as a program.

The interpreter, in which tests try kernels without a GPU, takes what the compiler refuses, and does not tell how often Triton would compile
anew. So launches are replaced here: the keys by which Triton would know variants are counted, and one of them is compiled for each kind of
numbers. Prints a line a kernel: its name, how many variants the launches ask for, and the seconds that compiling took.
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from dataclasses import replace
from typing import Any
from unittest import mock

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from fieldfuse.backends.triton import blocks as blocks_gpu
from fieldfuse.backends.triton import cast as cast_gpu
from fieldfuse.backends.triton import coarse_steps as march_gpu
from fieldfuse.backends.triton import convolution, depth_reading, local_volume, plane_sweep
from fieldfuse.backends.triton import feature_lookup as lookup
from fieldfuse.backends.triton import volumes as volumes_gpu
from fieldfuse.nerfusion.cameras import all_blocks
from fieldfuse.nerfusion.extras.cross_view_consistency import CrossView
from fieldfuse.nerfusion.extras.plane_sweep import CostVolume, DepthDistribution
from fieldfuse.nerfusion.lattice import LatentVolume, LocalVolume
from fieldfuse.nerfusion.unproject import KeyFrame
from fieldfuse.nerfusion.volume_net import FieldHead
from fieldfuse.simulate.solids import BALL, BOX, CYLINDER, ROOM, Solids, upright
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import SMALL as SIZES
from tests.nerfusion.made import cameras, lattice, pictures, small_model

TYPES = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.uint8: "*u8", torch.bfloat16: "*bf16"}
CAPABILITY = 90
variants: dict[str, set[Any]] = defaultdict(set)
done: set[Any] = set()
seconds: Counter[str] = Counter()


def compiled(self: Any, *args: Any, grid: Any, warmup: bool, num_warps: int = 4, **constants: Any) -> None:
    """In place of a launch."""
    names = [name for name in self.arg_names if name not in constants]
    kinds = [TYPES[a.dtype] if isinstance(a, torch.Tensor) else "fp32" if isinstance(a, float) else "i32" for a in args]
    special = {param.name for param in self.params if not param.do_not_specialize}
    ends = [
        (a.data_ptr() % 16 == 0) if isinstance(a, torch.Tensor) else (a == 1, a % 16 == 0)
        for name, a in zip(names, args, strict=True)
        if name in special and not isinstance(a, float)
    ]
    key = (tuple(kinds), tuple(ends), tuple(constants.items()), num_warps)
    name = f"{self.fn.__module__.rsplit('.', 1)[-1]}.{self.fn.__name__}"
    variants[name].add(key)
    if (name, *kinds) not in done:
        done.add((name, *kinds))
        begin = time.perf_counter()
        signature = dict(zip(names, kinds, strict=True)) | dict.fromkeys(constants, "constexpr")
        source = ASTSource(fn=self, signature=signature, constexprs=constants)
        triton.compile(source, target=GPUTarget("cuda", CAPABILITY, 32), options={"num_warps": num_warps})
        seconds[name] += time.perf_counter() - begin


def sweeps(views: int, planes: int, height: int, width: int, count: int) -> None:
    """A sweep and its witnesses."""
    whole = torch.rand(views, 21, height, width)
    seen_by = cameras(views)
    plane_sweep.patch_descriptors(torch.rand(views, 3, height, width), (0.3, 0.6, 0.1), 0.03)
    rays, own, inverses = plane_sweep.pixels(whole[0], seen_by, (height, width), planes, 0.1, 1.0)
    plane_sweep.costs(list(whole), seen_by, inverses, rays, own, 8.0, 0.6)
    cost = torch.rand(height, width, planes).permute(2, 0, 1)
    costs = CostVolume(seen_by[views - 1], rays, inverses, 0.1, 0.01, cost)
    smoothing = 0.1, 0.8, 0.05
    table = plane_sweep.table(plane_sweep.smoothed_softmax(cost, *smoothing), 0.01, 2)
    depth, place = torch.rand(2 * height, width + 3), ((2 * height, 2 * width), [(0, 2 * height), (0.5, width)])
    depth_reading.table_with_depth(cost, inverses, depth, place, (0.01, 0.01, 0.98), 2)
    for correction in (None, cost):
        plane_sweep.table_of_costs(cost, correction, smoothing, 0.01, 2)
    depth_reading.look(torch.rand(count, 3), torch.rand(count), table, seen_by[views - 1], 0.1, 0.01)
    one = CrossView(seen_by[0], depth_reading.log_odds(table, 4.0, 0.1, 2), 0.1, 0.01)
    surface = depth_reading.confident_points(table, rays, inverses, seen_by.positions[0], 0.7)
    plane_sweep.own_estimate(costs, smoothing, 2, (4.0, 0.1, 2), 0.7)
    together = depth_reading.Together([replace(one, camera=seen_by[k % views]) for k in range(views)])
    for sums in (None, together.confirmed(surface)):
        together.mean(costs, ((height + 1) // 2, (width + 1) // 2), sums, 1.0, 0.3)


def volumes(blocks: int) -> None:
    """What is done with blocks."""
    topology = Topology(torch.stack([torch.arange(blocks), torch.zeros(blocks), torch.ones(blocks)], 1).int())
    rows, mask = torch.rand(topology.zero_row + 1, 16), torch.rand(topology.zero_row) < 0.5
    for inside, outside in ((16, 16), (32, 8)):
        values, weight, bias = torch.rand(topology.zero_row + 1, inside), torch.rand(outside, inside, 3, 3, 3), torch.rand(outside)
        taps = convolution.taps_of(weight)
        convolution.convolve(values, topology.around, taps, bias, mask, True)
        convolution.convolve(values, topology.around, taps, None, None)
        convolution.weight_gradient(values, topology.around, torch.rand(topology.zero_row + 1, outside))
    side_by_side = convolution.taps_of(torch.rand(8, 8, 3, 3, 3), torch.rand(8, 8, 3, 3, 3))
    convolution.convolve(torch.rand(topology.zero_row + 1, 16), topology.around, side_by_side, torch.rand(16), mask, True)
    table, cells = blocks_gpu.table(topology.keys, topology.table_origin, topology.table_size)
    blocks_gpu.around(table, cells)
    blocks_gpu.around(table, cells, torch.arange(blocks, dtype=torch.int32), torch.arange(blocks, dtype=torch.int32))
    blocks_gpu.pooled(topology, mask, 0, 2, True)
    blocks_gpu.resample(topology, mask, [rows], topology.keys.long(), 0.5)
    slots, count = torch.arange(blocks, dtype=torch.int32), torch.rand(topology.zero_row)
    taken = blocks_gpu.take(rows, count, slots, topology)
    blocks_gpu.take(rows, count, slots, topology, (rows, count, topology))
    blocks_gpu.put(rows, count, slots, *taken, mask)
    blocks_gpu.split(topology, mask, rows, ((-1, -1, -1), (2 * blocks, 3, 3)), 0.25)
    volumes_gpu.settle(rows, rows, slots)
    volumes_gpu.merge(rows, count, rows, count, mask)
    volumes_gpu.surface_cells(topology, rows, count, mask, FieldHead(16, 32, 16), -3.0)
    part = LatentVolume(lattice(), topology, rows, count)
    local = LocalVolume(lattice(), topology, rows, torch.ones(topology.zero_row), rows, count, topology, slots)
    for kind in (torch.float32, torch.bfloat16):
        step = volumes_gpu.Step(part, local, 0.1, 16)
        step.average()
        both, _ = step.beside(kind)
        step.forget(torch.rand(len(both), 32).to(kind), both)
        step.update(torch.rand(len(both), 32).to(kind), torch.rand(len(both), 16).to(kind), 3, 0.5, rows)


def corners(views: int, side: int, planes: int) -> None:
    """What views show at corners."""
    model, seen_by = small_model(config=replace(SIZES, hidden=16)), cameras(views)
    with torch.no_grad():
        encoded = model.encode(pictures(views, size=(side, side + 16)), seen_by)
    distribution = DepthDistribution(seen_by[0], torch.rand(6, 7, planes, 3).permute(3, 2, 0, 1), 0.1, 0.01)
    for shell in (0.0, 1.0):
        space = lattice(16, shell)
        keys = all_blocks(space)[:2]
        frame, topology = KeyFrame(encoded, seen_by, 0.1, 4.0, distribution), Topology(keys, bounds=space.bounds("cpu"))
        numbers = local_volume.Numbers(2.0, 0.02, 0.1, 0.9, 4.0, 0.35, SIZES.sampled, True, SIZES.channels)
        found = torch.full((1 + 2 * 512 // local_volume.PART,), 3, dtype=torch.int32)  # as if all corners had been found
        found[0] = planes
        for wanted in (None, torch.ones(2 * 512, dtype=torch.bool)):
            with mock.patch("torch.zeros", lambda *_, found=found, **__: found), torch.no_grad():
                local_volume.local_volume(model.local, frame, space, topology, wanted, numbers)
    step = torch.rand(planes)
    for table in (True, False):
        rows = encoded[0].features.rows.detach().requires_grad_(table)
        some = [replace(one, features=replace(one.features, rows=rows)) for one in encoded]
        with torch.set_grad_enabled(table):
            found = lookup.look_up(some, torch.rand(views, planes, 2), step, torch.rand(views, planes), 0.35)
        if table:
            torch.autograd.grad(found, rows, torch.rand(found.shape))


def scenes(solids: int, rays: int) -> None:
    made = Solids([upright(kind, [0, 0, k], [1, 1, 1], 0) for kind in (BOX, ROOM, BALL, CYLINDER) for k in range(solids)])
    for origins in (1, rays):
        cast_gpu.cast(made, torch.rand(origins, 3), torch.rand(rays, 3), 1e9, 1e-5)
    march_gpu.walk(torch.rand(rays, 3), torch.rand(rays, 3), torch.rand(rays), 5 * solids, 0.1, 0.1, 20.0, 1.0, 2.0, 1e4)


if __name__ == "__main__":
    triton.runtime.jit.JITFunction.run = compiled
    for odd, even in ((1, 16), (3, 32), (2, 17)):
        sweeps(odd + 1, 32 + even, even, 6 + odd, 100 * even + odd)
        volumes(even)
        corners(odd, 16 * (1 + odd), 32 + even)
        scenes(odd, even)
    for name in sorted(variants):
        sys.stdout.write(f"{name} {len(variants[name])} {seconds[name]:.1f}\n")
