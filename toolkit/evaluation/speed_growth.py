"""How the time of a training step grows with rays a step, with the size of pictures, and with their number: all else stays the same."""

from __future__ import annotations

from collections.abc import Iterator

from fieldfuse.evaluation.speed import Case, compare, pinned
from fieldfuse.evaluation.speed_cases import BATCH, RATES
from fieldfuse.evaluation.speed_state import sphere_field, sphere_pixels
from fieldfuse.training.numba_engine import NumbaOptimiser
from fieldfuse.training.rays import PixelPool

RAYS = (512, 2048, 8192)
SIDES = (48, 96, 192, 384)
VIEWS = (8, 32, 128)
LATTICE = 128


def growth_cases(repetitions: int = 5) -> Iterator[Case]:
    """Steps of the compiled engine, one thread; each against the smallest of its kind.

    A ray's time should stay the same, which is an exponent of zero. What grows with pictures is the memory that random pixels are
    fetched from.
    """
    smallest = sphere_pixels(SIDES[0])
    with pinned(1):
        yield from _growing("step by rays a step", "rays", [(rays, sphere_pixels(), rays) for rays in RAYS], repetitions)
        sides = [(side, sphere_pixels(side) if side != SIDES[0] else smallest, BATCH) for side in SIDES]
        yield from _growing("step by width of pictures", "pixels", sides, repetitions)
        views = [(count, sphere_pixels(SIDES[0], count=count), BATCH) for count in VIEWS]
        yield from _growing("step by number of pictures", "pictures", views, repetitions)


def _growing(name: str, what: str, settings: list[tuple[int, PixelPool, int]], repetitions: int) -> Iterator[Case]:
    """Each setting (size, pixels, rays a step) against the first."""
    field = sphere_field(LATTICE)
    first, rays_of_first = NumbaOptimiser(field, settings[0][1], threads=1), settings[0][2]
    for size, pool, rays in settings:
        engine = NumbaOptimiser(sphere_field(LATTICE), pool, threads=1)
        ours, reference = compare(
            lambda e=engine, n=rays: [e.step(n, RATES) for _ in range(4)],  # type: ignore[misc]
            lambda: [first.step(rays_of_first, RATES) for _ in range(4)],
            repetitions,
        )
        yield Case(name, f"{size} {what}", "ray", 4 * rays, ours, reference, against=f"{settings[0][0]} {what}, the whole step")
