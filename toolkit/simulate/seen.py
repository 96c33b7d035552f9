"""What a scene answers: rays in, light and geometry out. Procedural and mesh scenes both speak this."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from fieldfuse.camera import Array
from fieldfuse.effects.scenery import Background, Highlights

Tensor = torch.Tensor


@dataclass(frozen=True)
class Rays:
    """Rays of a picture or of any other list. Neighbours in the list should be neighbours in space."""

    origins: Tensor  # (N, 3), or (1, 3) when they start at one place
    directions: Tensor  # (N, 3) unit
    spread: float  # angle between neighbouring rays in radians: what a pixel covers is spread · distance


@dataclass(frozen=True)
class Seen:
    """What rays see, one row a ray."""

    linear: Tensor  # (N, 3) linear light, not clipped
    distance: Tensor  # (N,) metres along the ray, `FAR` where nothing is hit
    normals: Tensor  # (N, 3) unit, world axes, towards the viewer; 0 where nothing is hit
    albedo: Tensor  # (N, 3) linear reflectance
    gloss: Tensor  # (N,)
    part: Tensor  # (N,) int64: changes across visible edges (solid, face, shadow)


@dataclass(frozen=True)
class Mesh:
    """Triangles of a scene's surfaces."""

    vertices: Array  # (V, 3) float64 metres
    triangles: Array  # (F, 3) int64, counter-clockwise from outside


class Scenery(Protocol):
    """A scene that can be filmed. z is up, lengths are metres.

    Attributes:
        free: (2, 3) box in which a camera can move; what stands in it is told by `clearance`.
        focus: (3,) what there is to look at.
        background: what rays see that hit nothing; None: black, at no cost.
        highlights: the lamps' reflection on glossy surfaces; None: none, at no cost.
    """

    free: Array
    focus: Array
    background: Background | None
    highlights: Highlights | None

    @property
    def device(self) -> torch.device:
        """Where tensors live."""

    def see(self, beam: Rays, lit: bool = True) -> Seen:
        """What rays see. Not `lit`: geometry only, light and material are 0."""

    def clearance(self, points: Tensor) -> Tensor:
        """(N,) metres from (N, 3) points to the nearest surface."""

    def mesh(self) -> Mesh:
        """All surfaces as triangles."""
