"""Encodings of directions and features."""

from __future__ import annotations

import torch

Tensor = torch.Tensor
# Constants of the real spherical harmonics, orthonormal on the sphere: 1; y, z, x; xy, yz, xz; 3z² - 1; x² - y²; and of degree 3
# y(3x² - y²), x(x² - 3y²); xyz; y(5z² - 1), x(5z² - 1); z(5z² - 3); z(x² - y²)
SH = (
    *(0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396),
    *(0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277),
)
DIRECTION = 16  # harmonics of degree 3 and less, which decoders take
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
