"""Where the triangles of a mesh lie in a texture: each has half of a square of its own.

Squares are powers of two, as large as their triangles are, and follow each other along a Z-order curve from large to small, so they fill
the texture without gaps and without a search. Within a size they are ordered by place, so that what is beside each other in the texture is
near each other in space. An atlas of few large charts would need fewer texels, and minutes to be found for a mesh of this size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.tsdf.mesh import Mesh

SMALLEST, LARGEST = 4, 1024  # texels along a square
GUTTER = 3  # texels of a square's side that lie outside of its triangles, so that looking up between texels never leaves them
MIN_TEXELS = 256  # texels along a texture
SEARCH = 24  # halvings that find how large texels are


@dataclass(frozen=True)
class Atlas:
    """The layout of T triangles in a texture of `size` × `size` texels.

    Attributes:
        corner: (T, 2) int32 column and row of the texel in which a triangle's first vertex lies.
        length: (T,) int32 texels from there to the second vertex along the row, and to the third one along the column.
        way: (T,) int32 1: they lie to the right and below, −1: to the left and above.
    """

    size: int
    corner: Array
    length: Array
    way: Array

    def coordinates(self) -> Array:
        """(T, 3, 2) float64 texture coordinates of the vertices, (0, 0) the lower left corner of the image, as OBJ and OpenGL have it."""
        reach = (self.length * self.way)[:, None]
        first = self.corner + 0.5
        second, third = first + reach * np.array([1.0, 0.0]), first + reach * np.array([0.0, 1.0])
        places = np.stack([first, second, third], axis=1) / self.size
        places[..., 1] = 1 - places[..., 1]
        return np.asarray(places)


def make_atlas(mesh: Mesh, density: float, largest: int) -> Atlas:
    """The atlas of a mesh in the smallest texture that holds `density` texels per unit of length on its surface, or as many as fit.

    Args:
        largest: texels along a texture at most, a power of two.

    Raises:
        InputError: not even the smallest squares fit.
    """
    wanted = np.sqrt(2 * mesh.areas())  # along a square that two such triangles fill
    size = MIN_TEXELS
    while size < largest and _room(_sides(wanted * density)) > size * size:
        size *= 2
    low, high = 0.0, density
    if _room(_sides(wanted * density)) <= size * size:
        low = density
    for _ in range(SEARCH if low < density else 0):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _room(_sides(wanted * middle)) <= size * size else (low, middle)
    sides = _sides(wanted * low)
    if _room(sides) > size * size:
        raise InputError(f"{len(sides)} triangles do not fit into a texture of {size}×{size} texels; make the mesh coarser")
    # Large squares first; those of a size by place. Two triangles, one after the other, share a square.
    order = np.lexsort([_z_order(mesh), -sides])
    sides = sides[order]
    starts = np.r_[True, sides[1:] != sides[:-1]] if len(sides) else np.zeros(0, bool)
    number = np.arange(len(sides)) - np.maximum.accumulate(np.where(starts, np.arange(len(sides)), 0))
    second = (number & 1).astype(bool)
    before = np.cumsum(np.where(second, 0, sides.astype(np.int64) ** 2)) - sides.astype(np.int64) ** 2
    x, y = _every_second_bit(before), _every_second_bit(before >> 1)
    corner = np.stack([x, y], axis=1) + np.where(second, sides - 1, 0)[:, None]
    back = np.argsort(order)
    return Atlas(size, corner.astype(np.int32)[back], (sides - GUTTER)[back], np.where(second, -1, 1).astype(np.int32)[back])


def _sides(wanted: Array) -> Array:
    """(T,) wished sides → (T,) int32 powers of two, the next ones above, within bounds."""
    return np.asarray(2 ** np.ceil(np.log2(np.clip(wanted + GUTTER, SMALLEST, LARGEST))), dtype=np.int32)


def _room(sides: Array) -> int:
    """Texels that squares of these sides take, two triangles of a size to a square."""
    sizes, counts = np.unique(sides, return_counts=True)
    return int((sizes.astype(np.int64) ** 2 * -(-counts // 2)).sum())


def _z_order(mesh: Mesh) -> Array:
    """(T,) place of each triangle's middle along a Z-order curve through space."""
    middle = mesh.vertices[mesh.triangles].mean(axis=1)
    low = mesh.bounds()[0]
    cell = ((middle - low) / max(float(np.ptp(mesh.bounds(), axis=0).max()), 1e-30) * 1023).astype(np.int64)
    code = np.zeros(len(middle), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def _every_second_bit(code: Array) -> Array:
    """(N,) int64 → the number that bits 0, 2, 4, … make."""
    out = np.zeros_like(code)
    for bit in range(16):
        out |= ((code >> (2 * bit)) & 1) << bit
    return out
