"""Procedural textures for surfaces: rich, never repeating, so that features can be matched on them. sRGB float32 in [0, 1]."""

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

WOODS = ((0.55, 0.38, 0.24), (0.72, 0.55, 0.37), (0.38, 0.25, 0.17), (0.80, 0.67, 0.50), (0.48, 0.42, 0.36))
PAINTS = ((0.86, 0.84, 0.80), (0.78, 0.83, 0.84), (0.84, 0.78, 0.70), (0.72, 0.76, 0.68), (0.88, 0.85, 0.76), (0.66, 0.70, 0.78))
STONES = ((0.62, 0.34, 0.26), (0.70, 0.62, 0.52), (0.55, 0.54, 0.53), (0.74, 0.50, 0.38))

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
    """A colour in [0, 1] for OpenCV's drawing functions, which smooth edges on 8-bit images only."""
    return [int(value) for value in np.round(np.clip(np.asarray(colour), 0, 1) * 255)]


def _canvas(height: int, width: int, colour: Array | tuple[float, float, float]) -> Array:
    return np.full((height, width, 3), _ink(colour), dtype=np.uint8)


def _grained(image: Array, grain: Array, strength: float) -> Array:
    """uint8 image → float32 in [0, 1], its brightness varied by (H, W) `grain`."""
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
