"""Distant background: what rays see that hit nothing, so far away that parallax does not reach it.

A colour for each direction d (unit, z up), the same from every place: with e = arcsin(d_z) the elevation and a the azimuth,

    ground  (e < 0):     haze · (1 − g) + earth · g,                         g = 1 − exp(e / 6°)
    sky     (e ≥ 0):     haze · exp(−e / 12°) + zenith · (1 − exp(−e / 12°)), and clouds over it
    skyline (0 < e < h(a)): towers, each step of azimuth of its own height and shade, with rows of windows

`detail` in [0, 1] scales the contrast of clouds and the height of the skyline: 0 is a plain gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

Tensor = torch.Tensor

HAZE, ZENITH, EARTH = (0.66, 0.72, 0.78), (0.16, 0.32, 0.66), (0.20, 0.19, 0.16)  # linear
TOWERS = 96  # steps of azimuth round the horizon
SOFT = 0.15  # degrees over which roofs fade into the sky, about a pixel


@dataclass(frozen=True)
class Background:
    """Parameters of the effect."""

    detail: float = 0.6
    seed: int = 0
    haze: tuple[float, float, float] = HAZE
    zenith: tuple[float, float, float] = ZENITH
    earth: tuple[float, float, float] = EARTH


PRESETS = {"weak": Background(0.2), "medium": Background(0.6), "strong": Background(1.0)}


def forward(effect: Background, directions: Tensor) -> Tensor:
    """(N, 3) linear colour seen along unit directions (N, 3) in the world, z up."""
    device = directions.device
    haze, zenith, earth = (torch.tensor(c, device=device) for c in (effect.haze, effect.zenith, effect.earth))
    elevation = torch.rad2deg(torch.asin(directions[:, 2].clamp(-1, 1)))[:, None]
    azimuth = torch.atan2(directions[:, 1], directions[:, 0])  # (N,)
    near = torch.exp(-elevation.clamp(min=0) / 12)
    sky = haze * near + zenith * (1 - near)
    if effect.detail > 0:
        cover = effect.detail * _clouds(effect, azimuth, elevation[:, 0])[:, None] * (1 - near)
        sky = sky * (1 - cover) + 0.92 * cover
    depth = torch.exp(elevation.clamp(max=0) / 6)
    colour = torch.where(elevation >= 0, sky, haze * depth + earth * (1 - depth))
    if effect.detail > 0:
        top, shade = skyline(effect, azimuth)
        windows = 0.95 + 0.2 * torch.sin(azimuth * 400) * torch.sin(elevation[:, 0] * 12)
        face = (shade * windows)[:, None] * haze
        behind = ((top - elevation[:, 0]) / SOFT).clamp(0, 1) * (elevation[:, 0] / SOFT + 1).clamp(0, 1)
        colour = torch.lerp(colour, face, behind[:, None])
    return colour


def skyline(effect: Background, azimuth: Tensor) -> tuple[Tensor, Tensor]:
    """Height in degrees and shade in (0, 1) of what stands on the horizon at azimuths (N,) in radians."""
    generator = torch.Generator().manual_seed(effect.seed)
    height = (torch.rand(TOWERS, generator=generator) ** 2 * 14 + 0.8).to(azimuth.device)
    shade = (torch.rand(TOWERS, generator=generator) * 0.6 + 0.2).to(azimuth.device)
    step = ((azimuth / (2 * torch.pi) + 0.5) * TOWERS).long() % TOWERS
    return effect.detail * height[step], shade[step]


def _clouds(effect: Background, azimuth: Tensor, elevation: Tensor) -> Tensor:
    """(N,) cover in [0, 1]: a sum of waves over azimuth and elevation, periodic in azimuth."""
    generator = torch.Generator().manual_seed(effect.seed + 1)
    total = torch.zeros_like(azimuth)
    for octave in range(4):
        turns = torch.randint(2 + 3 * octave, 6 + 5 * octave, (3,), generator=generator)
        slope, phase = torch.rand(2, 3, generator=generator)
        for k in range(3):
            wave = float(turns[k]) * azimuth + (0.05 + 0.3 * float(slope[k])) * (octave + 1) * elevation + 6.28 * float(phase[k])
            total += 0.6**octave * torch.sin(wave)
    return torch.sigmoid(1.5 * total - 0.5)
