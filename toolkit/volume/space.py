"""The space that a volume covers: a box in the working frame, or a box with all that lies beyond it contracted around it.

Coordinates here are *normalised*: the region of interest is the cube [-1, 1]³. With a background, a point y outside is moved to
(1 + b - b / n) · y / n with n = max|y| (the contraction of Barron et al., CVPR 2022, in the maximum norm, with a shell of width b),
so that one lattice over [-(1 + b), 1 + b]³ holds everything up to infinity and one rule serves inside and outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

Tensor = torch.Tensor
LIMIT = 1e30  # of the numbers that are read: float32 holds them


@dataclass(frozen=True)
class Space:
    """Region of interest: `centre` (3,) and one `half` size, working units. `shell` is b above; 0: nothing exists outside."""

    centre: tuple[float, float, float]
    half: float
    shell: float = 0.0
    box: tuple[float, float, float] = (1.0, 1.0, 1.0)  # normalised half sizes actually used when there is no shell

    @property
    def extent(self) -> float:
        """Half the side of the lattice's cube in normalised units."""
        return 1.0 + self.shell

    def normalise(self, points: Tensor) -> Tensor:
        """(..., 3) working frame → normalised, not yet contracted."""
        return (points - points.new_tensor(self.centre)) / self.half

    def contract(self, points: Tensor) -> Tensor:
        """(..., 3) normalised → contracted. Identity inside the region (and everywhere without a shell). Differentiable."""
        if self.shell == 0:
            return points
        norm = points.abs().amax(-1, keepdim=True).clamp_min(1.0)
        return points * ((1.0 + self.shell - self.shell / norm) / norm)

    def expand(self, points: Tensor) -> Tensor:
        """Inverse of `contract`; points on or beyond the outer face go to a large but finite distance."""
        if self.shell == 0:
            return points
        norm = points.abs().amax(-1, keepdim=True)
        outer = self.shell / (1.0 + self.shell - norm).clamp_min(1e-4)
        return torch.where(norm > 1.0, points / norm.clamp_min(1.0) * outer, points)

    def to_working(self, points: Tensor) -> Tensor:
        """(..., 3) contracted → working frame."""
        return self.expand(points) * self.half + points.new_tensor(self.centre)

    def to_dict(self) -> dict[str, Any]:
        return {"centre": list(self.centre), "half": self.half, "shell": self.shell, "box": list(self.box)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Space:
        """The way back of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: it is none.
        """
        x, y, z = (float(v) for v in data["centre"])
        bx, by, bz = (float(v) for v in data["box"])
        half, shell = float(data["half"]), float(data["shell"])
        if not all(abs(value) < LIMIT for value in (x, y, z, bx, by, bz, half, shell)):
            raise ValueError("a number of the space is out of range")
        return cls((x, y, z), half, shell, (bx, by, bz))
