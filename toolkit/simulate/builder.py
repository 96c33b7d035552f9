"""What builders of procedural scenes share: picking materials by kind of surface, and placing solids without overlap on a floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldfuse.camera import Array
from fieldfuse.simulate.materials import PLAIN, Material, TextureBank
from fieldfuse.simulate.solids import BOX, ROOM, Solid, upright

WALLS = ("plaster", "paper", "posters", "bricks", "posters")
FLOORS = ("planks", "terrazzo", "tiles", "cloth", "planks")
WIDTHS = {  # metres that one copy of a texture covers, from and to
    "planks": (0.9, 1.6),
    "bricks": (1.2, 2.2),
    "tiles": (0.8, 1.8),
    "cloth": (0.5, 1.2),
    "books": (0.8, 1.2),
    "ground": (1.0, 2.5),
    "plaster": (1.5, 3.0),
    "paper": (0.8, 1.6),
    "posters": (1.6, 2.6),
    "terrazzo": (1.2, 2.4),
    "carton": (0.35, 0.7),
    "marble": (0.5, 1.2),
    "picture": (0.6, 1.2),
    PLAIN: (1.0, 1.0),
}


class Builder:
    """Grows lists of solids and materials; all choices come from one generator."""

    def __init__(self, rng: np.random.Generator, bank: TextureBank) -> None:
        self.rng, self.bank = rng, bank
        self.solids: list[Solid] = []
        self.materials: list[Material] = []
        self.taken: list[tuple[float, float, float]] = []  # x, y, radius on the floor

    # ---- materials

    def material(
        self, *kinds: str, tint: ArrayLike | None = None, gloss: float = 0.0, sharpness: float = 30.0, width: float | None = None
    ) -> int:
        """A new material of one of the kinds, with a random shift, scale and tint; its number."""
        kind = kinds[self.rng.integers(len(kinds))]
        choices = self.bank.kinds[kind]
        colour = self.tint() if tint is None else np.asarray(tint)
        self.materials.append(
            Material(
                texture=int(choices[self.rng.integers(len(choices))]),
                width=float(self.rng.uniform(*WIDTHS[kind])) if width is None else width,
                offset=(float(self.rng.uniform(0, 2)), float(self.rng.uniform(0, 2))),
                tint=(float(colour[0]), float(colour[1]), float(colour[2])),
                gloss=gloss,
                sharpness=sharpness,
            )
        )
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

    # ---- solids

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
