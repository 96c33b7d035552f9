"""Encodings of directions and features."""

from __future__ import annotations

import torch

Tensor = torch.Tensor


def spherical_harmonics(directions: Tensor) -> Tensor:
    """(N, 3) unit vectors → (N, 9) real spherical harmonics up to degree 2 (orthonormal constants), without the first being dropped."""
    x, y, z = directions.unbind(-1)
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ],
        dim=-1,
    )


def positional(values: Tensor, frequencies: int) -> Tensor:
    """(N, C) → (N, C · (1 + 2 · frequencies)): the values, then sin and cos of 2^k π v (NeRFusion uses 5 frequencies on voxel features)."""
    scales = 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype) * torch.pi
    angles = (values[:, None, :] * scales[:, None]).flatten(1)
    return torch.cat([values, torch.sin(angles), torch.cos(angles)], dim=1)
