"""`random_scene`: endless procedural scenes of several kinds, in pure torch and NumPy.

With a roof: a furnished room, a table with objects, a corridor, a bare wall, thin structures, glossy balls. And a street: houses on both
sides, trees, lamp posts and cars, the sun, and a background so far away that it has no parallax.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fieldfuse.camera import Array
from fieldfuse.config import nearest
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.errors import InputError
from fieldfuse.simulate import furniture
from fieldfuse.simulate.furniture import FLOORS, WALLS, Builder
from fieldfuse.simulate.materials import Materials, TextureBank, texture_bank
from fieldfuse.simulate.scene import Lamp, Scene
from fieldfuse.simulate.solids import BALL, BOX, CYLINDER, Solids, rod, upright

AMBIENT = ((0.30, 0.31, 0.33), (0.22, 0.20, 0.18))
LENGTH = 24.0  # metres from the middle of a street to each end
SUN = 200.0  # metres away


def _walls(b: Builder) -> tuple[int, ...]:
    """Materials of a room's faces: four walls (one of them often another), floor (its +z is the ceiling's side)."""
    common = b.material(*WALLS)
    sides = [common if b.rng.random() < 0.45 else b.material(*WALLS) for _ in range(4)]
    ceiling, floor = b.material("plaster", "planks"), b.material(*FLOORS)
    return (*sides, ceiling, floor)


def _lamps(b: Builder, half: Array, count: int) -> list[Lamp]:
    """Lamps below the ceiling, warm or cold, together about as bright in every room."""
    lamps = []
    for _ in range(count):
        place = b.rng.uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 0.0]) * half
        warmth = b.rng.uniform(-0.12, 0.12)
        level = b.rng.uniform(0.55, 0.9) / count
        colour = (level * (1 + warmth), level, level * (1 - warmth))
        lamps.append(Lamp((place[0], place[1], 2 * half[2] - 0.15), colour, reach=float(half[2] * 2)))
    return lamps


def _within(half: Array, margin: float, low: float, high: float) -> Array:
    """(2, 3) the box of a room between two heights, `margin` away from its walls."""
    inner = half[:2] - margin
    return np.array([[*-inner, low], [*inner, high]])


def _scene(b: Builder, kind: str, half: Array, free: ArrayLike, focus: Array, lamps: int = 2) -> Scene:
    solids, lit = Solids(b.solids), _lamps(b, half, lamps)
    return Scene(kind, solids, Materials(b.materials), b.bank, lit, AMBIENT, np.asarray(free, float), focus)


def _along_wall(b: Builder, half: Array, wall: int, reach: float, depth: float) -> tuple[Array, float] | None:
    """A free place before a wall, for something `reach` wide to each side and `depth` deep: (x, y) and its turn, front to the room."""
    axis, sign = wall // 2, 1 if wall % 2 == 0 else -1
    low, high = np.zeros(2), np.zeros(2)
    low[axis] = high[axis] = sign * (half[axis] - depth - 0.02)
    low[1 - axis], high[1 - axis] = -(half[1 - axis] - reach - 0.05), half[1 - axis] - reach - 0.05
    if low[1 - axis] >= high[1 - axis]:
        return None
    at = b.place(reach, low, high)
    degrees = {0: -90.0, 1: 90.0, 2: 0.0, 3: 180.0}[wall]  # the furniture's back is at its +y
    return None if at is None else (at, degrees)


def room(b: Builder) -> Scene:
    """Furniture along the walls, some of it in the middle, things on it."""
    rng = b.rng
    half = np.array([rng.uniform(2.0, 3.2), rng.uniform(1.8, 2.8), rng.uniform(1.2, 1.5)])
    b.room(half, _walls(b))
    if rng.random() < 0.6:
        rug = b.material("cloth", "paper", "tiles")
        b.box(np.array([*rng.uniform(-0.5, 0.5, 2), 0.006]), np.array([*rng.uniform(0.6, 1.1, 2), 0.006]), rug, rng.uniform(0, 90))
    middle = rng.uniform(-0.35, 0.35, 2) * half[:2] * 0.4
    size = rng.uniform([0.45, 0.35], [0.75, 0.5])
    angle = rng.uniform(0, 180)
    b.taken.append((float(middle[0]), float(middle[1]), float(np.hypot(*size)) + 0.15))
    furniture.table(b, middle, angle, size, rng.uniform(0.45, 0.76))
    for wall in rng.permutation(4):
        for _ in range(int(rng.integers(1, 4))):
            choice = rng.integers(5)
            wide, depth, tall = rng.uniform(0.35, 0.7), rng.uniform(0.16, 0.28), rng.uniform(0.8, 2.0)
            reach = {0: wide, 1: wide, 2: 1.0, 3: 0.28, 4: 0.3}[int(choice)]
            deep = {0: depth, 1: depth, 2: 0.44, 3: 0.24, 4: 0.32}[int(choice)]
            found = _along_wall(b, half, int(wall), reach, deep)
            if found is None:
                continue
            at, degrees = found
            if choice == 0:
                furniture.shelf(b, at, degrees, np.array([wide, depth]), tall)
            elif choice == 1:
                furniture.cupboard(b, at, degrees, np.array([wide, depth]), tall * 0.65)
            elif choice == 2:
                furniture.sofa(b, at, degrees)
            elif choice == 3:
                furniture.chair(b, at, degrees + rng.uniform(-20, 20))
            else:
                (furniture.plant, furniture.floor_lamp, furniture.stack)[rng.integers(3)](b, at)
    for _ in range(2):
        spot = b.place(0.3, -half[:2] * 0.55, half[:2] * 0.55)
        if spot is not None:
            (furniture.chair if rng.random() < 0.5 else lambda b, at, _: furniture.stack(b, at))(b, spot, rng.uniform(0, 360))
    return _scene(b, "room", half, _within(half, 0.45, 0.9, min(1.8, 2 * half[2] - 0.4)), np.array([middle[0], middle[1], 0.5]))


def object_on_table(b: Builder) -> Scene:
    """A table in the middle of a room with a group of objects: to be filmed all round."""
    rng = b.rng
    half = np.array([rng.uniform(1.9, 2.6), rng.uniform(1.9, 2.6), 1.35])
    b.room(half, _walls(b))
    height, size = rng.uniform(0.6, 0.8), rng.uniform([0.35, 0.35], [0.5, 0.5])
    furniture.table(b, np.zeros(2), rng.uniform(0, 90), size, height)
    furniture.things(b, np.zeros(2), 0.0, size * 0.4, height, 4)
    furniture.thing(b, np.array([0.0, 0.0, height]), 0.14)
    for _ in range(3):
        at = b.place(0.3, -half[:2] + 0.35, half[:2] - 0.35)
        if at is not None and np.hypot(*at) > 1.6:
            furniture.stack(b, at)
    return _scene(b, "table", half, _within(half, 0.25, 0.7, 1.7), np.array([0, 0, height + 0.12]))


def corridor(b: Builder) -> Scene:
    """Long and narrow along x, with door frames, pictures, pipes and boxes."""
    rng = b.rng
    half = np.array([rng.uniform(5.0, 8.0), rng.uniform(0.9, 1.3), rng.uniform(1.2, 1.4)])
    b.room(half, _walls(b))
    frame, door = b.material("planks"), b.faces("planks", "tiles", "plain")
    for side in (-1, 1):
        for x in np.arange(-half[0] + rng.uniform(0.8, 1.5), half[0] - 0.8, rng.uniform(1.8, 2.6)):
            y = side * half[1]
            if rng.random() < 0.5:
                b.box(np.array([x, y - side * 0.02, 1.0]), np.array([0.42, 0.02, 1.0]), door)
                for end in (-1, 1):
                    b.box(np.array([x + end * 0.46, y - side * 0.03, 1.03]), np.array([0.05, 0.03, 1.03]), frame)
            elif rng.random() < 0.6:
                b.box(np.array([x, y - side * 0.015, 1.4]), np.array([0.4, 0.015, 0.3]), b.material("picture", "posters", width=0.8))
            else:
                at = np.array([x, side * (half[1] - 0.22)])
                (furniture.stack if rng.random() < 0.6 else furniture.plant)(b, at)
    for y in (-0.3, 0.3):
        b.add(rod([-half[0], y, 2 * half[2] - 0.1], [half[0], y, 2 * half[2] - 0.1], 0.04, b.material("plain", "terrazzo")))
    free = [[-half[0] + 0.6, -half[1] + 0.5, 0.9], [half[0] - 0.6, half[1] - 0.5, 1.7]]
    return _scene(b, "corridor", half, free, np.array([half[0], 0, 1.2]), lamps=3)


def textureless_wall(b: Builder) -> Scene:
    """Bare painted walls all round, few things before one of them: hardly anything to match."""
    rng = b.rng
    half = np.array([rng.uniform(2.0, 2.8), rng.uniform(1.8, 2.4), 1.3])
    bare = b.material("plain", tint=rng.uniform(0.45, 0.8, 3))
    b.room(half, (bare, bare, bare, bare, bare, b.material("plain", tint=rng.uniform(0.25, 0.5, 3))))
    for _ in range(int(rng.integers(1, 4))):
        at = b.place(0.35, np.array([-1.2, half[1] - 0.9]), np.array([1.2, half[1] - 0.4]))
        if at is not None:
            half_box = rng.uniform(0.12, 0.3, 3)
            b.box(np.array([at[0], at[1], half_box[2]]), half_box, b.paint(), rng.uniform(0, 90))
    free = [[-half[0] + 0.4, -half[1] + 0.3, 0.9], [half[0] - 0.4, 0.3, 1.7]]
    return _scene(b, "wall", half, free, np.array([0, half[1], 1.1]))


def thin_structures(b: Builder) -> Scene:
    """A drying rack, wires, a fence and a lattice in a room: most of them a few millimetres thick."""
    rng = b.rng
    half = np.array([rng.uniform(2.0, 2.6), rng.uniform(2.0, 2.6), 1.3])
    b.room(half, _walls(b))
    for x in np.linspace(-0.8, 0.8, 15):  # a fence of upright rods
        b.add(rod([x, 0.6, 0.0], [x, 0.6, 0.95], 0.008, b.paint()))
    for z in (0.1, 0.9):
        b.add(rod([-0.85, 0.6, z], [0.85, 0.6, z], 0.012, b.material("planks")))
    for _ in range(10):  # wires across the room
        start, end = rng.uniform([-0.9, -0.8, 0.3], [-0.5, 0.4, 1.4]), rng.uniform([0.5, -0.8, 0.3], [0.9, 0.4, 1.4])
        b.add(rod(start, end, rng.uniform(0.002, 0.006), b.paint(dark=rng.random() < 0.4)))
    for x in (-0.92, 0.92):
        b.add(rod([x, -0.2, 0], [x, -0.2, 1.5], 0.025, b.material("planks")))
    for angle in np.linspace(0, 180, 7)[:-1]:  # a wheel
        arm = np.array([np.cos(np.deg2rad(angle)), 0, np.sin(np.deg2rad(angle))]) * 0.35
        b.add(rod(np.array([0, -0.4, 0.6]) - arm, np.array([0, -0.4, 0.6]) + arm, 0.005, b.paint()))
    b.add(upright(CYLINDER, [0.0, -0.4, 0.6], [0.04, 0.05, 0.04], b.material("carton", width=0.2)))
    furniture.chair(b, np.array([rng.uniform(-0.6, 0.6), 1.1]), rng.uniform(0, 360))
    return _scene(b, "thin", half, _within(half, 0.3, 0.8, 1.6), np.array([0, 0, 0.6]))


def glossy_sphere(b: Builder) -> Scene:
    """Polished balls on a stand, with highlights that move with the view."""
    rng = b.rng
    half = np.array([rng.uniform(1.9, 2.4), rng.uniform(1.9, 2.4), 1.35])
    b.room(half, _walls(b))
    height = rng.uniform(0.5, 0.7)
    b.box(np.array([0, 0, height / 2]), np.array([0.4, 0.4, height / 2]), b.faces("planks", "marble", "tiles"), rng.uniform(0, 90))
    radius = rng.uniform(0.18, 0.26)
    shiny = b.material("marble", "picture", gloss=0.9, sharpness=float(rng.uniform(30, 120)), width=0.6)
    b.add(upright(BALL, [0, 0, height + radius], [radius] * 3, shiny))
    for angle in rng.uniform(0, 360, 3):
        size = rng.uniform(0.05, 0.08)
        off = np.array([np.cos(angle), np.sin(angle)]) * 0.33
        cover = b.paint(gloss=0.8, dark=rng.random() < 0.3)
        kind = (BALL, CYLINDER, BOX)[rng.integers(3)]
        b.add(upright(kind, [off[0], off[1], height + size], [size] * 3, cover))
    scene = _scene(b, "sphere", half, _within(half, 0.25, 0.7, 1.7), np.array([0, 0, height + radius]))
    scene.highlights = Highlights()
    return scene


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
    ambient, focus = ((0.30, 0.36, 0.46), (0.16, 0.15, 0.13)), np.array([LENGTH, 0.0, 1.6])
    scene = Scene("street", Solids(b.solids), Materials(b.materials), b.bank, [sun], ambient, free, focus)
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


BUILDERS: dict[str, Callable[[Builder], Scene]] = {
    "room": room,
    "table": object_on_table,
    "corridor": corridor,
    "wall": textureless_wall,
    "thin": thin_structures,
    "sphere": glossy_sphere,
    "street": street,
}
KINDS = tuple(BUILDERS)


def random_scene(kind: str, generator: np.random.Generator, bank: TextureBank | None = None) -> Scene:
    """A new scene; equal generators give equal scenes.

    Args:
        kind: "room" (furnished), "table" (objects on a table), "corridor", "wall" (a bare one, little texture), "thin" (rods, wires,
            fences), "sphere" (glossy balls, with highlights) or "street" (with a distant background).
        bank: textures to choose from; None: `texture_bank()`, made once a process.

    Raises:
        InputError: no such kind.
    """
    if kind not in BUILDERS:
        raise InputError(f"there is no scene kind {kind!r}; known are {', '.join(KINDS)}{nearest(kind, KINDS)}")
    return BUILDERS[kind](Builder(generator, bank or texture_bank()))
