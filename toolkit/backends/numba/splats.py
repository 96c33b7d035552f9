"""Gaussian splats, compiled: where they lie in an image, tiles, drawing front to back, and the way back to their parameters.

As published by Kerbl et al. (3D Gaussian Splatting, SIGGRAPH 2023): a Gaussian's covariance in the image is Σ' = J W Σ Wᵀ Jᵀ + 0.3 I, its
opacity at a pixel α = o exp(−½ dᵀ Σ'⁻¹ d) ≤ 0.99, none below 1/255; tiles of 16×16 pixels, nothing more where less than 1e-4 of the
light is left. `render/splats.py` says what the parameters are; the tests have a reference in torch. Not part of the gradient: the direction
that a Gaussian that moves is seen from.

What all passes do is shared by Gaussians or by tiles, in a fixed order of sums: the result is the same whatever the number of threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode import encode_direction, sigmoid

F, ZERO, HALF, ONE, TWO = K.F, K.ZERO, K.HALF, K.ONE, K.TWO
TILE = 16  # pixels a side
LANES = 8  # pixels that are computed at once
LOW_PASS = F(0.3)  # square pixels
FAINT = F(1 / 255)  # less than this is not drawn
OPAQUEST = F(0.99)
STOP = F(1e-4)
BESIDE = F(0.3)  # of half the field of view: so far outside the image the projection is linearised where it leaves it
FARTHEST = F(60)  # exponent: long past what is faint
CHECK = 16  # Gaussians after which a tile is looked at: whether any light is left
# Columns of a Gaussian's parameters; harmonics from HARMONICS on, three colours a coefficient.
MEAN, SCALE, ROTATION, OPACITY, HARMONICS = 0, 3, 6, 10, 11
# Columns of a Gaussian in an image: centre, inverse covariance (A B; B C), opacity, colour, depth, half sides of the box around it.
X, Y, A, B, C, PEAK, RED, GREEN, BLUE, DEPTH, WIDE, HIGH = range(12)
PROJECTED = 12
PARTIALS = 9  # sums over the pixels of a tile, for each Gaussian in it
PIXELS = TILE * TILE
LOG2E = F(1.4426950408889634)
# 2^f for f from 0 to 1, Chebyshev's polynomial of degree 5: within 1.1e-7.
LN_FIRST, LN_SECOND = F(math.log(0.9)), F(math.log(0.99))
E0, E1, E2, E3, E4, E5 = F(0.99999988), F(0.69315463), F(0.24014077), F(0.055863284), F(0.0089462148), F(0.0018951073)


class Lens(NamedTuple):
    """A pinhole camera: float32 scalars, and the rotation (3, 3) and translation (3,) to its axes, and its centre (3,)."""

    fx: Any
    fy: Any
    cx: Any
    cy: Any
    width: Any  # int
    height: Any  # int
    near: Any
    rotation: Any
    translation: Any
    centre: Any


@njit(**K.INLINE)
def _exp(value: Any) -> Any:
    """e to a power from −80 to 0, within 3e-7 of it: the compiler makes vectors of this one."""
    scaled = value * LOG2E
    whole = np.floor(scaled)
    f = scaled - whole
    power = np.uint32(np.uint32(np.int32(whole)) + np.uint32(127)) << np.uint32(23)
    return (E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))) * np.uint32(power).view(np.float32)


@njit(**K.INLINE)
def _shape(values: Any, i: Any) -> Any:
    """Unit quaternion, 1 over the norm of the stored one, its rotation, and rotation times scales (rows x, y, z)."""
    w, x, y, z = values[i, ROTATION], values[i, ROTATION + 1], values[i, ROTATION + 2], values[i, ROTATION + 3]
    n = ONE / math.sqrt(max(w * w + x * x + y * y + z * z, F(1e-24)))
    w, x, y, z = w * n, x * n, y * n, z * n
    s0, s1, s2 = F(math.exp(values[i, SCALE])), F(math.exp(values[i, SCALE + 1])), F(math.exp(values[i, SCALE + 2]))
    return (
        (w, x, y, z, n),
        (s0, s1, s2),
        (
            (ONE - TWO * (y * y + z * z)) * s0,
            TWO * (x * y - w * z) * s1,
            TWO * (x * z + w * y) * s2,
            TWO * (x * y + w * z) * s0,
            (ONE - TWO * (x * x + z * z)) * s1,
            TWO * (y * z - w * x) * s2,
            TWO * (x * z - w * y) * s0,
            TWO * (y * z + w * x) * s1,
            (ONE - TWO * (x * x + y * y)) * s2,
        ),
    )


@njit(**K.INLINE)
def _in_camera(values: Any, i: Any, lens: Any) -> Any:
    """Camera coordinates of a Gaussian's centre."""
    r, t = lens.rotation, lens.translation
    x, y, z = values[i, MEAN], values[i, MEAN + 1], values[i, MEAN + 2]
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0],
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1],
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2],
    )


