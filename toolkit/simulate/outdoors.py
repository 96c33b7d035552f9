"""A street: houses on both sides, trees, lamp posts and cars, the sun, and a background so far away that it has no parallax."""

from __future__ import annotations

import numpy as np

from fieldfuse.effects.scenery import Background
from fieldfuse.simulate.builder import Builder
from fieldfuse.simulate.scene import Lamp, Scene
from fieldfuse.simulate.solids import BALL, rod, upright

LENGTH = 24.0  # metres from the middle to each end
SUN = 200.0  # metres away


def street(b: Builder) -> Scene:
    """Along x; z is up. Both ends are open: there, and above the roofs, the background shows."""
    rng = b.rng
    road = rng.uniform(2.6, 3.6)  # half width
    walk = road + rng.uniform(1.6, 2.4)
    b.box(np.array([0, 0, -0.5]), np.array([60.0, 60.0, 0.5]), b.material("ground", width=4.0))
    pavement = b.material("tiles", "bricks", "terrazzo", width=2.0)
    for side in (-1, 1):
        b.box(np.array([0, side * (road + walk) / 2, 0.06]), np.array([LENGTH, (walk - road) / 2, 0.06]), pavement)
    for x in np.arange(-LENGTH, LENGTH, 3.0):  # the line in the middle
        b.box(np.array([x, 0, 0.004]), np.array([0.7, 0.07, 0.004]), b.material("plaster"))
    for side in (-1, 1):
        x = -LENGTH
        while x < LENGTH - 3:
            wide = rng.uniform(2.5, 5.0)
            if rng.random() < 0.85:
                _house(b, x + wide, side, walk, wide - rng.uniform(0, 0.4))
            x += 2 * wide
        for at in np.arange(-LENGTH + rng.uniform(1, 4), LENGTH, rng.uniform(5, 8)):
            (_tree if rng.random() < 0.5 else _post)(b, at, side * (road + 0.5))
        for at in np.arange(-LENGTH + rng.uniform(2, 6), LENGTH, rng.uniform(6, 11)):
            _car(b, at, side * (road - 1.0))
    angle = rng.uniform(0, 2 * np.pi)
    up = rng.uniform(0.5, 0.9)
    flat = np.sqrt(1 - up * up)
    sun = Lamp((SUN * flat * np.cos(angle), SUN * flat * np.sin(angle), SUN * up), (0.95, 0.88, 0.76), reach=None)
    free = np.array([[-LENGTH * 0.6, -road * 0.6, 1.3], [LENGTH * 0.6, road * 0.6, 2.0]])
    scene = Scene.build(
        "street",
        b.solids,
        b.materials,
        b.bank,
        lamps=[sun],
        ambient=((0.30, 0.36, 0.46), (0.16, 0.15, 0.13)),
        free=free,
        focus=np.array([LENGTH, 0.0, 1.6]),
    )
    scene.background = Background(detail=float(rng.uniform(0.4, 1.0)), seed=int(rng.integers(1 << 30)))
    return scene


def _house(b: Builder, x: float, side: int, edge: float, wide: float) -> None:
    rng = b.rng
    tall, deep = rng.uniform(2.5, 6.0), 3.0
    wall = b.material("bricks", "plaster", "paper", "bricks", width=float(rng.uniform(1.5, 3.0)))
    b.box(np.array([x, side * (edge + deep), tall]), np.array([wide, deep, tall]), wall)
    glass, frame = b.paint(gloss=0.8, dark=True), b.material("plaster")
    front = side * edge
    for z in np.arange(1.5, 2 * tall - 0.8, 2.6):
        for column in np.arange(-wide + 1.0, wide - 0.6, 1.9):
            if z < 2 and rng.random() < 0.25:
                b.box(np.array([x + column, front, 1.05]), np.array([0.5, 0.06, 1.05]), b.material("planks"))
                continue
            b.box(np.array([x + column, front, z]), np.array([0.5, 0.05, 0.75]), frame)
            b.box(np.array([x + column, front, z]), np.array([0.42, 0.07, 0.67]), glass)
    b.box(np.array([x, side * (edge + deep), 2 * tall + 0.1]), np.array([wide + 0.1, deep + 0.25, 0.1]), b.material("tiles", "planks"))


def _tree(b: Builder, x: float, y: float) -> None:
    rng, tall = b.rng, b.rng.uniform(1.8, 2.8)
    b.add(rod([x, y, 0], [x, y, tall], rng.uniform(0.08, 0.16), b.material("planks", width=0.6)))
    leaf = b.material("ground", tint=np.array([0.5, 1.1, 0.4]), width=1.2)
    for _ in range(int(rng.integers(3, 6))):
        centre = np.array([x, y, tall + 0.4]) + rng.uniform([-0.7, -0.7, -0.2], [0.7, 0.7, 1.0])
        b.add(upright(BALL, centre, rng.uniform(0.5, 0.9, 3), leaf))


def _post(b: Builder, x: float, y: float) -> None:
    metal = b.paint(gloss=0.4, dark=True)
    b.add(rod([x, y, 0], [x, y, 4.2], 0.05, metal), rod([x, y, 4.2], [x, y * 0.75, 4.35], 0.03, metal))
    b.add(upright(BALL, [x, y * 0.75, 4.3], [0.16, 0.16, 0.1], b.material("plaster")))


def _car(b: Builder, x: float, y: float) -> None:
    rng = b.rng
    paint, glass, tyre = b.paint(gloss=0.7), b.paint(gloss=0.9, dark=True), b.paint(dark=True)
    b.box(np.array([x, y, 0.62]), np.array([2.0, 0.8, 0.34]), paint)
    b.box(np.array([x - 0.15, y, 1.2]), np.array([1.1, 0.72, 0.26]), glass)
    b.box(np.array([x - 0.15, y, 1.47]), np.array([1.0, 0.7, 0.02]), paint)
    for i in (-1.25, 1.25):
        for j in (-0.72, 0.72):
            b.add(rod([x + i, y + j - 0.1, 0.33], [x + i, y + j + 0.1, 0.33], 0.33, tyre))
    if rng.random() < 0.4:
        b.box(np.array([x, y, 1.6]), np.array([0.5, 0.4, 0.12]), b.faces("carton"))
