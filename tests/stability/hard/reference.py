"""Slow, obvious float64 references: loops over Python numbers, nothing shared with what they check."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

Ray = Sequence[float]
Point = tuple[float, float, float]
Cell = tuple[int, int, int]
_EXP_MOST = 700.0


def composite(thickness: Ray) -> tuple[list[float], list[float], float]:
    """Weights and transmittances of one ray's samples, and the transmittance behind the last (NeRFusion eq. 6)."""
    weights, transmittances, before = [], [], 0.0
    for tau in thickness:
        light = math.exp(-min(before, _EXP_MOST))
        transmittances.append(light)
        weights.append(light * -math.expm1(-tau))
        before += tau
    return weights, transmittances, math.exp(-min(before, _EXP_MOST))


def composite_gradient(thickness: Ray, weight_gradient: Ray) -> list[float]:
    """∂L/∂τ for ∂L/∂w of one ray, each entry a sum of its own: ∂w_i/∂τ_i = T_i e^{-τ_i}, ∂w_j/∂τ_i = -w_j for j > i."""
    weights, transmittances, _ = composite(thickness)
    out, behind = [0.0] * len(thickness), 0.0
    for i in range(len(thickness) - 1, -1, -1):
        out[i] = transmittances[i] * math.exp(-min(thickness[i], _EXP_MOST)) * weight_gradient[i] - behind
        behind += weights[i] * weight_gradient[i]
    return out


def distortion(weights: Ray, places: Ray, lengths: Ray) -> tuple[float, list[float]]:
    """Σ_ij w_i w_j |s_i - s_j| + ⅓ Σ w_i² l_i over all pairs, and its gradient with respect to w."""
    loss, gradient = 0.0, []
    for w, s, length in zip(weights, places, lengths, strict=True):
        pull = math.fsum(other * abs(s - place) for other, place in zip(weights, places, strict=True))
        loss += w * pull + w * w * length / 3
        gradient.append(2 * pull + 2 * w * length / 3)
    return loss, gradient


def trilinear(value: Callable[[Cell], float], cell: Cell, inside: Point) -> float:
    """Interpolation between the eight corners of `cell`; `value` answers a lattice corner's value."""
    total = 0.0
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                weight = (inside[0] if dx else 1 - inside[0]) * (inside[1] if dy else 1 - inside[1]) * (inside[2] if dz else 1 - inside[2])
                total += weight * value((cell[0] + dx, cell[1] + dy, cell[2] + dz))
    return total


def crossings(origin: Point, direction: Point, low: Point, voxel: float, count: int) -> list[tuple[float, float, Cell]]:
    """Every voxel of a `count`³ lattice from `low` that a ray passes through, as (distance in, distance out, voxel).

    All distances at which the ray crosses a plane of the lattice are listed and sorted; the voxel between two of them is the one
    that holds the point half-way.
    """
    marks = [0.0]
    for axis in range(3):
        if direction[axis] != 0.0:
            marks += [(low[axis] + i * voxel - origin[axis]) / direction[axis] for i in range(count + 1)]
    marks = sorted(mark for mark in marks if mark >= 0)
    out = []
    for near, far in pairwise(marks):
        if far - near <= 0:
            continue
        middle = 0.5 * (near + far)
        place = [math.floor((origin[axis] + direction[axis] * middle - low[axis]) / voxel) for axis in range(3)]
        if all(0 <= index < count for index in place):
            out.append((near, far, (place[0], place[1], place[2])))
    return out


def convolution(
    values: dict[Cell, list[float]], weight: Sequence[Sequence[Sequence[Sequence[Sequence[float]]]]], bias: Ray, at: Cell
) -> list[float]:
    """One output voxel of a 3×3×3 convolution over the voxels that are there; weight (out, in, z, y, x)."""
    out = []
    for channel, kernel in enumerate(weight):
        total = bias[channel]
        for dz in range(3):
            for dy in range(3):
                for dx in range(3):
                    near = values.get((at[0] + dx - 1, at[1] + dy - 1, at[2] + dz - 1))
                    if near is not None:
                        total += math.fsum(kernel[c][dz][dy][dx] * near[c] for c in range(len(near)))
        out.append(total)
    return out


def ssim(first: Sequence[Sequence[float]], second: Sequence[Sequence[float]]) -> float:
    """Structural similarity of two grey pictures, window by window (Wang et al. 2004, eq. 13; 11×11 Gaussian of 1.5)."""
    line = [math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)]
    whole = math.fsum(line)
    kernel = [[a * b / whole**2 for b in line] for a in line]
    values = []
    for row in range(len(first) - 10):
        for column in range(len(first[0]) - 10):
            cells = [(kernel[y][x], first[row + y][column + x], second[row + y][column + x]) for y in range(11) for x in range(11)]
            mean_a, mean_b = math.fsum(k * a for k, a, _ in cells), math.fsum(k * b for k, _, b in cells)
            var_a = math.fsum(k * (a - mean_a) ** 2 for k, a, _ in cells)
            var_b = math.fsum(k * (b - mean_b) ** 2 for k, _, b in cells)
            both = math.fsum(k * (a - mean_a) * (b - mean_b) for k, a, b in cells)
            values.append((2 * mean_a * mean_b + 1e-4) * (2 * both + 9e-4) / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)))
    return math.fsum(values) / len(values)


def lens(model: str, coefficients: Ray, x: float, y: float) -> tuple[float, float]:
    """OpenCV's lens models written out: (x/z, y/z) → distorted image-plane point."""
    k = list(coefficients) + [0.0] * (8 - len(coefficients))
    if model == "fisheye":
        r = math.hypot(x, y)
        if r == 0:
            return x, y
        theta = math.atan(r)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        return x * bent / r, y * bent / r
    if model == "pinhole":
        return x, y
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
