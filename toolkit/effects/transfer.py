"""Between linear light and what pictures store: the transfer curve of sRGB (IEC 61966-2-1), and 8-bit steps."""

from __future__ import annotations

import torch

Tensor = torch.Tensor

TOE = 0.0031308  # linear value where the straight part near black ends


def encode(linear: Tensor) -> Tensor:
    """Linear light → sRGB, clipped to [0, 1]: 12.92·L for L ≤ 0.0031308, else 1.055·L^(1/2.4) − 0.055."""
    linear = linear.clamp(0, 1)
    return torch.where(linear <= TOE, 12.92 * linear, 1.055 * linear.clamp(min=TOE) ** (1 / 2.4) - 0.055)


def decode(stored: Tensor) -> Tensor:
    """sRGB in [0, 1] → linear light: S / 12.92 for S ≤ 0.04045, else ((S + 0.055) / 1.055)^2.4."""
    stored = stored.clamp(0, 1)
    return torch.where(stored <= 12.92 * TOE, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)


def to_bytes(stored: Tensor) -> Tensor:
    """[0, 1] → uint8, rounded to the nearest step."""
    return (stored.clamp(0, 1) * 255).round().to(torch.uint8)
