"""The pixels that a fit may look at, and rays through them; `importance` draws them."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from fieldfuse.capture.types import Views
from fieldfuse.training.depth import ray_distances

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


class PixelPool:
    """The valid pixels of some views, as uint8 on the device, view after view, with what is needed to make their rays.

    A view's pixels are starts[v] … starts[v + 1], in the order of its picture; which place each has in it is kept only where pixels are
    left out. Of a view that counts for less, so many are drawn by lot (always the same ones) as its weight says: rays come evenly from
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
        as they are). Pixels that do not take part go into no mean. The array stays the same: whoever holds it sees the new colours."""
        for index, image in enumerate(views.images):
            begin, end = int(self.starts[index]), int(self.starts[index + 1])
            valid = views.valid[index] if views.valid else None
            colour = softened(image, valid, radius).reshape(-1, 3)
            places = self.places[begin:end].cpu().numpy() if len(self.places) else slice(None)
            self.colour[begin:end] = torch.from_numpy(np.ascontiguousarray(colour[places])).to(self.colour.device)

    @staticmethod
    def _kept(views: Views, index: int) -> np.ndarray[Any, Any] | None:
        """(P,) int32 places of a view's pixels that take part, ascending; None: all."""
        valid, image = views.valid[index] if views.valid else None, views.images[index]
        flat = None if valid is None or valid.all() else np.flatnonzero(valid).astype(np.int32)
        if views.weight and views.weight[index] < 1:
            flat = np.arange(image.shape[0] * image.shape[1], dtype=np.int32) if flat is None else flat
            flat = flat[np.random.default_rng(zlib.crc32(views.names[index].encode())).random(len(flat)) < views.weight[index]]
        return flat

    def __len__(self) -> int:
        return len(self.colour)

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


def softened(image: np.ndarray[Any, Any], valid: np.ndarray[Any, Any] | None, radius: float) -> np.ndarray[Any, Any]:
    """(H, W, 3) uint8 → the same, each of the `valid` (H, W) pixels the mean over a Gaussian with a deviation of `radius` pixels; those
    that are not valid go into no mean, and stay as they are. None: all are valid."""
    if radius <= 0:
        return image
    if valid is None or valid.all():
        return np.asarray(cv2.GaussianBlur(image, (0, 0), radius))
    soft = np.asarray(cv2.GaussianBlur(_filled(image, valid, int(np.ceil(REACH * radius))), (0, 0), radius))
    return np.asarray(cv2.copyTo(image, (~valid).view(np.uint8), soft))


def _filled(image: np.ndarray[Any, Any], valid: np.ndarray[Any, Any], reach: int) -> np.ndarray[Any, Any]:
    """A copy with the pixels that are not `valid` as the mean of those that are, over a square up to `reach` pixels to either side: a
    Gaussian over it takes a quarter of the time of one over a picture with holes. As they were, where nothing valid is as near."""
    side, holes = (2 * reach + 1, 2 * reach + 1), np.flatnonzero(~valid)
    known = valid.view(np.uint8)
    count = cv2.boxFilter(known, cv2.CV_32F, side, normalize=False, borderType=cv2.BORDER_CONSTANT).reshape(-1)[holes]
    total = cv2.boxFilter(cv2.bitwise_and(image, image, mask=known), cv2.CV_32F, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
    out = image.copy()
    told = count > 0
    out.reshape(-1, 3)[holes[told]] = np.rint(total.reshape(-1, 3)[holes[told]] / count[told, None])
    return out
