"""What builders of procedural scenes share: materials by kind of surface, solids without overlap on a floor, and furniture of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldfuse.camera import Array
from fieldfuse.simulate.materials import PLAIN, WIDTHS, Material, TextureBank
from fieldfuse.simulate.solids import BALL, BOX, CYLINDER, ROOM, Solid, upright

WALLS = ("plaster", "paper", "posters", "bricks", "posters")
Parts = list[tuple[ArrayLike, ArrayLike, int]]  # centre, half size and material of boxes
FLOORS = ("planks", "terrazzo", "tiles", "cloth", "planks")


class Builder:
    """Grows lists of solids and materials; all choices come from one generator."""

    def __init__(self, rng: np.random.Generator, bank: TextureBank) -> None:
        self.rng, self.bank = rng, bank
        self.solids: list[Solid] = []
        self.materials: list[Material] = []
        self.taken: list[tuple[float, float, float]] = []  # x, y, radius on the floor

    def material(
        self, *kinds: str, tint: ArrayLike | None = None, gloss: float = 0.0, sharpness: float = 30.0, width: float | None = None
    ) -> int:
        """A new material of one of the kinds, with a random shift, scale and tint; its number."""
        kind = kinds[self.rng.integers(len(kinds))]
        choices = self.bank.kinds[kind]
        colour = self.tint() if tint is None else np.asarray(tint)
        texture = int(choices[self.rng.integers(len(choices))])
        width = float(self.rng.uniform(*WIDTHS[kind])) if width is None else width
        offset = (float(self.rng.uniform(0, 2)), float(self.rng.uniform(0, 2)))
        red, green, blue = (float(value) for value in colour)
        self.materials.append(Material(texture, width, offset, (red, green, blue), gloss, sharpness))
        return len(self.materials) - 1

    def tint(self, spread: float = 0.14) -> Array:
        """A factor near white, now and then a strong one."""
        rng = self.rng
        level = rng.uniform(0.65, 1.15)
        return np.clip(level * (1 + rng.normal(0, spread * (3 if rng.random() < 0.15 else 1), 3)), 0.08, 1.5)

    def paint(self, gloss: float = 0.0, dark: bool = False) -> int:
        """One even colour."""
        colour = self.rng.uniform(0.01, 0.05, 3) if dark else self.rng.uniform(0.08, 0.85, 3)
        return self.material(PLAIN, tint=colour, gloss=gloss, sharpness=60.0)

    def faces(self, *kinds: str, count: int = 6) -> tuple[int, ...]:
        """Another picture on every face."""
        return tuple(self.material(*kinds) for _ in range(count))

    def add(self, *solids: Solid) -> None:
        self.solids.extend(solids)

    def box(self, centre: ArrayLike, half: ArrayLike, materials: int | tuple[int, ...], degrees: float = 0.0) -> None:
        self.add(upright(BOX, centre, half, materials, degrees))

    def room(self, half: ArrayLike, walls: tuple[int, ...]) -> None:
        """A closed room on the floor z = 0; `half` are half sizes."""
        half = np.asarray(half)
        self.add(upright(ROOM, [0, 0, half[2]], half, walls))

    def place(self, radius: float, low: Array, high: Array, tries: int = 40) -> Array | None:
        """(2,) a free place on the floor for something of this radius, None when none was found."""
        for _ in range(tries):
            at = self.rng.uniform(low, high)
            if all(np.hypot(at[0] - x, at[1] - y) > radius + r for x, y, r in self.taken):
                self.taken.append((float(at[0]), float(at[1]), radius))
                return np.asarray(at)
        return None


def turned(offsets: ArrayLike, degrees: float) -> Array:
    """(N, 3) offsets turned about z."""
    angle = np.deg2rad(degrees)
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.asarray(offsets, dtype=np.float64).reshape(-1, 3).T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def _parts(b: Builder, at: Array, degrees: float, parts: Parts) -> None:
    """Boxes given by (centre, half, material) in the furniture's own axes, its floor point at the origin."""
    centres = turned(np.array([part[0] for part in parts]), degrees) + np.array([at[0], at[1], 0.0])
    for centre, (_, half, material) in zip(centres, parts, strict=True):
        b.box(centre, np.asarray(half), material, degrees)


