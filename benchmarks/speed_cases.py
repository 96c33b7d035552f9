"""The microbenchmarks of `python -m benchmarks.speed`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from benchmarks.timing import Case, compare, pinned
from fieldfuse.evaluation.sphere import around, lens, sphere_field, sphere_pixels
from fieldfuse.render.numba_renderer import NumbaRenderer
from fieldfuse.render.rays import render_rays
from fieldfuse.training.losses import Rates
from fieldfuse.training.numba_engine import NumbaEngine
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.torch_engine import TorchEngine

SIZES = (64, 128, 256)
BATCH = 2048
RATES = Rates(1e-4, 1e-4, 1e-4, 0.01)  # small: the state stays what it is, so that every repetition does the same
# What grows; all else stays the same.
GROWING_RAYS = (512, 2048, 8192)
GROWING_SIDES = (48, 96, 192, 384)
GROWING_VIEWS = (8, 32, 128)
LATTICE = 128


def step_cases(sizes: tuple[int, ...] = SIZES, repetitions: int = 5) -> Iterator[Case]:
    """A training step: the compiled engine against the torch engine on the same field and as many rays, one thread."""
    pool = sphere_pixels()
    with pinned(1):
        for size in sizes:
            engine, reference = NumbaEngine(sphere_field(size), pool, threads=1), TorchEngine(sphere_field(size), pool, 0)
            times = compare(
                lambda e=engine: e.step(BATCH, RATES),  # type: ignore[misc]
                lambda r=reference: r.step(BATCH, RATES),  # type: ignore[misc]
                repetitions,
            )
            yield Case("training step", f"{size}³", "ray", BATCH, *times, against="torch engine", counts=step_counts(engine))


def step_counts(engine: NumbaEngine) -> dict[str, float]:
    """Operations of one step a ray: samples looked up, and lattice corners that get a gradient."""
    before = sum(engine.given)
    _, looked = engine.step(BATCH, RATES)
    field = engine.field
    return {
        "looked_up_a_ray": round(looked / BATCH, 3),
        "voxels": field.voxels,
        "touched_corners": max(before, sum(engine.given)),
        "bytes_a_voxel": round(field.bytes / field.voxels, 1),
    }


def render_cases(sizes: tuple[int, ...] = SIZES, side: int = 128, repetitions: int = 5) -> Iterator[Case]:
    """Rays of a picture: compiled against torch, one thread."""
    camera, pose = lens(side, side), around()[1]
    from fieldfuse.camera import pixel_grid, rays

    with pinned(1):
        for size in sizes:
            field = sphere_field(size)
            origins, directions, _ = rays(camera, pose, pixel_grid(side, side))
            compiled = NumbaRenderer(field, 1)
            few = origins[:: side // 16], directions[:: side // 16]
            times = compare(lambda c=compiled, f=few: c.render(*f), lambda d=field, f=few: render_rays(d, *f), repetitions)  # type: ignore[misc]
            yield Case("rendering", f"{size}³", "ray", len(few[0]), *times, against="torch engine")


def thread_cases(threads: int, size: int = 128, repetitions: int = 5) -> Iterator[Case]:
    """Several threads against one, by the wall clock."""
    pool, field = sphere_pixels(), sphere_field(size)
    from fieldfuse.camera import pixel_grid, rays

    given = rays(lens(256, 256), around()[1], pixel_grid(256, 256))[:2]
    many, one = (NumbaEngine(sphere_field(size), pool, threads=n) for n in (threads, 1))
    renderers = [NumbaRenderer(field, n) for n in (threads, 1)]
    pairs: list[tuple[str, int, Callable[[], Any], Callable[[], Any]]] = [
        ("training step", 4 * BATCH, lambda: many.step(4 * BATCH, RATES), lambda: one.step(4 * BATCH, RATES)),
        ("rendering", 256 * 256, lambda: renderers[0].render(*given), lambda: renderers[1].render(*given)),
    ]
    for name, units, ours, reference in pairs:
        times = compare(ours, reference, repetitions)
        yield Case(f"{name}, {threads} threads", f"{size}³", "ray", units, *times, against="one thread", clock="wall")


def order_case(size: int = 256, repetitions: int = 5) -> Case:
    """The same rays in the order of a picture against a random order: what memory that is not in the cache costs."""
    from fieldfuse.camera import pixel_grid, rays

    renderer = NumbaRenderer(sphere_field(size), 1)
    origins, directions, _ = rays(lens(160, 160), around()[1], pixel_grid(160, 160))
    mixed = torch.randperm(len(origins), generator=torch.Generator().manual_seed(0))
    shuffled = origins[mixed], directions[mixed]
    times = compare(lambda: renderer.render(origins, directions), lambda: renderer.render(*shuffled), repetitions)
    return Case("rendering in picture order", f"{size}³", "ray", len(origins), *times, against="rays in random order")


def lookup_case(size: int = 128, points: int = 100_000, repetitions: int = 5) -> Case:
    """Trilinear lookup through the blocks against `grid_sample` on a dense lattice of the same size."""
    from fieldfuse.volume.lookup import corners, gather

    field = sphere_field(size)
    generator = torch.Generator().manual_seed(0)
    cells = field.occupied.nonzero().squeeze(1)
    cell = cells[torch.randint(len(cells), (points,), generator=generator)]
    inside = torch.rand(points, 3, generator=generator)
    values = field.feature_rows[:, :8].contiguous()
    dense = torch.rand(1, 8, size, size, size, generator=generator)
    slot, local = cell // 512, cell % 512
    place = field.topology.keys[slot].float() * 8 + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1) + inside
    grid = (place / (size - 1) * 2 - 1)[None, None, None]
    _ = field.topology.lookup_rows  # made once a topology
    with pinned(1):
        times = compare(
            lambda: gather(values, *corners(field.topology, cell, inside)),
            lambda: F.grid_sample(dense, grid, align_corners=True),
            repetitions,
        )
    return Case("lookup in torch, 8 channels", f"{size}³", "point", points, *times, against="grid_sample on a dense lattice")


def convolution_case(size: int = 64, channels: int = 16, repetitions: int = 5) -> Case:
    """Block-sparse 3×3×3 convolution against a dense one over the same cube."""
    from fieldfuse.nerfusion.block_conv import block_conv3d

    field = sphere_field(size)
    topology, generator = field.topology, torch.Generator().manual_seed(0)
    rows = torch.rand(topology.zero_row, channels, generator=generator) * field.occupied[:, None]
    weight = torch.rand(channels, channels, 3, 3, 3, generator=generator)
    cube = torch.rand(1, channels, size, size, size, generator=generator)
    with pinned(1), torch.no_grad():
        times = compare(
            lambda: block_conv3d(rows, topology, weight, None, field.occupied), lambda: F.conv3d(cube, weight, padding=1), repetitions
        )
    counts = {"blocks": float(topology.blocks), "voxels": float(field.voxels), "dense_voxels": float(size**3)}
    return Case(f"block convolution, {channels} channels", f"{size}³", "voxel", field.voxels, *times, against="dense conv3d", counts=counts)


def key_frame_case(side: int = 48, size: int = 32, repetitions: int = 3) -> Case:
    """Fusing a key frame on two levels against looking everywhere at the finer one. Untrained weights: the work is the same."""
    from fieldfuse.nerfusion.cameras import Cameras
    from fieldfuse.nerfusion.fusion import Fusion, FusionOptions
    from fieldfuse.nerfusion.lattice import Lattice
    from fieldfuse.nerfusion.model import NerfusionModel
    from fieldfuse.volume.space import Space

    state = torch.get_rng_state()
    torch.manual_seed(0)
    model = NerfusionModel().eval()
    torch.set_rng_state(state)
    lenses, poses = [lens(side, side)] * 3, around(24)[:3]
    lattice = Lattice(Space((0.0, 0.0, 0.0), 1.0, 0.0), size)
    picture = np.random.default_rng(0).random((3, 3, side, side), np.float32)
    with pinned(1), torch.no_grad():
        cameras = Cameras.of(lenses, poses)
        encoded = model.encode(torch.from_numpy(picture), cameras)
        times = compare(
            lambda: Fusion(model, lattice, FusionOptions(levels=2, far=4.0)).add(encoded, cameras),
            lambda: Fusion(model, lattice, FusionOptions(levels=1, far=4.0)).add(encoded, cameras),
            repetitions,
        )
    return Case("key frame, two levels", f"{size}³", "frame", 1, *times, against="the fine level everywhere")


def growth_cases(repetitions: int = 5) -> Iterator[Case]:
    """Steps of the compiled engine, one thread; each against the smallest of its kind.

    A ray's time should stay the same, which is an exponent of zero. What grows with images is the memory that random pixels are
    fetched from.
    """
    smallest = sphere_pixels(GROWING_SIDES[0])
    with pinned(1):
        yield from _growing("step by rays a step", "rays", [(rays, sphere_pixels(), rays) for rays in GROWING_RAYS], repetitions)
        sides = [(side, sphere_pixels(side) if side != GROWING_SIDES[0] else smallest, BATCH) for side in GROWING_SIDES]
        yield from _growing("step by width of images", "pixels", sides, repetitions)
        views = [(count, sphere_pixels(GROWING_SIDES[0], count=count), BATCH) for count in GROWING_VIEWS]
        yield from _growing("step by number of images", "images", views, repetitions)


def _growing(name: str, what: str, settings: list[tuple[int, PixelPool, int]], repetitions: int) -> Iterator[Case]:
    """Each setting (size, pixels, rays a step) against the first."""
    field = sphere_field(LATTICE)
    first, rays_of_first = NumbaEngine(field, settings[0][1], threads=1), settings[0][2]
    for size, pool, rays in settings:
        engine = NumbaEngine(sphere_field(LATTICE), pool, threads=1)
        ours, reference = compare(
            lambda e=engine, n=rays: [e.step(n, RATES) for _ in range(4)],  # type: ignore[misc]
            lambda: [first.step(rays_of_first, RATES) for _ in range(4)],
            repetitions,
        )
        yield Case(name, f"{size} {what}", "ray", 4 * rays, ours, reference, against=f"{settings[0][0]} {what}, the whole step")
