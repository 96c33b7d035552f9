"""View-dependent highlights: the lamps' reflection on glossy surfaces.

Phong's lobe, energy-scaled by a strength: for each lamp that is not shadowed,

    L += strength · max(gloss, coat) · colour · max(0, r · l)^sharpness,    r = d − 2 (d · n) n

with d the viewing ray's direction, n the surface normal, l the direction to the lamp. `gloss` and `sharpness` belong to the
surface's material; `strength` and `coat` (a varnish that even dull surfaces have) are the effect's.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

Tensor = torch.Tensor


@dataclass(frozen=True)
class Highlights:
    """Parameters of the effect."""

    strength: float = 1.0
    coat: float = 0.0


PRESETS = {"weak": Highlights(0.4, 0.05), "medium": Highlights(1.0, 0.12), "strong": Highlights(2.0, 0.3)}


def forward(effect: Highlights, directions: Tensor, normals: Tensor, to_lamp: Tensor, gloss: Tensor, sharpness: Tensor) -> Tensor:
    """(N,) factor of the lamp's colour that is added, from unit vectors (N, 3) and the materials' gloss and sharpness (N,)."""
    mirrored = directions - 2 * (directions * normals).sum(1, keepdim=True) * normals
    lobe = (mirrored * to_lamp).sum(1).clamp(min=0) ** sharpness
    return effect.strength * gloss.clamp(min=effect.coat) * lobe