def table(b: Builder, at: Array, degrees: float, half: Array, height: float) -> None:
    """A top on four legs; things lie on it."""
    wood = b.material("planks", "marble", "cloth")
    leg = b.material("planks", "plain")
    x, y = half[0] - 0.05, half[1] - 0.05
    parts: Parts = [([0, 0, height - 0.02], [half[0], half[1], 0.02], wood)]
    parts += [([i * x, j * y, height / 2 - 0.02], [0.03, 0.03, height / 2 - 0.02], leg) for i in (-1, 1) for j in (-1, 1)]
    _parts(b, at, degrees, parts)
    things(b, at, degrees, half * 0.75, height, int(b.rng.integers(2, 6)))


def chair(b: Builder, at: Array, degrees: float) -> None:
    seat, frame = b.material("cloth", "planks"), b.material("planks", "plain")
    parts: Parts = [([0, 0, 0.45], [0.22, 0.22, 0.025], seat)]
    parts += [([i * 0.19, -0.19, 0.21], [0.02, 0.02, 0.215], frame) for i in (-1, 1)]
    parts += [([i * 0.19, 0.19, 0.45], [0.02, 0.02, 0.45], frame) for i in (-1, 1)]
    parts += [([0, 0.19, 0.78], [0.18, 0.015, 0.1], seat)]
    _parts(b, at, degrees, parts)


def shelf(b: Builder, at: Array, degrees: float, half: Array, height: float) -> None:
    """Boards between two sides, with books and boxes on them."""
    wood, books, depth = b.material("planks"), b.material("books"), half[1]
    boards = int(b.rng.integers(3, 6))
    step = (height - 0.06) / boards
    parts: Parts = [([i * (half[0] - 0.012), 0, height / 2], [0.012, depth, height / 2], wood) for i in (-1, 1)]
    parts.append(([0, depth - 0.01, height / 2], [half[0], 0.01, height / 2], wood))
    for level in range(boards + 1):
        z = 0.05 + level * step
        parts.append(([0, 0, z], [half[0] - 0.01, depth, 0.012], wood))
        if level < boards and b.rng.random() < 0.8:
            wide = half[0] * b.rng.uniform(0.35, 0.9)
            tall = step * b.rng.uniform(0.5, 0.85) / 2
            side = b.rng.uniform(-1, 1) * (half[0] - wide - 0.03)
            cover = books if b.rng.random() < 0.7 else b.material("carton", "picture")
            parts.append(([side, 0.02, z + 0.012 + tall], [wide, depth * 0.75, tall], cover))
    _parts(b, at, degrees, parts)


def cupboard(b: Builder, at: Array, degrees: float, half: Array, height: float) -> None:
    body, knob = b.faces("planks", "carton", "cloth", "tiles"), b.paint(gloss=0.5)
    b.box(np.array([at[0], at[1], height / 2]), np.array([half[0], half[1], height / 2]), body, degrees)
    for side in (-0.06, 0.06):
        centre = turned(np.array([[side, -half[1] - 0.012, height * 0.55]]), degrees)[0] + [at[0], at[1], 0]
        b.add(upright(BALL, centre, [0.018, 0.018, 0.018], knob))
    things(b, at, degrees, half * 0.7, height, int(b.rng.integers(1, 4)))


def sofa(b: Builder, at: Array, degrees: float) -> None:
    stuff, wide = b.material("cloth", "paper"), b.rng.uniform(0.6, 1.0)
    parts: Parts = [([0, 0, 0.21], [wide, 0.42, 0.21], stuff), ([0, 0.34, 0.6], [wide, 0.09, 0.2], stuff)]
    parts += [([i * (wide - 0.09), 0, 0.52], [0.09, 0.42, 0.1], stuff) for i in (-1, 1)]
    _parts(b, at, degrees, parts)
    for side in (-0.5, 0.4):
        centre = turned(np.array([[side * wide, 0.16, 0.55]]), degrees)[0] + [at[0], at[1], 0]
        b.add(upright(BALL, centre, [0.2, 0.08, 0.16], b.material("cloth", "picture"), degrees))


