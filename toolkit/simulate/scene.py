"""A procedural scene: solids, materials, lamps; images, depth and normals of it along any rays, on any torch device."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.simulate.eye import Picture, Rays, Seen, eye_of, take
from fieldfuse.simulate.materials import Materials, TextureBank
from fieldfuse.simulate.solids import ROOM, Mesh, Solids, tessellate

Tensor = torch.Tensor

CORNER = 0.35  # metres: how far the walls of a room darken what is near them
EDGE_SIDE = 2  # rays across a pixel, each way, where it holds an edge


@dataclass(frozen=True)
class Lamp:
    """A small lamp, or the sun."""

    position: tuple[float, float, float]
    colour: tuple[float, float, float]  # linear irradiance on a surface that faces it, at `reach`
    reach: float | None = 2.0  # metres; None: as strong everywhere (the sun; put it far away)


@dataclass
class Scene:
    """Solids with materials under lamps. z is up, lengths are metres.

    Attributes:
        ambient: (above, below) linear light from all directions, on surfaces that face up and down.
        free: (2, 3) box in which a camera can move without leaving the scene; `clearance` finds what stands in it.
        focus: (3,) what there is to look at.
        background: what rays see that hit nothing; None: black, at no cost.
        highlights: the lamps' reflection on glossy materials; None: none, at no cost.
    """

    kind: str
    solids: Solids
    materials: Materials
    bank: TextureBank
    lamps: list[Lamp]
    ambient: tuple[tuple[float, float, float], tuple[float, float, float]]
    free: Array
    focus: Array
    background: Background | None = None
    highlights: Highlights | None = None

    @property
    def device(self) -> torch.device:
        return self.solids.centre.device

    def to(self, device: torch.device | str, bank: TextureBank | None = None) -> Scene:
        """The same scene with its tensors on another device; `bank`: its textures, where they are there already."""
        materials = Materials(self.materials.items, device)
        return replace(self, solids=self.solids.to(device), materials=materials, bank=bank or self.bank.to(device))

    def clearance(self, points: Tensor) -> Tensor:
        """(N,) metres from (N, 3) points to the nearest surface; negative inside a solid or outside the room."""
        return self.solids.clearance(points.to(self.device, torch.float32))

    def mesh(self) -> Mesh:
        """All solids as triangles, also the parts that lie hidden inside or below others."""
        return tessellate(self.solids.items)

    def render(self, intrinsics: Intrinsics, world_from_camera: Array, side: int = EDGE_SIDE) -> Picture:
        """A camera's image, depth and normals, through its lens.

        Args:
            world_from_camera: (4, 4).
            side: pixels that hold an edge are the mean of side × side rays; 1: one ray a pixel everywhere.
        """
        return take(self, eye_of(intrinsics, side, self.device), world_from_camera[None])

    def see(self, beam: Rays) -> Seen:
        """What rays see: light, distance, normals and material, one row a ray."""
        origins, directions = beam.origins, beam.directions
        distance, solid = self.solids.cast(origins, directions)
        hit = (solid >= 0).nonzero()[:, 0]
        every = len(hit) == len(solid)

        def at_hits(values: Tensor) -> Tensor:
            return values if every else values[hit]

        def spread_out(values: Tensor) -> Tensor:
            return values if every else values.new_zeros(len(solid), *values.shape[1:]).index_copy_(0, hit, values)

        ray, far, number = at_hits(directions), at_hits(distance), at_hits(solid)
        start = origins if len(origins) == 1 else at_hits(origins)
        points = start + far[:, None] * ray
        face, place, normals = self.solids.surface(number, points)
        slant = (ray * normals).sum(1).abs().clamp(min=0.1).sqrt()  # between the narrow and the wide side of the footprint
        material = self.solids.materials[number, face]
        albedo = self.materials.albedo(self.bank, material, place, far * beam.spread / slant)
        gloss = self.materials.gloss[material]
        part = number * 6 + face + 1
        linear = albedo * self._ambient(points, normals)
        for lamp in self.lamps:
            light, to_lamp, shadow = self._lamp(lamp, points, normals)
            colour = torch.tensor(lamp.colour, dtype=torch.float32, device=self.device)
            linear = torch.addcmul(linear, albedo * colour, light[:, None])
            if self.highlights is not None:
                shine = self.highlights.forward(ray, normals, to_lamp, gloss, self.materials.sharpness[material])
                linear = torch.addcmul(linear, (shine * (light > 0))[:, None], colour)
            part = 2 * part + shadow
        linear, part = spread_out(linear), spread_out(part)
        if not every and self.background is not None:
            missed = (solid < 0).nonzero()[:, 0]
            linear[missed] = self.background.forward(directions[missed])
        return Seen(linear, distance, spread_out(normals), spread_out(albedo), spread_out(gloss), part)

    def _ambient(self, points: Tensor, normals: Tensor) -> Tensor:
        """(N, 3) light from all around: by the normal's height, less near a room's walls."""
        above, below = (torch.tensor(colour, dtype=torch.float32, device=self.device) for colour in self.ambient)
        share = 0.5 + 0.5 * normals[:, 2:]
        light = below + share * (above - below)
        first, last = self.solids.ranges[ROOM]
        for room in range(first, last):
            turn = self.solids.rotation[room]
            local = (points - self.solids.centre[room]) @ turn
            gap = (self.solids.half[room] - local.abs()).clamp(min=0)
            away = 1 - (normals @ turn).abs()
            light = light * (1 - 0.4 * away * torch.exp(-gap / CORNER)).prod(1, keepdim=True)
        return light

    def _lamp(self, lamp: Lamp, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N,) light of one lamp that arrives, unit directions to it (N, 3), and (N,) int64 1 where it is shadowed."""
        position = torch.tensor([lamp.position], dtype=torch.float32, device=self.device)
        gap = position - points
        distance = gap.norm(dim=1)
        to_lamp = gap / distance[:, None]
        facing = (to_lamp * normals).sum(1)
        light = facing.clamp(min=0)
        if lamp.reach is not None:
            light = light * (2 * lamp.reach**2 / (lamp.reach**2 + distance.square()))
        lit = (facing > 0).nonzero()[:, 0]
        # From the lamp to the points: all rays start at one place, and neighbours stay neighbours.
        reached, _ = self.solids.cast(position, -to_lamp[lit])
        blocked = reached < distance[lit] * (1 - 1e-3) - 2e-3
        shadow = torch.zeros(len(points), dtype=torch.int64, device=self.device)
        shadow[lit] = blocked.long()
        return light * (1 - shadow), to_lamp, shadow
