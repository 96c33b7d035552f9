"""Gaussian splats: what they are, and renders of them on the CPU.

The parameters, and what is drawn of them, are those of Kerbl et al. (3D Gaussian Splatting, SIGGRAPH 2023).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from fieldfuse.backends.numba import splats as G
from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.errors import InputError
from fieldfuse.render.image import Rendered
from fieldfuse.threads import share, slices

MOST = 10_000_000  # Gaussians of a file that is read
MAX_DEGREE = 3
SH_0 = 0.28209479177387814  # the constant harmonic
NEAREST = 0.01  # of the Gaussians' median distance: what is nearer to a camera is not drawn
MOST_ENTRIES = 2**27  # Gaussians of all tiles together
PARTS = 16  # pieces of work a thread


@dataclass(frozen=True)
class Splats:
    """Gaussians in one frame, in their files' parameters.

    Attributes:
        values: (N, 11 + 3 K) float32: centre x, y, z; logarithms of the three standard deviations; rotation as a quaternion w, x, y, z, of
            any length; opacity o as log(o / (1 − o)); and K = (degree + 1)² coefficients of real spherical harmonics, red, green and blue
            of each. A colour is 0.5 + Σ_k Y_k(direction from the camera) c_k, sRGB, at least 0.
        origin: (3,) float64 that is added to the centres, for frames whose origin is far away.
    """

    values: Array
    origin: Array

    def __len__(self) -> int:
        return len(self.values)

    @property
    def degree(self) -> int:
        """Of the harmonics, 0 to 3."""
        return round(((self.values.shape[1] - G.HARMONICS) / 3) ** 0.5) - 1

    @property
    def bytes(self) -> int:
        return int(self.values.nbytes)

    @property
    def centres(self) -> Array:
        """(N, 3) float64."""
        return self.values[:, :3].astype(np.float64) + self.origin

    def take(self, which: Array) -> Splats:
        """Those of the Gaussians, by their indices or (N,) bool.

        Raises:
            InputError: none.
        """
        values = self.values[which]
        if not len(values):
            raise InputError("no Gaussian lies in the region that is to be exported; its numbers are in the frame of the input")
        return Splats(np.ascontiguousarray(values), self.origin)

    def render(self, intrinsics: Intrinsics, world_from_camera: Array, background: Array | None = None) -> Rendered:
        """What a pinhole camera at `world_from_camera` (4, 4), in the splats' frame, sees; `background`: (3,), None: black."""
        image = draw(self.values, lens_of(self, intrinsics, world_from_camera)).image
        behind = np.zeros(3, np.float32) if background is None else np.asarray(background, np.float32)
        rgb = np.clip(image[..., :3] + image[..., 3:4] * behind, 0, 1)
        return Rendered(rgb, np.ascontiguousarray(image[..., 4]), 1 - image[..., 3])


class Drawn(NamedTuple):
    """An image, and what the way back needs of it.

    Attributes:
        image: (H, W, 5) float32 red, green, blue on black; share of the light that is left; depth along z (0: none).
        projected, ahead, places, entries, starts: see `backends.numba.splats`.
        across: tiles a row.
    """

    image: Array
    projected: Array
    ahead: Array
    places: Array
    entries: Array
    starts: Array
    across: int


def lens_of(splats: Splats, intrinsics: Intrinsics, world_from_camera: Array, near: float | None = None) -> G.Lens:
    """The camera as kernels have it, relative to the splats' origin.

    Args:
        near: depth before which nothing is drawn; None: `NEAREST` of the median distance.

    Raises:
        InputError: a camera with a distorting lens.
    """
    if intrinsics.distorted:
        raise InputError("splats are drawn for a pinhole camera; use camera.intrinsics.pinhole()")
    pose = np.array(world_from_camera, np.float64)
    pose[:3, 3] -= splats.origin
    if near is None:
        few = splats.values[:: max(1, len(splats) // 4096), :3]
        near = NEAREST * float(np.median(np.linalg.norm(few - pose[:3, 3], axis=1))) if len(few) else 0.0
    return make_lens(intrinsics, pose, near)


def make_lens(intrinsics: Intrinsics, world_from_camera: Array, near: float) -> G.Lens:
    """A pinhole camera as kernels have it."""
    f, back = np.float32, invert(world_from_camera)
    numbers = (f(intrinsics.fx), f(intrinsics.fy), f(intrinsics.cx), f(intrinsics.cy), intrinsics.width, intrinsics.height, f(near))
    rows = (back[:3, :3], back[:3, 3], world_from_camera[:3, 3])
    return G.Lens(*numbers, *(np.ascontiguousarray(row, np.float32) for row in rows))


def draw(values: Array, lens: G.Lens) -> Drawn:
    """Draw Gaussians (N, 11 + 3 K); the same whatever the number of threads.

    Raises:
        InputError: so many are so large that their tiles do not fit into memory.
    """
    threads, count = torch.get_num_threads(), len(values)
    projected, box = np.empty((count, G.PROJECTED), np.float32), np.empty((count, 4), np.int16)
    share(lambda part: G.project_pass(values, lens, part.start, part.stop, projected, box), slices(count, PARTS * threads), threads)
    across, down = -(-lens.width // G.TILE), -(-lens.height // G.TILE)
    reached = (box[:, 1] - box[:, 0]).astype(np.int64) * (box[:, 3] - box[:, 2])
    ahead = np.concatenate([[0], np.cumsum(reached)])
    if ahead[-1] > MOST_ENTRIES:
        raise InputError(f"{count} Gaussians cover {ahead[-1]} tiles of this image, too many to draw; check their unit of length")
    seen = np.flatnonzero(reached)
    order = seen[np.argsort(projected[seen, G.DEPTH], kind="stable")].astype(np.int32)
    counts = np.zeros(across * down, np.int64)
    rows = slices(down, threads)
    share(lambda part: G.count_pass(order, box, across, part.start, part.stop, counts), rows, threads)
    starts = np.concatenate([[0], np.cumsum(counts)])
    begin, entries, places = starts[:-1].copy(), np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    share(lambda part: G.fill_pass(order, box, across, part.start, part.stop, begin, ahead, entries, places), rows, threads)
    image = np.empty((lens.height, lens.width, 5), np.float32)
    parts = slices(across * down, PARTS * threads)
    share(lambda part: G.draw_pass(projected, entries, starts, across, part.start, part.stop, image), parts, threads)
    return Drawn(image, projected, ahead, places, entries, starts, across)


def backward(drawn: Drawn, slope: Array) -> Array:
    """Partial sums of the Gaussians of each tile, from ∂L/∂ of the image; see `backends.numba.splats.backward_pass`."""
    threads, tiles = torch.get_num_threads(), len(drawn.starts) - 1
    partials = np.empty((len(drawn.entries), G.PARTIALS), np.float32)

    def part(piece: slice) -> None:
        G.backward_pass(drawn.projected, drawn.entries, drawn.starts, drawn.across, piece.start, piece.stop, slope, partials)

    share(part, slices(tiles, PARTS * threads), threads)
    return partials


def gradient(values: Array, lens: G.Lens, drawn: Drawn, slope: Array) -> Array:
    """(N, 11 + 3 K) ∂L/∂ of the parameters."""
    out: Any = np.empty_like(values)
    G.gradient_pass(values, lens, drawn.projected, drawn.ahead, drawn.places, backward(drawn, slope), out)
    return out