def floor_lamp(b: Builder, at: Array) -> None:
    metal = b.paint(gloss=0.6, dark=b.rng.random() < 0.5)
    tall = b.rng.uniform(1.3, 1.8)
    b.add(upright(CYLINDER, [at[0], at[1], 0.015], [0.14, 0.14, 0.015], metal))
    b.add(upright(CYLINDER, [at[0], at[1], tall / 2], [0.012, 0.012, tall / 2], metal))
    b.add(upright(CYLINDER, [at[0], at[1], tall], [0.17, 0.17, 0.13], b.material("cloth", "paper", width=0.4)))


def plant(b: Builder, at: Array) -> None:
    """A pot and leaves."""
    rng = b.rng
    b.add(upright(CYLINDER, [at[0], at[1], 0.15], [0.15, 0.15, 0.15], b.material("tiles", "bricks", "marble", width=0.4)))
    leaf = b.material("ground", tint=np.array([0.6, 1.3, 0.5]))
    tall = rng.uniform(0.5, 1.1)
    b.add(upright(CYLINDER, [at[0], at[1], 0.3 + tall / 2], [0.015, 0.015, tall / 2], b.material("planks")))
    for _ in range(int(rng.integers(5, 10))):
        angle, out = rng.uniform(0, 360), rng.uniform(0.1, 0.3)
        off = turned(np.array([[out, 0, 0]]), angle)[0]
        centre = [at[0] + off[0], at[1] + off[1], 0.3 + tall * rng.uniform(0.4, 1.1)]
        b.add(upright(BALL, centre, [rng.uniform(0.1, 0.2), rng.uniform(0.03, 0.07), rng.uniform(0.02, 0.05)], leaf, angle))


def stack(b: Builder, at: Array) -> None:
    """Cartons on each other."""
    height, half = 0.0, b.rng.uniform(0.16, 0.3, 3)
    for _ in range(int(b.rng.integers(1, 4))):
        half = half * b.rng.uniform(0.7, 0.95, 3)
        b.box(np.array([at[0], at[1], height + half[2]]), half, b.faces("carton", "carton", "picture"), b.rng.uniform(0, 90))
        height += 2 * half[2]


def things(b: Builder, at: Array, degrees: float, half: Array, height: float, count: int) -> None:
    """Boxes, balls, cups and vases on a flat top of half size (2,), without overlap."""
    rng = b.rng
    used: list[tuple[Array, float]] = []
    for _ in range(count * 6):
        spot = rng.uniform(-half, half)
        size = rng.uniform(0.04, 0.10)
        if any(np.hypot(*(spot - other[0])) < 1.5 * (size + other[1]) for other in used):
            continue
        used.append((spot, size))
        place = turned(np.array([[spot[0], spot[1], 0]]), degrees)[0] + [at[0], at[1], height]
        thing(b, place, size)
        if len(used) == count:
            return


def thing(b: Builder, place: Array, size: float) -> None:
    """One small object of about `size` (its radius) that stands at `place`."""
    rng = b.rng
    gloss = 0.6 if rng.random() < 0.3 else 0.0
    choice = rng.integers(4)
    if choice == 0:
        half = size * rng.uniform(0.6, 1.4, 3)
        b.box(place + np.array([0, 0, half[2]]), half, b.faces("carton", "picture", "books", "tiles"), rng.uniform(0, 180))
    elif choice == 1:
        cover = b.material("marble", "picture", "tiles", gloss=gloss, sharpness=50.0, width=size * 4)
        b.add(upright(BALL, place + np.array([0, 0, size]), [size, size, size], cover))
    elif choice == 2:
        cover = b.material("carton", "picture", "cloth", gloss=gloss, sharpness=40.0, width=size * 4)
        b.add(upright(CYLINDER, place + np.array([0, 0, size]), [size * 0.7, size * 0.7, size], cover))
    else:  # a vase: a belly, a neck
        cover = b.material("marble", "tiles", "paper", gloss=gloss, sharpness=50.0, width=size * 4)
        b.add(upright(BALL, place + np.array([0, 0, size]), [size, size, size * 1.02], cover))
        b.add(upright(CYLINDER, place + np.array([0, 0, size * 2.2]), [size * 0.35, size * 0.35, size * 0.6], cover))
