"""The pixels that a fit may look at, and rays through them; `importance` draws them."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import torch

from toolkit.capture.types import Views
from toolkit.training.depth import ray_distances

Tensor = torch.Tensor


@dataclass(frozen=True)
class Batch:
    origins: Tensor  # (B, 3) working frame
    directions: Tensor  # (B, 3) unit
    colour: Tensor  # (B, 3) in [0, 1]
    view: Tensor  # (B,) int64, which of the pool's views
    distance: Tensor | None = None  # (B,) to the surface along the ray, working units, 0: unknown
    weight: Tensor | None = None  # (B,) what each ray counts in the means over the batch; None: 1


class PixelPool:
    """The valid pixels of some views, as uint8 on the device, with what is needed to make their rays.

    Of a view that counts for less, so many are drawn by lot (always the same ones) as its weight says: rays come evenly from what is kept.
    """

    def __init__(self, views: Views, device: torch.device | str = "cpu", depth: bool = False) -> None:
        """With `depth` the distances of known surfaces are kept, too, if any view has depth."""
        colours, places, which, distances = [], [], [], []
        depths = views.depths if depth and any(one is not None for one in views.depths) else None
        for index in range(len(views)):
            image = views.images[index]
            valid = views.valid[index] if views.valid else None
            flat = np.arange(image.shape[0] * image.shape[1]) if valid is None else np.flatnonzero(valid)
            if views.weight and views.weight[index] < 1:
                flat = flat[np.random.default_rng(zlib.crc32(views.names[index].encode())).random(len(flat)) < views.weight[index]]
            colours.append(torch.from_numpy(np.ascontiguousarray(image.reshape(-1, 3)[flat])))
            places.append(torch.from_numpy(flat.astype(np.int32)))
            which.append(torch.full((len(flat),), index, dtype=torch.int32))
            if depths is not None:
                known = depths[index]
                along = (
                    np.zeros(len(flat), np.float32) if known is None else ray_distances(known, views.intrinsics[index]).reshape(-1)[flat]
                )
                distances.append(torch.from_numpy(along))
        self.colour = torch.cat(colours).to(device)
        self.place = torch.cat(places).to(device)
        self.view = torch.cat(which).to(device)
        self.distance = torch.cat(distances).to(device) if distances else torch.zeros(0, device=device)
        self.height = max((c.height for c in views.intrinsics), default=0)
        k = [(c.fx, c.fy, c.cx, c.cy, c.width) for c in views.intrinsics]
        self.camera = torch.tensor(k, dtype=torch.float32, device=device)
        self.limit = len(self.colour)  # batches are drawn from the pixels before this one
        self.pose = torch.from_numpy(views.world_from_camera.astype(np.float32)).to(device)

    def __len__(self) -> int:
        return len(self.colour)

    def take(self, pick: Tensor) -> Batch:
        """The rays of the pixels `pick` (B,)."""
        view = self.view[pick].long()
        fx, fy, cx, cy, width = self.camera[view].unbind(1)
        place = self.place[pick]
        row = place.div(width.int(), rounding_mode="floor")
        u, v = (place - row * width.int()).float() + 0.5, row.float() + 0.5
        camera = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u)], 1)
        pose = self.pose[view]
        directions = torch.nn.functional.normalize((pose[:, :3, :3] @ camera[:, :, None]).squeeze(2), dim=1)
        distance = self.distance[pick] if len(self.distance) else None
        return Batch(pose[:, :3, 3], directions, self.colour[pick].float() / 255, view, distance)
