"""Encodings of directions and features."""

from __future__ import annotations

import torch

Tensor = torch.Tensor
# Constants of the real spherical harmonics, orthonormal on the sphere: 1; y, z, x; xy, yz, xz; 3z² - 1; x² - y²
SH = (0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396)


def spherical_harmonics(directions: Tensor) -> Tensor:
    """(N, 3) unit vectors → (N, 9) real spherical harmonics up to degree 2 (orthonormal constants), without the first being dropped."""
    x, y, z = directions.unbind(-1)
    return torch.stack(
        [
            torch.full_like(x, SH[0]),
            -SH[1] * y,
            SH[1] * z,
            -SH[1] * x,
            SH[2] * x * y,
            -SH[2] * y * z,
            SH[3] * (3 * z * z - 1),
            -SH[2] * x * z,
            SH[4] * (x * x - y * y),
        ],
        dim=-1,
    )


def positional(values: Tensor, frequencies: int) -> Tensor:
    """(N, C) → (N, C · (1 + 2 · frequencies)): the values, then sin and cos of 2^k π v (NeRFusion uses 5 frequencies on voxel features)."""
    scales = 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype) * torch.pi
    angles = (values[:, None, :] * scales[:, None]).flatten(1)
    return torch.cat([values, torch.sin(angles), torch.cos(angles)], dim=1)