@njit(**K.INLINE)
def _slopes(lens: Any, x: Any, y: Any, z: Any) -> Any:
    """x / z and y / z where the projection is linearised."""
    w, h = F(lens.width), F(lens.height)
    left, right = -lens.cx / lens.fx - BESIDE * HALF * w / lens.fx, (w - lens.cx) / lens.fx + BESIDE * HALF * w / lens.fx
    top, low = -lens.cy / lens.fy - BESIDE * HALF * h / lens.fy, (h - lens.cy) / lens.fy + BESIDE * HALF * h / lens.fy
    return min(max(x / z, left), right), min(max(y / z, top), low)


@njit(**K.INLINE)
def _jacobian(lens: Any, u: Any, v: Any, z: Any) -> Any:
    """J W, rows x and y."""
    r, p, q = lens.rotation, lens.fx / z, lens.fy / z
    return (
        p * (r[0, 0] - u * r[2, 0]),
        p * (r[0, 1] - u * r[2, 1]),
        p * (r[0, 2] - u * r[2, 2]),
        q * (r[1, 0] - v * r[2, 0]),
        q * (r[1, 1] - v * r[2, 1]),
        q * (r[1, 2] - v * r[2, 2]),
    )


@njit(**K.INLINE)
def _spread(t: Any, m: Any) -> Any:
    """J W times rotation times scales: rows x and y, a column an axis of the Gaussian."""
    return (
        t[0] * m[0] + t[1] * m[3] + t[2] * m[6],
        t[0] * m[1] + t[1] * m[4] + t[2] * m[7],
        t[0] * m[2] + t[1] * m[5] + t[2] * m[8],
        t[3] * m[0] + t[4] * m[3] + t[5] * m[6],
        t[3] * m[1] + t[4] * m[4] + t[5] * m[7],
        t[3] * m[2] + t[4] * m[5] + t[5] * m[8],
    )


