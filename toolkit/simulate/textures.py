"""Procedural pictures for surfaces: rich, never repeating, so that features can be matched on them. sRGB float32 in [0, 1]."""

from __future__ import annotations

import cv2
import numpy as np

from fieldfuse.camera import Array

WORDS = ("FIELD", "VOXEL", "FUSE", "LATTICE", "PRISM", "HALO", "RADIANT", "ORBIT", "DEPTH", "KEYFRAME", "SPARSE", "BLOCK", "SURFACE")
FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX)
INKS = (
    (0.16, 0.20, 0.30),
    (0.70, 0.22, 0.16),
    (0.14, 0.42, 0.38),
    (0.84, 0.60, 0.18),
    (0.42, 0.24, 0.44),
    (0.22, 0.36, 0.62),
    (0.92, 0.88, 0.80),
)
CHIPS = ((0.30, 0.29, 0.30), (0.60, 0.37, 0.27), (0.90, 0.88, 0.84), (0.44, 0.50, 0.47), (0.66, 0.55, 0.38), (0.22, 0.26, 0.33))

Generator = np.random.Generator


def noise(rng: Generator, height: int, width: int, coarsest: int, octaves: int) -> Array:
    """(height, width) fractal noise of mean 0 and deviation 1; `coarsest` is the largest feature in pixels."""
    total = np.zeros((height, width), dtype=np.float32)
    for octave in range(octaves):
        cell = max(coarsest / 2**octave, 1.0)
        grid = rng.standard_normal((int(height / cell) + 4, int(width / cell) + 4)).astype(np.float32)
        smooth = cv2.resize(grid, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        top, left = int(rng.integers(0, int(cell) + 1)), int(rng.integers(0, int(cell) + 1))
        total += 0.62**octave * smooth[top : top + height, left : left + width]
    return (total - total.mean()) / (total.std() + 1e-6)


def _ink(colour: Array | tuple[float, float, float]) -> list[int]:
    """A colour in [0, 1] for OpenCV's drawing functions, which smooth edges on 8-bit pictures only."""
    return [int(value) for value in np.round(np.clip(np.asarray(colour), 0, 1) * 255)]


def _canvas(height: int, width: int, colour: Array | tuple[float, float, float]) -> Array:
    return np.full((height, width, 3), _ink(colour), dtype=np.uint8)


def _grained(image: Array, grain: Array, strength: float) -> Array:
    """uint8 picture → float32 in [0, 1], its brightness varied by (H, W) `grain`."""
    return np.clip(image.astype(np.float32) / 255 * (1 + strength * grain[..., None]), 0, 1)


def _any_ink(rng: Generator, low: float = 1.0, high: float = 1.0) -> list[int]:
    return _ink(np.array(INKS[rng.integers(len(INKS))]) * rng.uniform(low, high))


def _polygon(rng: Generator, centre: Array, radius: float) -> Array:
    """A small random convex-ish polygon, in OpenCV's fixed point with 4 fractional bits."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(4, 8))))
    reach = radius * rng.uniform(0.6, 1.2, len(angles))
    points = centre + np.stack([np.cos(angles), np.sin(angles)], axis=1) * reach[:, None]
    return np.round(points * 16).astype(np.int32)


def terrazzo(rng: Generator, height: int, width: int) -> Array:
    """(height, width, 3) polished floor: chips of stone of many sizes and colours in a pale ground."""
    image = _canvas(height, width, (0.76, 0.73, 0.68))
    area = height * width
    for radius, share in ((44, 0.10), (22, 0.18), (10, 0.20), (5, 0.12)):
        for _ in range(int(share * area / (np.pi * radius**2))):
            colour = _ink(np.array(CHIPS[rng.integers(len(CHIPS))]) * rng.uniform(0.75, 1.2) + rng.normal(0, 0.02, 3))
            centre = rng.uniform((0, 0), (width, height))
            cv2.fillPoly(image, [_polygon(rng, centre, radius * rng.uniform(0.5, 1.3))], colour, lineType=cv2.LINE_AA, shift=4)
    return _grained(image, noise(rng, height, width, 160, 7), 0.05)


def picture(rng: Generator, height: int, width: int) -> Array:
    """(height, width, 3) an abstract painting: a gradient, discs, strokes and facets."""
    top, bottom = (np.clip(rng.uniform(low, high) + rng.normal(0, 0.09, 3), 0, 1) for low, high in ((0.55, 0.9), (0.25, 0.6)))
    image = np.round(np.broadcast_to(np.linspace(top, bottom, height)[:, None], (height, width, 3)) * 255).astype(np.uint8)
    for _ in range(26):
        colour = _any_ink(rng, 0.7, 1.25)
        centre = rng.uniform((0, 0), (width, height))
        size = rng.uniform(0.04, 0.22) * min(height, width)
        if rng.random() < 0.4:
            cv2.circle(image, (int(centre[0]), int(centre[1])), int(size), colour, -1, cv2.LINE_AA)
        else:
            cv2.fillPoly(image, [_polygon(rng, centre, size)], colour, lineType=cv2.LINE_AA, shift=4)
    for _ in range(5):
        ends = rng.uniform((0, 0, 0, 0), (width, height, width, height)).astype(int).tolist()
        cv2.line(image, ends[:2], ends[2:], _any_ink(rng), int(rng.integers(1, 5)), cv2.LINE_AA)
    return _grained(image, noise(rng, height, width, 40, 5), 0.06)


def wall(rng: Generator, height: int, width: int, colour: tuple[float, float, float]) -> Array:
    """(height, width, 3) plaster with framed pictures of several sizes; row 0 is the top of the wall."""
    image = _grained(_canvas(height, width, colour), noise(rng, height, width, 130, 8), 0.045)
    columns, rows = 7, 3
    for row in range(rows):
        for column in range(columns):
            cell = np.array([(column + 0.5) * width / columns, (row + 0.5) * height / rows])
            half = rng.uniform(0.30, 0.43, 2) * [width / columns, height / rows]
            left, top = np.round(cell - half).astype(int)
            right, bottom = np.round(cell + half).astype(int)
            image[top - 7 : bottom + 7, left - 7 : right + 7] = np.array(_any_ink(rng, 0.8, 0.8)) / 255
            image[top:bottom, left:right] = picture(rng, bottom - top, right - left)
    return image


def carton(rng: Generator, height: int, width: int) -> Array:
    """(height, width, 3) one printed side of a box: bands, words, a disc, a bar code, scuffs."""
    base = np.array(INKS[rng.integers(len(INKS))]) * rng.uniform(0.9, 1.15) * 0.5 + 0.38
    image = _canvas(height, width, base)
    for _ in range(3):
        y = int(rng.uniform(0, 0.9) * height)
        cv2.rectangle(image, (0, y), (width, y + int(rng.uniform(0.03, 0.16) * height)), _any_ink(rng), -1)
    centre = (int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.2, 0.8) * height))
    radius = rng.uniform(0.10, 0.2) * min(height, width)
    for ring in range(3):
        cv2.circle(image, centre, int(radius * (1 - 0.3 * ring)), _any_ink(rng), -1, cv2.LINE_AA)
    for _ in range(7):
        word, font = WORDS[rng.integers(len(WORDS))], FONTS[rng.integers(len(FONTS))]
        scale = rng.uniform(0.0016, 0.0046) * height
        corner = (int(rng.uniform(-0.05, 0.6) * width), int(rng.uniform(0.1, 0.98) * height))
        cv2.putText(image, word, corner, font, scale, _any_ink(rng), int(rng.integers(1, 4)), cv2.LINE_AA)
    x, y = int(rng.uniform(0.05, 0.6) * width), int(rng.uniform(0.6, 0.85) * height)
    cv2.rectangle(image, (x - 3, y - 3), (x + width // 4, y + height // 9), _ink((0.95, 0.95, 0.95)), -1)
    while x < width:
        x += int(rng.integers(2, 6))
        thick = int(rng.integers(1, 4))
        if x + thick > width * 0.85:
            break
        cv2.rectangle(image, (x, y), (x + thick - 1, y + height // 10), _ink((0.1, 0.1, 0.1)), -1)
        x += thick
    return _grained(image, noise(rng, height, width, 60, 6), 0.05)


def marble(rng: Generator, height: int, width: int) -> Array:
    """(height, width, 3) veined stone on a longitude × latitude map; speckles widen towards the poles, to look round on the ball."""
    dark, light = np.array(INKS[rng.integers(len(INKS) - 1)]), np.array((0.93, 0.90, 0.85))
    bend = noise(rng, height, width, height // 3, 6)
    x = np.linspace(0, 2 * np.pi, width, endpoint=False)[None, :]
    veins = np.abs(np.sin(3 * x + 1.6 * bend)) ** 0.6
    image = np.round((dark + (light - dark) * veins[..., None]) * 255).astype(np.uint8)
    for _ in range(420):
        z = rng.uniform(-0.97, 0.97)
        row = np.arccos(z) / np.pi * height
        size = rng.uniform(0.008, 0.03) * height
        colour = _any_ink(rng, 0.7, 1.2)
        axes = (max(1, int(size / np.sqrt(1 - z * z))), max(1, int(size)))
        cv2.ellipse(image, (int(rng.uniform(0, width)), int(row)), axes, 0, 0, 360, colour, -1, cv2.LINE_AA)
    return _grained(image, noise(rng, height, width, 60, 6), 0.04)
