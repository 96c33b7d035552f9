"""More procedural pictures, square and sized for a bank: planks, bricks, tiles, cloth, books, ground, plain paint. sRGB float32."""

from __future__ import annotations

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.simulate.textures import INKS, Generator, noise, picture

WOODS = ((0.55, 0.38, 0.24), (0.72, 0.55, 0.37), (0.38, 0.25, 0.17), (0.80, 0.67, 0.50), (0.48, 0.42, 0.36))
PAINTS = ((0.86, 0.84, 0.80), (0.78, 0.83, 0.84), (0.84, 0.78, 0.70), (0.72, 0.76, 0.68), (0.88, 0.85, 0.76), (0.66, 0.70, 0.78))
STONES = ((0.62, 0.34, 0.26), (0.70, 0.62, 0.52), (0.55, 0.54, 0.53), (0.74, 0.50, 0.38))


def _near(rng: Generator, colours: tuple[tuple[float, float, float], ...], spread: float = 0.05) -> Array:
    return np.clip(np.array(colours[rng.integers(len(colours))]) + rng.normal(0, spread, 3), 0.03, 0.97).astype(np.float32)


def planks(rng: Generator, size: int) -> Array:
    """(size, size, 3) boards of wood with grain, side by side."""
    base = _near(rng, WOODS, 0.02)
    image = np.empty((size, size, 3), dtype=np.float32)
    wide = size // int(rng.integers(4, 9))
    for left in range(0, size, wide):
        width = min(wide, size - left)
        grain = cv2.resize(noise(rng, size // 8, width * 2, width, 5), (width, size), interpolation=cv2.INTER_LINEAR)
        rings = np.sin(9 * grain + 14 * np.linspace(0, 1, width)[None] * rng.uniform(0.3, 1.5))
        image[:, left : left + width] = base * rng.uniform(0.75, 1.2) * (1 + 0.10 * grain + 0.06 * rings)[..., None]
        image[:, left : left + 2] *= 0.45
        for top in rng.integers(0, size, 2):
            image[top : top + 2, left : left + width] *= 0.5
    return np.clip(image, 0, 1)


def bricks(rng: Generator, size: int) -> Array:
    """(size, size, 3) masonry: rows of stones, each of its own shade, in mortar."""
    base, mortar = _near(rng, STONES, 0.03), _near(rng, ((0.70, 0.68, 0.64),))
    rows = int(rng.integers(8, 16))
    tall, joint = size / rows, max(2, size // 130)
    long = tall * rng.uniform(1.9, 3.0)
    image = np.broadcast_to(mortar, (size, size, 3)).copy()
    for row in range(rows):
        shift = (row % 2) * long / 2 + rng.uniform(-0.05, 0.05) * long
        for column in range(-1, int(size / long) + 2):
            top, bottom = int(row * tall) + joint, int((row + 1) * tall)
            left, right = int(column * long + shift) + joint, int((column + 1) * long + shift)
            image[top:bottom, max(left, 0) : max(right, 0)] = base * rng.uniform(0.65, 1.25) + rng.normal(0, 0.03, 3)
    return np.clip(image * (1 + 0.09 * noise(rng, size, size, size // 10, 6))[..., None], 0, 1)


def tiles(rng: Generator, size: int) -> Array:
    """(size, size, 3) square tiles of two colours, some with an ornament."""
    count = int(rng.integers(3, 8))
    colours = _near(rng, PAINTS), _near(rng, INKS)
    image = np.empty((size, size, 3), dtype=np.float32)
    edges = np.linspace(0, size, count + 1).astype(int)
    for i in range(count):
        for j in range(count):
            cell = np.empty((edges[i + 1] - edges[i], edges[j + 1] - edges[j], 3), np.float32)
            cell[:] = colours[int((i + j) % 2 == 1 or rng.random() < 0.15)] * rng.uniform(0.8, 1.12)
            if rng.random() < 0.35:
                reach = min(cell.shape[:2])
                ink = _near(rng, INKS).tolist()
                cv2.circle(cell, (reach // 2, reach // 2), int(reach * rng.uniform(0.15, 0.4)), ink, max(1, reach // 14), cv2.LINE_AA)
            cell[:2], cell[:, :2] = 0.35, 0.35
            image[edges[i] : edges[i + 1], edges[j] : edges[j + 1]] = cell
    return np.clip(image * (1 + 0.05 * noise(rng, size, size, size // 6, 6))[..., None], 0, 1)


def cloth(rng: Generator, size: int) -> Array:
    """(size, size, 3) a woven pattern: stripes across stripes, and thread."""
    image = np.zeros((size, size, 3), dtype=np.float32)
    for axis in (0, 1):
        stripes = np.empty((size, 3), dtype=np.float32)
        at = 0
        while at < size:
            wide = int(rng.integers(size // 40, size // 5))
            stripes[at : at + wide] = _near(rng, INKS, 0.1)
            at += wide
        image += 0.5 * (stripes[:, None] if axis else stripes[None])
    thread = 0.05 * np.sin(np.arange(size) * 2.1)
    image *= (1 + thread[:, None] + thread[None] + 0.08 * noise(rng, size, size, size // 4, 7))[..., None]
    return np.clip(image, 0, 1)


def books(rng: Generator, size: int) -> Array:
    """(size, size, 3) two shelves of book spines."""
    image = np.full((size, size, 3), 0.08, dtype=np.float32)
    shelf = size // 2
    for top in (0, shelf):
        at = 0
        while at < size:
            wide = int(rng.integers(size // 40, size // 14))
            tall = int(shelf * rng.uniform(0.68, 0.94))
            colour = _near(rng, INKS, 0.12)
            spine = np.empty((tall, wide, 3), np.float32)
            spine[:] = colour
            for _ in range(int(rng.integers(1, 5))):
                y = int(rng.uniform(0.05, 0.9) * tall)
                spine[y : y + int(rng.integers(2, max(3, tall // 8)))] = _near(rng, INKS, 0.1)
            spine[:, 0] *= 0.5
            spine[:, -1] *= 0.6
            image[top + shelf - tall : top + shelf, at : at + wide] = spine[:, : size - at]
            at += wide + int(rng.random() < 0.15) * size // 50
    return np.clip(image * (1 + 0.05 * noise(rng, size, size, size // 16, 5))[..., None], 0, 1)


def ground(rng: Generator, size: int) -> Array:
    """(size, size, 3) earth, grass or asphalt: noise of many sizes, and pebbles."""
    base, other = _near(rng, ((0.42, 0.42, 0.42), (0.36, 0.44, 0.24), (0.50, 0.42, 0.32), (0.55, 0.54, 0.50))), _near(rng, STONES)
    share = 1 / (1 + np.exp(-2 * noise(rng, size, size, size // 3, 8)))[..., None]
    image = base * share + 0.5 * (base + other) * (1 - share)
    image = np.ascontiguousarray(image * (1 + 0.22 * noise(rng, size, size, 12, 4))[..., None], dtype=np.float32)
    for _ in range(size):
        shade = float(rng.uniform(0.2, 0.85))
        x, y = rng.integers(0, size, 2).tolist()
        cv2.circle(image, (x, y), int(rng.integers(1, max(2, size // 120) + 1)), (shade, shade * 0.97, shade * 0.92), -1, cv2.LINE_AA)
    return np.clip(image, 0, 1)


def plaster(rng: Generator, size: int) -> Array:
    """(size, size, 3) a painted wall: little to hold on to, yet not nothing."""
    paint = _near(rng, PAINTS)
    return np.clip(paint * (1 + 0.05 * noise(rng, size, size, size // 3, 8) + 0.02 * noise(rng, size, size, 5, 2))[..., None], 0, 1)


def paper(rng: Generator, size: int) -> Array:
    """(size, size, 3) wallpaper: motifs in a grid on a pale ground."""
    image = np.ascontiguousarray(np.broadcast_to(_near(rng, PAINTS), (size, size, 3)))
    count = int(rng.integers(5, 11))
    cell = size / count
    motifs = [(_near(rng, INKS, 0.1).tolist(), rng.uniform(0.1, 0.42), rng.uniform(-0.3, 0.3, 2)) for _ in range(3)]
    for i in range(count):
        for j in range(count):
            for ink, radius, off in motifs:
                x, y = (j + 0.5 + off[0]) * cell, (i + 0.5 + off[1] + 0.25 * (j % 2)) * cell
                axes = (max(1, int(radius * cell * rng.uniform(0.7, 1.1))), max(1, int(radius * cell * rng.uniform(0.5, 1))))
                cv2.ellipse(image, (int(x), int(y)), axes, float(rng.uniform(0, 180)), 0, 360, ink, -1, cv2.LINE_AA)
    return np.clip(image * (1 + 0.04 * noise(rng, size, size, size // 4, 7))[..., None], 0, 1)


def posters(rng: Generator, size: int) -> Array:
    """(size, size, 3) a painted wall with a few framed pictures."""
    image = plaster(rng, size)
    for cell in rng.permutation(4)[: int(rng.integers(1, 4))]:
        half = size // 2
        tall, wide = (int(half * rng.uniform(0.45, 0.85)) for _ in range(2))
        top = (cell // 2) * half + int(rng.integers(4, half - tall - 3))
        left = (cell % 2) * half + int(rng.integers(4, half - wide - 3))
        image[top - 4 : top + tall + 4, left - 4 : left + wide + 4] = _near(rng, WOODS) * 0.6
        image[top : top + tall, left : left + wide] = picture(rng, tall, wide)
    return image
