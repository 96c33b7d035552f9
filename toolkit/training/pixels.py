"""The pixels of a fit: rays through them, and which of them a step looks at.

More of those where the field was wrong lately are drawn, each counted by how rarely such a pixel is drawn. A step's losses estimate means
over all pixels. The estimate's gradient varies least when a pixel is drawn in proportion to the size of its own gradient, which goes with
the root of its squared error. So every tile of a training image stores the error that rays from it had, and a pixel of it is drawn with a
density

    q = 1 − S + S · min(√e / mean √e, M)

and counts 1 / q in all losses, which leaves their means as they are but for a factor (importance sampling; the paper draws evenly). What
no ray came to has q = 1. Pixels are drawn by lot from evenly drawn ones, so masks and weights of images need no index. Here for any
device; compiled twins are in `backends/numba/train_batch.py`.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from fieldfuse.backends.constants import KEEP, MOST, RENEW, SHARE, TILE, TOP
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views

Tensor = torch.Tensor
REACH = 3.0  # deviations of a Gaussian beyond which nothing counts


@dataclass(frozen=True)
class Batch:
    origins: Tensor  # (B, 3) working frame
    directions: Tensor  # (B, 3) unit
    colour: Tensor  # (B, 3) in [0, 1]
    view: Tensor  # (B,) int64, which of the pool's views
    distance: Tensor | None = None  # (B,) to the surface along the ray, working units, 0: unknown
    weight: Tensor | None = None  # (B,) what each ray counts in the means over the batch; None: 1


def ray_distances(depth: Array, camera: Intrinsics) -> Array:
    """(H, W) float32 depth along z → distance along each pixel's ray; 0, missing, stays 0. The camera is a pinhole."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    length = np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    return np.asarray(np.where(np.isfinite(depth) & (depth > 0), depth * length, 0), dtype=np.float32)


