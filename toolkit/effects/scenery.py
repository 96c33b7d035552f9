"""What stands before the camera beside the scene itself: a distant background, highlights, people who walk through. Forward models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import Field

from fieldfuse.camera import Array

Tensor = torch.Tensor
Light = Annotated[float, Field(ge=0, le=10)]
Colour = tuple[Light, Light, Light]  # linear
Probability = Annotated[float, Field(ge=0, le=1)]
Reach = Annotated[float, Field(ge=0.05, le=1)]

TOWERS = 96  # steps of azimuth round the horizon
SOFT = 0.15  # degrees over which roofs fade into the sky, about a pixel

TURN = 25.0  # degrees by which people's ways deviate from the right angle to the optical axis
HEIGHTS = (1.55, 1.9)  # metres
EYES = 1.55  # metres: how high above the floor a camera is taken to be held where the floor is not known
STEPS, BOB = 0.9, 0.02  # a second; metres
NEAREST = 0.5  # metres
GOLDEN = 0.6180339887  # multiples of it are spread evenly over a circle, however many there are


@dataclass(frozen=True)
class Highlights:
    """The lamps' reflection on glossy surfaces: Phong's lobe, energy-scaled by a strength. For each lamp that is not shadowed,

        L += strength · max(gloss, coat) · colour · max(0, r · l)^sharpness,    r = d − 2 (d · n) n

    with d the viewing ray's direction, n the surface normal, l the direction to the lamp. `gloss` and `sharpness` belong to the surface's
    material; `strength` and `coat` (a varnish that even dull surfaces have) are the effect's.
    """

    strength: Annotated[float, Field(ge=0, le=100)] = 1.0
    coat: Probability = 0.0

    def forward(self, directions: Tensor, normals: Tensor, to_lamp: Tensor, gloss: Tensor, sharpness: Tensor) -> Tensor:
        """(N,) factor of the lamp's colour that is added, from unit vectors (N, 3) and the materials' gloss and sharpness (N,)."""
        mirrored = directions - 2 * (directions * normals).sum(1, keepdim=True) * normals
        lobe = (mirrored * to_lamp).sum(1).clamp(min=0) ** sharpness
        return self.strength * gloss.clamp(min=self.coat) * lobe


@dataclass(frozen=True)
class Background:
    """Distant background: what rays see that hit nothing, so far away that parallax does not reach it.

    A colour for each direction d (unit, z up), the same from every place: with e = arcsin(d_z) the elevation and a the azimuth,

        ground  (e < 0):     haze · (1 − g) + earth · g,                         g = 1 − exp(e / 6°)
        sky     (e ≥ 0):     haze · exp(−e / 12°) + zenith · (1 − exp(−e / 12°)), and clouds over it
        skyline (0 < e < h(a)): towers, each step of azimuth of its own height and shade, with rows of windows

    `detail` scales the contrast of clouds and the height of the skyline: 0 is a plain gradient.
    """

    detail: Probability = 0.6
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    haze: Colour = (0.66, 0.72, 0.78)
    zenith: Colour = (0.16, 0.32, 0.66)
    earth: Colour = (0.20, 0.19, 0.16)

    def forward(self, directions: Tensor) -> Tensor:
        """(N, 3) linear colour seen along unit directions (N, 3) in the world, z up."""
        device = directions.device
        haze, zenith, earth = (torch.tensor(c, device=device) for c in (self.haze, self.zenith, self.earth))
        elevation = torch.rad2deg(torch.asin(directions[:, 2].clamp(-1, 1)))[:, None]
        azimuth = torch.atan2(directions[:, 1], directions[:, 0])  # (N,)
        near = torch.exp(-elevation.clamp(min=0) / 12)
        sky = haze * near + zenith * (1 - near)
        if self.detail > 0:
            cover = self.detail * self._clouds(azimuth, elevation[:, 0])[:, None] * (1 - near)
            sky = sky * (1 - cover) + 0.92 * cover
        depth = torch.exp(elevation.clamp(max=0) / 6)
        colour = torch.where(elevation >= 0, sky, haze * depth + earth * (1 - depth))
        if self.detail > 0:
            top, shade = self.skyline(azimuth)
            windows = 0.95 + 0.2 * torch.sin(azimuth * 400) * torch.sin(elevation[:, 0] * 12)
            face = (shade * windows)[:, None] * haze
            behind = ((top - elevation[:, 0]) / SOFT).clamp(0, 1) * (elevation[:, 0] / SOFT + 1).clamp(0, 1)
            colour = torch.lerp(colour, face, behind[:, None])
        return colour

    def skyline(self, azimuth: Tensor) -> tuple[Tensor, Tensor]:
        """Height in degrees and shade in (0, 1) of what stands on the horizon at azimuths (N,) in radians."""
        generator = torch.Generator().manual_seed(self.seed)
        height = (torch.rand(TOWERS, generator=generator) ** 2 * 14 + 0.8).to(azimuth.device)
        shade = (torch.rand(TOWERS, generator=generator) * 0.6 + 0.2).to(azimuth.device)
        step = ((azimuth / (2 * torch.pi) + 0.5) * TOWERS).long() % TOWERS
        return self.detail * height[step], shade[step]

    def _clouds(self, azimuth: Tensor, elevation: Tensor) -> Tensor:
        """(N,) cover in [0, 1]: a sum of waves over azimuth and elevation, periodic in azimuth."""
        generator = torch.Generator().manual_seed(self.seed + 1)
        total = torch.zeros_like(azimuth)
        for octave in range(4):
            turns = torch.randint(2 + 3 * octave, 6 + 5 * octave, (3,), generator=generator)
            slope, phase = torch.rand(2, 3, generator=generator)
            for k in range(3):
                wave = float(turns[k]) * azimuth + (0.05 + 0.3 * float(slope[k])) * (octave + 1) * elevation + 6.28 * float(phase[k])
                total += 0.6**octave * torch.sin(wave)
        return torch.sigmoid(1.5 * total - 0.5)


@dataclass(frozen=True)
class Walk:
    """The way of one person."""

    moment: float  # seconds: when the optical axis is crossed
    foot: Array  # (3,) metres: where the feet are then
    velocity: Array  # (3,) metres a second, level
    height: float  # metres
    visible: float  # seconds, about
    looks: int  # seed of clothes and figure

    def foot_at(self, seconds: float) -> Array:
        """(3,) where the feet are."""
        since = seconds - self.moment
        return np.asarray(self.foot + self.velocity * since + [0, 0, BOB * abs(np.sin(2 * np.pi * STEPS * since))])

    def near(self, seconds: float) -> bool:
        """Whether the person may be in the image at all."""
        return abs(seconds - self.moment) < self.visible


@dataclass(frozen=True)
class Pedestrians:
    """People who walk through.

        at(t) = a + v · (t − t₀) + (0, 0, |sin(2π · 0.9 · (t − t₀))| · 2 cm),    |v| · visible time = width of the image there

    Each crosses the optical axis of the camera's pose at a moment t₀, at right angles to it (give or take 25°), at a distance d between
    `near` and `far` of the way to what is looked at. There are as many of them, spread over the capture, as make the sum of the times for
    which they are in the image its `share`. They are real surfaces: they hide and are hidden, and a depth camera measures them; they cast
    no shadow. What is exactly true about a frame (depth, normals) is true of the scene without them.
    """

    share: Probability = 0.4  # of the capture's time with somebody before the camera
    near: Reach = 0.4  # shares of the distance to what is looked at
    far: Reach = 0.75
    speed: Annotated[float, Field(ge=0.05, le=20)] = 1.0  # metres a second

    def walks(
        self, times: Array, world_from_camera: Array, focus: Array, wide: float, floor: float | None, rng: np.random.Generator
    ) -> list[Walk]:
        """Who walks through during a capture.

        Args:
            times: (N,) seconds of the frames. world_from_camera: (N, 4, 4), metres, z up. focus: (3,) what is looked at.
            wide: width of the image over its distance. floor: metres; None: not known.
        """
        whole = float(times[-1] - times[0]) if len(times) > 1 else 0.0
        wanted, spent = self.share * whole, 0.0
        walks: list[Walk] = []
        first = rng.random()
        while spent < wanted or (not walks and self.share > 0):
            moment = float(times[0]) + whole * float((first + GOLDEN * len(walks)) % 1)
            pose = world_from_camera[int(np.argmin(np.abs(times - moment)))]
            distance = max(NEAREST, float(np.linalg.norm(pose[:3, 3] - focus)) * float(rng.uniform(self.near, self.far)))
            speed = self.speed * float(rng.uniform(0.7, 1.3))
            angle = np.arctan2(pose[1, 2], pose[0, 2]) + np.deg2rad(rng.choice([-90, 90]) + rng.uniform(-TURN, TURN))
            ahead = pose[:3, 3] + distance * pose[:3, 2]
            ground = pose[2, 3] - EYES if floor is None else floor
            visible = (distance * wide + 0.6) / max(speed, 1e-3)
            velocity = speed * np.array([np.cos(angle), np.sin(angle), 0.0])
            foot, tall, looks = np.array([ahead[0], ahead[1], ground]), float(rng.uniform(*HEIGHTS)), int(rng.integers(2**31))
            walks.append(Walk(moment, foot, velocity, tall, visible, looks))
            spent += min(visible, max(whole, 1e-9))
        return walks
