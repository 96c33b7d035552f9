"""People in a scene: figures of balls and rods who walk through what is there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.effects.scenery import STEPS, Background, Highlights, Walk
from fieldfuse.simulate.eye import Rays, Scenery, Seen
from fieldfuse.simulate.furniture import Builder, turned
from fieldfuse.simulate.materials import Materials, TextureBank, texture_bank
from fieldfuse.simulate.scene import Lamp, Scene
from fieldfuse.simulate.solids import BALL, Mesh, Solids, rod, upright

AMBIENT = ((0.75, 0.75, 0.75), (0.4, 0.4, 0.4))  # of people in a mesh, which has its light in its colours
STRIDE = 0.22  # of the height


class Peopled:
    """A scene with people in it at one instant. Its truth (`clearance`, `mesh`) is that of the scene alone."""

    def __init__(self, scene: Scenery, people: Scene) -> None:
        self.scene, self.people = scene, people
        self.free, self.focus = scene.free, scene.focus
        self.background: Background | None = scene.background
        self.highlights: Highlights | None = scene.highlights

    @property
    def device(self) -> torch.device:
        return self.scene.device

    def see(self, beam: Rays) -> Seen:
        """What rays see: of scene and people what is nearer."""
        there, they = self.scene.see(beam), self.people.see(beam)
        nearer = they.distance < there.distance
        wide = nearer[:, None]
        part = torch.where(nearer, -they.part, there.part)
        linear, normals, albedo = (torch.where(wide, getattr(they, of), getattr(there, of)) for of in ("linear", "normals", "albedo"))
        distance, gloss = (torch.where(nearer, getattr(they, of), getattr(there, of)) for of in ("distance", "gloss"))
        return Seen(linear, distance, normals, albedo, gloss, part)

    def clearance(self, points: torch.Tensor) -> torch.Tensor:
        return self.scene.clearance(points)

    def mesh(self) -> Mesh:
        return self.scene.mesh()


def peopled(scene: Scenery, walks: Sequence[Walk], seconds: float) -> Scenery:
    """The scene with those in it who may be seen at that time; the scene itself when nobody is."""
    here = [walk for walk in walks if walk.near(seconds)]
    if not here:
        return scene
    bank: TextureBank = scene.bank if isinstance(scene, Scene) else texture_bank()
    b = Builder(np.random.default_rng(), bank)
    for walk in here:
        b.rng = np.random.default_rng(walk.looks)
        figure(b, walk, seconds)
    lamps: list[Lamp] = scene.lamps if isinstance(scene, Scene) else []
    ambient = scene.ambient if isinstance(scene, Scene) else AMBIENT
    people = Scene("people", Solids(b.solids), Materials(b.materials), bank, lamps, ambient, scene.free, scene.focus)
    return Peopled(scene, people.to(scene.device))


def figure(b: Builder, walk: Walk, seconds: float) -> None:
    """Head, trunk, arms and legs, in the middle of a step."""
    tall, foot = walk.height, walk.foot_at(seconds)
    degrees = float(np.rad2deg(np.arctan2(walk.velocity[1], walk.velocity[0])))
    top, trousers = b.material("cloth", "posters", "plain", width=0.5), b.material("plain", "cloth", width=0.4)
    skin = b.material("plain", tint=b.rng.uniform(0.25, 0.8) * np.array([1.0, 0.75, 0.6]))
    broad = tall * b.rng.uniform(0.12, 0.15)
    swing = STRIDE * tall * np.sin(2 * np.pi * STEPS * (seconds - walk.moment))

    def at(ahead: float, left: float, up: float) -> Array:
        return np.asarray(foot + turned(np.array([[ahead, left, up * tall]]), degrees)[0])

    b.add(upright(BALL, at(0, 0, 0.93), [0.062 * tall, 0.055 * tall, 0.072 * tall], skin, degrees))
    b.add(upright(BALL, at(0, 0, 0.66), [0.085 * tall, broad, 0.2 * tall], top, degrees))
    for side in (-1, 1):
        b.add(rod(at(0, side * 0.5 * broad, 0.5), at(side * swing, side * 0.5 * broad, 0.0), 0.045 * tall, trousers))
        b.add(rod(at(0, side * 1.05 * broad, 0.8), at(-0.7 * side * swing, side * 1.25 * broad, 0.45), 0.027 * tall, top))
