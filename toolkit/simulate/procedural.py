"""`random_scene`: endless procedural scenes of several kinds, in pure torch and NumPy."""

from __future__ import annotations

import difflib
from collections.abc import Callable

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.simulate import indoors, outdoors
from fieldfuse.simulate.builder import Builder
from fieldfuse.simulate.materials import TextureBank, texture_bank
from fieldfuse.simulate.scene import Scene

BUILDERS: dict[str, Callable[[Builder], Scene]] = {
    "room": indoors.room,
    "table": indoors.object_on_table,
    "corridor": indoors.corridor,
    "wall": indoors.textureless_wall,
    "thin": indoors.thin_structures,
    "sphere": indoors.glossy_sphere,
    "street": outdoors.street,
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
        near = difflib.get_close_matches(kind, KINDS, n=1)
        raise InputError(
            f"there is no scene kind {kind!r}; known are {', '.join(KINDS)}" + (f" (did you mean {near[0]!r}?)" if near else "")
        )
    return BUILDERS[kind](Builder(generator, bank or texture_bank()))
