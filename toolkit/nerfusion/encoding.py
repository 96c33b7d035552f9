"""Encodings of directions and features."""

from __future__ import annotations

import torch

from fieldfuse.backends.constants import DIRECTION as DIRECTION
from fieldfuse.backends.constants import SH as SH

Tensor = torch.Tensor
BEHIND = 9  # of degree 2 and less


def spherical_harmonics(directions: Tensor, count: int = DIRECTION) -> Tensor:
    """(N, 3) unit vectors → (N, count) real spherical harmonics (orthonormal constants), the first not dropped: up to degree 3
    (`DIRECTION`) or 2 (`BEHIND`)."""
    x, y, z = directions.unbind(-1)
    out = [
        torch.full_like(x, SH[0]),
        -SH[1] * y,
        SH[1] * z,
        -SH[1] * x,
        SH[2] * x * y,
        -SH[2] * y * z,
        SH[3] * (3 * z * z - 1),
        -SH[2] * x * z,
        SH[4] * (x * x - y * y),
    ]
    if count > BEHIND:
        out += [
            -SH[5] * y * (3 * x * x - y * y),
            SH[6] * x * y * z,
            -SH[7] * y * (5 * z * z - 1),
            SH[8] * z * (5 * z * z - 3),
            -SH[7] * x * (5 * z * z - 1),
            SH[9] * z * (x * x - y * y),
            -SH[5] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(out, dim=-1)


def positional(values: Tensor, frequencies: int) -> Tensor:
    """(N, C) → (N, C · (1 + 2 · frequencies)): the values, then sin and cos of 2^k π v (NeRFusion uses 5 frequencies on voxel features)."""
    scales = 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype) * torch.pi
    angles = (values[:, None, :] * scales[:, None]).flatten(1)
    return torch.cat([values, torch.sin(angles), torch.cos(angles)], dim=1)