@njit(**K.LEAF)
def _harmonics(values: Any, i: Any, lens: Any, basis: Any) -> Any:
    """Harmonics of the direction from the camera to a Gaussian into basis[0]; its colour, not clipped."""
    x, y, z = values[i, MEAN] - lens.centre[0], values[i, MEAN + 1] - lens.centre[1], values[i, MEAN + 2] - lens.centre[2]
    n = ONE / math.sqrt(max(x * x + y * y + z * z, F(1e-24)))
    encode_direction(x * n, y * n, z * n, basis, K.START, K.START)
    red, green, blue = HALF, HALF, HALF
    for k in range((values.shape[1] - HARMONICS) // 3):
        red += basis[0, k] * values[i, HARMONICS + 3 * k]
        green += basis[0, k] * values[i, HARMONICS + 3 * k + 1]
        blue += basis[0, k] * values[i, HARMONICS + 3 * k + 2]
    return red, green, blue


@njit(**K.OPTIONS)
def project_pass(values: Any, lens: Any, first: Any, last: Any, projected: Any, box: Any) -> None:
    """Gaussians first … last - 1 of values (N, 11 + 3 · harmonics) as the camera sees them.

    Args:
        projected: (N, PROJECTED) float32, written for what is seen.
        box: (N, 4) int16 tiles x0, x1, y0, y1 that a Gaussian reaches, ends excluded; nothing is seen where x0 = x1.
    """
    basis = np.empty((1, 16), np.float32)
    across, down = (lens.width + TILE - 1) // TILE, (lens.height + TILE - 1) // TILE
    for i in range(first, last):
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = 0, 0, 0, 0
        x, y, z = _in_camera(values, i, lens)
        peak = sigmoid(values[i, OPACITY])
        if not (z > lens.near and peak > FAINT):
            continue
        mx, my = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        _, _, m = _shape(values, i)
        u, v = _slopes(lens, x, y, z)
        t = _spread(_jacobian(lens, u, v, z), m)
        a = t[0] * t[0] + t[1] * t[1] + t[2] * t[2] + LOW_PASS
        b = t[0] * t[3] + t[1] * t[4] + t[2] * t[5]
        c = t[3] * t[3] + t[4] * t[4] + t[5] * t[5] + LOW_PASS
        det = a * c - b * b
        reach = TWO * F(math.log(peak / FAINT))
        wide, high = math.sqrt(a * reach), math.sqrt(c * reach)
        if not (det > ZERO and mx + wide > ZERO and my + high > ZERO and mx - wide < F(lens.width) and my - high < F(lens.height)):
            continue
        x0, x1 = int(max(mx - wide, ZERO)) // TILE, min(int(min(mx + wide, F(lens.width))) // TILE + 1, across)
        y0, y1 = int(max(my - high, ZERO)) // TILE, min(int(min(my + high, F(lens.height))) // TILE + 1, down)
        if x1 <= x0 or y1 <= y0:
            continue
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = x0, x1, y0, y1
        red, green, blue = _harmonics(values, i, lens, basis)
        share = ONE / det
        projected[i, X], projected[i, Y], projected[i, A], projected[i, B], projected[i, C] = mx, my, c * share, -b * share, a * share
        projected[i, PEAK], projected[i, DEPTH], projected[i, WIDE], projected[i, HIGH] = peak, z, wide, high
        projected[i, RED], projected[i, GREEN], projected[i, BLUE] = max(red, ZERO), max(green, ZERO), max(blue, ZERO)


@njit(**K.OPTIONS)
def count_pass(order: Any, box: Any, across: Any, first: Any, last: Any, counts: Any) -> None:
    """How many of the Gaussians `order` each tile of the rows first … last - 1 has: added to counts (tiles,)."""
    for i in order:
        for y in range(max(first, int(box[i, 2])), min(last, int(box[i, 3]))):
            for x in range(box[i, 0], box[i, 1]):
                counts[y * across + x] += 1


@njit(**K.OPTIONS)
def fill_pass(order: Any, box: Any, across: Any, first: Any, last: Any, begin: Any, ahead: Any, entries: Any, places: Any) -> None:
    """The lists of those tiles, in the order of `order`.

    Args:
        begin: (tiles,) where a tile's list goes on; advanced.
        ahead: (N,) entries of all Gaussians before each.
        entries: (E,) int32 Gaussians, tile after tile.
        places: (E,) int32 place among `entries` of a Gaussian's entries, Gaussian after Gaussian.
    """
    for i in order:
        x0, x1, y0 = int(box[i, 0]), int(box[i, 1]), int(box[i, 2])
        for y in range(max(first, y0), min(last, int(box[i, 3]))):
            for x in range(x0, x1):
                place = begin[y * across + x]
                begin[y * across + x] = place + 1
                entries[place] = i
                places[ahead[i] + (y - y0) * (x1 - x0) + x - x0] = place


@njit(**K.INLINE)
def _rows_and_columns(projected: Any, i: Any, left: Any, top: Any) -> Any:
    """Rows, and groups of `LANES` columns, of a tile that a Gaussian reaches: ends excluded."""
    x, y = projected[i, X] - left, projected[i, Y] - top
    y0, y1 = int(max(y - projected[i, HIGH], ZERO)), min(int(max(y + projected[i, HIGH], ZERO)) + 1, TILE)
    x0, x1 = int(max(x - projected[i, WIDE], ZERO)) // LANES, min(int(max(x + projected[i, WIDE], ZERO)) // LANES + 1, TILE // LANES)
    return y0, y1, x0, x1


@njit(**K.LEAF)
def _light_is_left(acc: Any) -> Any:
    most = ZERO
    for k in range(PIXELS):
        most = max(most, acc[k])
    return most >= STOP


@njit(**K.OPTIONS)
def draw_pass(projected: Any, entries: Any, starts: Any, across: Any, first: Any, last: Any, image: Any) -> None:
    """Tiles first … last - 1, composited: image (H, W, 5) red, green, blue, light left, and depth at which half of it is stopped."""
    height, width = image.shape[0], image.shape[1]
    acc = np.empty(5 * PIXELS, np.float32)
    for tile in range(first, last):
        top, left = tile // across * TILE, tile % across * TILE
        for k in range(PIXELS):
            acc[k] = ONE
        for k in range(PIXELS, 5 * PIXELS):
            acc[k] = ZERO
        for e in range(starts[tile], starts[tile + 1]):
            if (e - starts[tile]) % CHECK == CHECK - 1 and not _light_is_left(acc):
                break
            i = entries[e]
            y0, y1, x0, x1 = _rows_and_columns(projected, i, F(left), F(top))
            a, b, c, peak, depth = projected[i, A], projected[i, B], projected[i, C], projected[i, PEAK], projected[i, DEPTH]
            red, green, blue = projected[i, RED], projected[i, GREEN], projected[i, BLUE]
            for y in range(y0, y1):
                dy = F(top + y) + HALF - projected[i, Y]
                across_row, square = b * dy, HALF * c * dy * dy
                for group in range(x0, x1):
                    base = np.uintp(y * TILE + group * LANES)
                    dx0 = F(left + group * LANES) + HALF - projected[i, X]
                    for lane in range(LANES):
                        pixel = base + np.uintp(lane)
                        dx = dx0 + F(np.int32(lane))
                        light = acc[pixel]
                        alpha = min(peak * _exp(-min(max(HALF * a * dx * dx + across_row * dx + square, ZERO), FARTHEST)), OPAQUEST)
                        alpha = alpha if alpha >= FAINT and light >= STOP else ZERO
                        weight = light * alpha
                        after = light - weight
                        acc[pixel] = after
                        acc[pixel + np.uintp(PIXELS)] += weight * red
                        acc[pixel + np.uintp(2 * PIXELS)] += weight * green
                        acc[pixel + np.uintp(3 * PIXELS)] += weight * blue
                        if light > HALF and after <= HALF:
                            acc[pixel + np.uintp(4 * PIXELS)] = depth
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                k = y * TILE + x
                for channel in range(3):
                    image[top + y, left + x, channel] = acc[(channel + 1) * PIXELS + k]
                image[top + y, left + x, 3], image[top + y, left + x, 4] = acc[k], acc[4 * PIXELS + k]


@njit(**K.OPTIONS)
def backward_pass(projected: Any, entries: Any, starts: Any, across: Any, first: Any, last: Any, slope: Any, partials: Any) -> None:
    """∂L/∂ of what each Gaussian is in the image, by the pixels of tiles first … last - 1.

    Front to back a second time: behind a Gaussian is the whole sum less what has been passed.

    Args:
        slope: (H, W, 4) ∂L/∂ of red, green and blue, and Σ of these times the image's colour, with what shines through from behind.
        partials: (E, PARTIALS): Σ q, Σ q dx, Σ q dy, Σ q dx², Σ q dx dy, Σ q dy² with q = −α ∂L/∂α, and ∂L/∂ of red, green and blue.
    """
    height, width = slope.shape[0], slope.shape[1]
    acc = np.zeros(5 * PIXELS, np.float32)  # light left, what is still behind, slopes
    for tile in range(first, last):
        top, left = tile // across * TILE, tile % across * TILE
        for k in range(5 * PIXELS):
            acc[k] = ZERO
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                k = y * TILE + x
                acc[k], acc[PIXELS + k] = ONE, slope[top + y, left + x, 3]
                for channel in range(3):
                    acc[(channel + 2) * PIXELS + k] = slope[top + y, left + x, channel]
        lit = True
        for e in range(starts[tile], starts[tile + 1]):
            s0 = s1 = s2 = s3 = s4 = s5 = ZERO
            d_red = d_green = d_blue = ZERO
            if (e - starts[tile]) % CHECK == CHECK - 1:
                lit = lit and _light_is_left(acc)
            if lit:
                i = entries[e]
                y0, y1, x0, x1 = _rows_and_columns(projected, i, F(left), F(top))
                a, b, c, peak = projected[i, A], projected[i, B], projected[i, C], projected[i, PEAK]
                red, green, blue = projected[i, RED], projected[i, GREEN], projected[i, BLUE]
                for y in range(y0, y1):
                    dy = F(top + y) + HALF - projected[i, Y]
                    across_row, square = b * dy, HALF * c * dy * dy
                    q0 = q1 = q2 = ZERO
                    for group in range(x0, x1):
                        base = np.uintp(y * TILE + group * LANES)
                        dx0 = F(left + group * LANES) + HALF - projected[i, X]
                        for lane in range(LANES):
                            pixel = base + np.uintp(lane)
                            dx = dx0 + F(np.int32(lane))
                            light, behind = acc[pixel], acc[pixel + np.uintp(PIXELS)]
                            full = peak * _exp(-min(max(HALF * a * dx * dx + across_row * dx + square, ZERO), FARTHEST))
                            alpha = min(full, OPAQUEST)
                            alpha = alpha if alpha >= FAINT and light >= STOP else ZERO
                            weight = light * alpha
                            gr, gg = acc[pixel + np.uintp(2 * PIXELS)], acc[pixel + np.uintp(3 * PIXELS)]
                            gb = acc[pixel + np.uintp(4 * PIXELS)]
                            own = red * gr + green * gg + blue * gb
                            behind -= weight * own
                            acc[pixel], acc[pixel + np.uintp(PIXELS)] = light - weight, behind
                            q = alpha * (behind / (ONE - alpha) - light * own)  # −α ∂L/∂α
                            q = q if full < OPAQUEST else ZERO
                            q0 += q
                            q1 += q * dx
                            q2 += q * dx * dx
                            d_red += weight * gr
                            d_green += weight * gg
                            d_blue += weight * gb
                    s0 += q0
                    s1 += q1
                    s2 += q0 * dy
                    s3 += q2
                    s4 += q1 * dy
                    s5 += q0 * dy * dy
            partials[e, 0], partials[e, 1], partials[e, 2], partials[e, 3], partials[e, 4], partials[e, 5] = s0, s1, s2, s3, s4, s5
            partials[e, 6], partials[e, 7], partials[e, 8] = d_red, d_green, d_blue


@njit(**K.LEAF)
def _gradient(values: Any, i: Any, lens: Any, projected: Any, summed: Any, basis: Any, out: Any) -> None:
    """∂L/∂ of Gaussian `i`'s parameters into out (11 + 3 · harmonics,), from the sums over all pixels (PARTIALS,)."""
    a, b, c, peak = projected[i, A], projected[i, B], projected[i, C], projected[i, PEAK]
    s0, s1, s2 = summed[0], summed[1], summed[2]
    out[OPACITY] = -s0 * (ONE - peak)  # −Σ q / o · o (1 − o)
    # Through the inverse covariance: ∂L/∂Σ' = −Σ'⁻¹ (∂L/∂Σ'⁻¹) Σ'⁻¹.
    d_a, d_b, d_c = HALF * summed[3], HALF * summed[4], HALF * summed[5]
    p00, p01, p10, p11 = a * d_a + b * d_b, a * d_b + b * d_c, b * d_a + c * d_b, b * d_b + c * d_c
    g00, g01, g11 = -(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)
    x, y, z = _in_camera(values, i, lens)
    u, v = _slopes(lens, x, y, z)
    (qw, qx, qy, qz, n), scale, m = _shape(values, i)
    t = _jacobian(lens, u, v, z)
    s = _spread(t, m)
    # Σ' = S Sᵀ + low pass, S = T M: ∂L/∂S = 2 G S.
    e0, e1, e2 = TWO * (g00 * s[0] + g01 * s[3]), TWO * (g00 * s[1] + g01 * s[4]), TWO * (g00 * s[2] + g01 * s[5])
    f0, f1, f2 = TWO * (g01 * s[0] + g11 * s[3]), TWO * (g01 * s[1] + g11 * s[4]), TWO * (g01 * s[2] + g11 * s[5])
    # ∂L/∂M = Tᵀ ∂L/∂S, rows x, y, z.
    d00, d01, d02 = t[0] * e0 + t[3] * f0, t[0] * e1 + t[3] * f1, t[0] * e2 + t[3] * f2
    d10, d11, d12 = t[1] * e0 + t[4] * f0, t[1] * e1 + t[4] * f1, t[1] * e2 + t[4] * f2
    d20, d21, d22 = t[2] * e0 + t[5] * f0, t[2] * e1 + t[5] * f1, t[2] * e2 + t[5] * f2
    out[SCALE] = d00 * m[0] + d10 * m[3] + d20 * m[6]
    out[SCALE + 1] = d01 * m[1] + d11 * m[4] + d21 * m[7]
    out[SCALE + 2] = d02 * m[2] + d12 * m[5] + d22 * m[8]
    d00, d10, d20 = d00 * scale[0], d10 * scale[0], d20 * scale[0]
    d01, d11, d21 = d01 * scale[1], d11 * scale[1], d21 * scale[1]
    d02, d12, d22 = d02 * scale[2], d12 * scale[2], d22 * scale[2]
    w_ = TWO * (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01))
    x_ = TWO * (qy * (d01 + d10) + qz * (d02 + d20) + qw * (d21 - d12) - TWO * qx * (d11 + d22))
    y_ = TWO * (qx * (d01 + d10) + qz * (d12 + d21) + qw * (d02 - d20) - TWO * qy * (d00 + d22))
    z_ = TWO * (qx * (d02 + d20) + qy * (d12 + d21) + qw * (d10 - d01) - TWO * qz * (d00 + d11))
    along = w_ * qw + x_ * qx + y_ * qy + z_ * qz
    out[ROTATION], out[ROTATION + 1] = n * (w_ - along * qw), n * (x_ - along * qx)
    out[ROTATION + 2], out[ROTATION + 3] = n * (y_ - along * qy), n * (z_ - along * qz)
    # ∂L/∂T = ∂L/∂S Mᵀ, and T's rows are f / z (R_x − u R_z).
    r = lens.rotation
    gx = gy = hx = hy = ZERO
    for j in range(3):
        m0, m1, m2 = (m[0], m[1], m[2]) if j == 0 else (m[3], m[4], m[5]) if j == 1 else (m[6], m[7], m[8])
        tx, ty = e0 * m0 + e1 * m1 + e2 * m2, f0 * m0 + f1 * m1 + f2 * m2
        gx += tx * r[0, j]
        hx += tx * r[2, j]
        gy += ty * r[1, j]
        hy += ty * r[2, j]
    p, q = lens.fx / z, lens.fy / z
    dx, dy = -(a * s1 + b * s2) * p, -(c * s2 + b * s1) * q  # of the centre in the image
    dz = -(dx * x + dy * y) / z - (p * (gx - u * hx) + q * (gy - v * hy)) / z
    if u == x / z:
        dx -= p * hx / z
        dz += p * hx * u / z
    if v == y / z:
        dy -= q * hy / z
        dz += q * hy * v / z
    for j in range(3):
        out[MEAN + j] = r[0, j] * dx + r[1, j] * dy + r[2, j] * dz
    red, green, blue = _harmonics(values, i, lens, basis)
    red, green, blue = summed[6] if red > ZERO else ZERO, summed[7] if green > ZERO else ZERO, summed[8] if blue > ZERO else ZERO
    for k in range((values.shape[1] - HARMONICS) // 3):
        out[HARMONICS + 3 * k] = basis[0, k] * red
        out[HARMONICS + 3 * k + 1] = basis[0, k] * green
        out[HARMONICS + 3 * k + 2] = basis[0, k] * blue


@njit(**K.LEAF)
def _summed(ahead: Any, i: Any, places: Any, partials: Any, out: Any) -> None:
    """The partial sums of all tiles for Gaussian `i`, in the order of the tiles."""
    for k in range(PARTIALS):
        out[k] = ZERO
    for entry in range(ahead[i], ahead[i + 1]):
        place = places[entry]
        for k in range(PARTIALS):
            out[k] += partials[place, k]


@njit(**K.OPTIONS)
def gradient_pass(values: Any, lens: Any, projected: Any, ahead: Any, places: Any, partials: Any, out: Any) -> None:
    """∂L/∂ of all parameters into out (N, 11 + 3 · harmonics); zero for what is not seen."""
    basis, summed = np.empty((1, 16), np.float32), np.empty(PARTIALS, np.float32)
    for i in range(len(values)):
        if ahead[i + 1] == ahead[i]:
            out[i] = ZERO
            continue
        _summed(ahead, i, places, partials, summed)
        _gradient(values, i, lens, projected, summed, basis, out[i])


class Moments(NamedTuple):
    """Adam's state: first and second moments (N, P) float32, and steps (N,) uint16."""

    first: Any
    second: Any
    steps: Any


@njit(**K.OPTIONS)
def adam_pass(
    values: Any,
    lens: Any,
    projected: Any,
    ahead: Any,
    places: Any,
    partials: Any,
    first: Any,
    last: Any,
    moments: Any,
    rates: Any,
    sizes: Any,
) -> None:
    """A step of Adam (β 0.9, 0.99) for those of the Gaussians first … last - 1 that are seen.

    Args:
        rates: (P,) float32; those of the places are in shares of sizes (N,).
    """
    parameters = values.shape[1]
    basis, summed, out = np.empty((1, 16), np.float32), np.empty(PARTIALS, np.float32), np.empty(parameters, np.float32)
    one, two, steps = moments
    for i in range(first, last):
        if ahead[i + 1] == ahead[i]:
            continue
        _summed(ahead, i, places, partials, summed)
        _gradient(values, i, lens, projected, summed, basis, out)
        steps[i] = min(int(steps[i]) + 1, 65535)
        count = F(steps[i])
        scale1, scale2 = ONE / (ONE - F(math.exp(count * LN_FIRST))), ONE / (ONE - F(math.exp(count * LN_SECOND)))
        for k in range(parameters):
            one[i, k] += F(0.1) * (out[k] - one[i, k])
            two[i, k] += F(0.01) * (out[k] * out[k] - two[i, k])
            move = rates[k] * one[i, k] * scale1 / (math.sqrt(two[i, k] * scale2) + F(1e-15))
            values[i, k] -= move * sizes[i] if k < SCALE else move