class PixelPool:
    """The valid pixels of some views, as uint8 on the device, view after view, with what is needed to make their rays.

    A view's pixels are starts[v] … starts[v + 1], in the order of its image; which place each has in it is stored only where pixels are
    excluded. Of a view that counts for less, so many are drawn by lot (always the same ones) as its weight says: rays come evenly from
    what is kept.
    """

    def __init__(self, views: Views, device: torch.device | str = "cpu", depth: bool = False) -> None:
        """With `depth` the distances of known surfaces are kept, too, if any view has depth."""
        pixels = [self._kept(views, index) for index in range(len(views))]
        sizes = [lens.width * lens.height if flat is None else len(flat) for flat, lens in zip(pixels, views.intrinsics, strict=True)]
        starts = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)
        count = int(starts[-1])
        colour, some = np.empty((count, 3), np.uint8), any(flat is not None for flat in pixels)
        places = np.empty(count if some else 0, np.int32)
        depths = views.depths if depth and any(one is not None for one in views.depths) else None
        distance = np.zeros(0 if depths is None else count, np.float32)
        for index, flat in enumerate(pixels):
            own, of_picture = slice(starts[index], starts[index + 1]), slice(None) if flat is None else flat
            colour[own] = views.images[index].reshape(-1, 3)[of_picture]
            if some:
                places[own] = np.arange(sizes[index]) if flat is None else flat
            if depths is not None and (known := depths[index]) is not None:
                distance[own] = ray_distances(known, views.intrinsics[index]).reshape(-1)[of_picture]
        self.colour, self.places = torch.from_numpy(colour).to(device), torch.from_numpy(places).to(device)
        self.starts, self.distance = torch.from_numpy(starts).to(device), torch.from_numpy(distance).to(device)
        self.height = max((c.height for c in views.intrinsics), default=0)
        k = [(c.fx, c.fy, c.cx, c.cy, c.width) for c in views.intrinsics]
        self.camera = torch.tensor(k, dtype=torch.float32, device=device)
        self.limit = len(self.colour)  # batches are drawn from the pixels before this one
        self.pose = torch.from_numpy(views.world_from_camera.astype(np.float32)).to(device)

    def soften(self, views: Views, radius: float) -> None:
        """Set the colours to those of the `views` that the pool was made of, as means over a Gaussian of a deviation of `radius` pixels (0:
        as they are). Pixels that do not take part go into no mean. The array stays the same: its views see the new colours."""
        for index, image in enumerate(views.images):
            begin, end = int(self.starts[index]), int(self.starts[index + 1])
            valid = views.valid[index] if views.valid else None
            colour = softened(image, valid, radius).reshape(-1, 3)
            places = self.places[begin:end].cpu().numpy() if len(self.places) else slice(None)
            self.colour[begin:end] = torch.from_numpy(np.ascontiguousarray(colour[places])).to(self.colour.device)

    @staticmethod
    def _kept(views: Views, index: int) -> Array | None:
        """(P,) int32 places of a view's pixels that take part, ascending; None: all."""
        valid, image = views.valid[index] if views.valid else None, views.images[index]
        flat = None if valid is None or valid.all() else np.flatnonzero(valid).astype(np.int32)
        if views.weight and views.weight[index] < 1:
            flat = np.arange(image.shape[0] * image.shape[1], dtype=np.int32) if flat is None else flat
            flat = flat[np.random.default_rng(zlib.crc32(views.names[index].encode())).random(len(flat)) < views.weight[index]]
        return flat

    def __len__(self) -> int:
        return len(self.colour)

    def some(self, parts: Sequence[tuple[int, Tensor]]) -> PixelPool:
        """A pool of its own with some views' pixels.

        Args:
            parts: views, ascending, and of each (≥ H · W,) bool, the places in its image whose pixels are wanted.
        """
        picks, places = [], []
        for view, wanted in parts:
            begin, end = int(self.starts[view]), int(self.starts[view + 1])
            taken = wanted[self.places[begin:end].long()] if len(self.places) else wanted[: end - begin]
            own = taken.nonzero().squeeze(1)
            picks.append(own + begin)
            places.append(self.places[begin:end][own] if len(self.places) else own.int())
        counts, kept = self.starts.new_tensor([0, *map(len, picks)]), self.starts.new_tensor([view for view, _ in parts])
        pick = torch.cat([self.starts[:0], *picks])
        distance = self.distance[pick] if len(self.distance) else self.distance
        arrays = self.colour[pick], torch.cat([self.places[:0], *places]), counts.cumsum(0), distance, self.camera[kept], self.pose[kept]
        return PixelPool.of(arrays, self.height)

    @classmethod
    def of(cls, arrays: Sequence[Tensor], height: int) -> PixelPool:
        """A pool of the tensors that `arrays` gives; `height`: pixels of the tallest image."""
        pool = cls.__new__(cls)
        pool.colour, pool.places, pool.starts, pool.distance, pool.camera, pool.pose = arrays
        pool.height, pool.limit = height, len(pool.colour)
        return pool

    def arrays(self) -> dict[str, Tensor]:
        """The tensors of the pool by name, in the order that `of` takes them."""
        return {name: getattr(self, name) for name in ("colour", "places", "starts", "distance", "camera", "pose")}

    def seen_at(self, pick: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B,) pixels → (B,) int64 views, rows and columns."""
        view = torch.searchsorted(self.starts[1:], pick, right=True)
        place = self.places[pick].long() if len(self.places) else pick - self.starts[view]
        width = self.camera[view, 4].long()
        row = place.div(width, rounding_mode="floor")
        return view, row, place - row * width

    def take(self, pick: Tensor) -> Batch:
        """The rays of the pixels `pick` (B,)."""
        view, row, column = self.seen_at(pick)
        fx, fy, cx, cy, _ = self.camera[view].unbind(1)
        u, v = column.float() + 0.5, row.float() + 0.5
        camera = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u)], 1)
        pose = self.pose[view]
        directions = torch.nn.functional.normalize((pose[:, :3, :3] @ camera[:, :, None]).squeeze(2), dim=1)
        distance = self.distance[pick] if len(self.distance) else None
        return Batch(pose[:, :3, 3], directions, self.colour[pick].float() / 255, view, distance)


def softened(image: Array, valid: Array | None, radius: float) -> Array:
    """(H, W, 3) uint8 → the same, each of the `valid` (H, W) pixels the mean over a Gaussian with a deviation of `radius` pixels; those
    that are not valid go into no mean, and stay as they are. None: all are valid."""
    if radius <= 0:
        return image
    if valid is None or valid.all():
        return np.asarray(cv2.GaussianBlur(image, (0, 0), radius))
    soft = np.asarray(cv2.GaussianBlur(_filled(image, valid, int(np.ceil(REACH * radius))), (0, 0), radius))
    return np.asarray(cv2.copyTo(image, (~valid).view(np.uint8), soft))


def _filled(image: Array, valid: Array, reach: int) -> Array:
    """A copy with the pixels that are not `valid` as the mean of those that are, over a square up to `reach` pixels to either side: a
    Gaussian over it takes a quarter of the time of one over a image with holes. As they were, where nothing valid is as near."""
    side, holes = (2 * reach + 1, 2 * reach + 1), np.flatnonzero(~valid)
    known = valid.view(np.uint8)
    count = cv2.boxFilter(known, cv2.CV_32F, side, normalize=False, borderType=cv2.BORDER_CONSTANT).reshape(-1)[holes]
    total = cv2.boxFilter(cv2.bitwise_and(image, image, mask=known), cv2.CV_32F, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
    out = image.copy()
    near = count > 0
    out.reshape(-1, 3)[holes[near]] = np.rint(total.reshape(-1, 3)[holes[near]] / count[near, None])
    return out


def tile_grid(pool: PixelPool) -> tuple[int, int]:
    """Rows and columns of tiles of the largest image."""
    return int(pool.height) // TILE + 1, int(pool.camera[:, 4].max()) // TILE + 1


class TileErrors:
    """The squared error that rays from each tile had, and the draw of pixels by it."""

    def __init__(self, pool: PixelPool) -> None:
        self.pool, (self.high, self.wide) = pool, tile_grid(pool)
        device = pool.camera.device
        self.error = torch.zeros(len(pool.pose) * self.high * self.wide, device=device)  # (T,) 0: no ray yet
        self.density = torch.ones_like(self.error)
        self.steps = 0

    def tiles(self, picks: Tensor) -> Tensor:
        """(B,) pixels → (B,) tiles."""
        view, row, column = self.pool.seen_at(picks)
        return (view * self.high + row // TILE) * self.wide + column // TILE

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """(count,) pixels before the pool's limit, with replacement, and (count,) what each of them counts."""
        if self.steps % RENEW == 0:
            self.density = densities(self.error)
        self.steps += 1
        device, found, missing = self.error.device, [], count
        while missing > 0:
            more = int(missing * TOP * 1.2) + 16
            picks = torch.randint(self.pool.limit, (more,), generator=generator).to(device)
            luck = torch.rand(more, generator=generator).to(device)
            picks = picks[luck * TOP < self.density[self.tiles(picks)]][:missing]
            found.append(picks)
            missing -= len(picks)
        picks = torch.cat(found)
        return picks, 1 / self.density[self.tiles(picks)]

    def remember(self, picks: Tensor, error: Tensor) -> None:
        """The squared errors (B,) ≥ 0 of the rays of a batch; of several rays of a tile any one counts."""
        tiles = self.tiles(picks)
        old = self.error[tiles]
        self.error[tiles] = torch.where(old > 0, KEEP * old + (1 - KEEP) * error, error)


def densities(error: Tensor) -> Tensor:
    """(T,) squared errors, 0 where no ray came to → (T,) q, between 1 − S and `TOP`."""
    known = error > 0
    root = torch.where(known, error, torch.zeros_like(error)).sqrt()
    mean = root.sum() / known.sum().clamp_min(1)
    ratio = torch.where(known, (root / mean.clamp_min(1e-12)).clamp_max(MOST), torch.ones_like(root))
    return 1 - SHARE + SHARE * ratio
