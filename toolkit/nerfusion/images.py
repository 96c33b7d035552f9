"""Views' images and measured depth on the device that the networks run on, the most recently used ones cached."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views

CACHED = 48  # images on a device of its own, as bytes
T = TypeVar("T")


class ImageCache:
    """Views' images on a device, the most recently used ones cached: call with an index for (1, 3, H, W) RGB in [0, 1]."""

    def __init__(self, views: Views, device: torch.device) -> None:
        self.views, self.device = views, device
        self._kept: Recent[Tensor] = Recent(CACHED)

    def __call__(self, index: int) -> Tensor:
        return to_rgb(self._kept.get(index, lambda index: pixels(self.views, index, self.device)))


class Recent(Generic[T]):
    """A cache of the most recently used values by index.

    `functools.lru_cache` of a method would refer to its owner, which then stays in memory until the garbage collector comes by.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._kept: OrderedDict[int, T] = OrderedDict()

    def __contains__(self, index: int) -> bool:
        return index in self._kept

    def get(self, index: int, make: Callable[[int], T]) -> T:
        """The cached value of `index`, or what `make` gives for it."""
        return self.put(index, self._kept[index] if index in self._kept else make(index))

    def put(self, index: int, value: T) -> T:
        """Cache `value` as the most recently used."""
        self._kept[index] = value
        self._kept.move_to_end(index)
        while len(self._kept) > self.most:
            self._kept.popitem(last=False)
        return value


def with_neighbours(key: int, neighbours: Array) -> list[int]:
    """The key frame and its neighbours, each once."""
    return list(dict.fromkeys([key, *(int(n) for n in neighbours)]))


def pixels(views: Views, index: int, device: torch.device | str) -> Tensor:
    """(H, W, 3) uint8 of a view, on a device."""
    return _on_device(views.images[index], device)


def to_rgb(values: Tensor) -> Tensor:
    """(H, W, 3) uint8 → (1, 3, H, W) RGB in [0, 1]."""
    return values.permute(2, 0, 1)[None] / 255


def image_of(views: Views, index: int, device: torch.device | str) -> Tensor:
    """(1, 3, H, W) RGB in [0, 1]."""
    return to_rgb(pixels(views, index, device))


def sensor_depth(views: Views, index: int, device: torch.device | str) -> Tensor | None:
    """(H, W) of a view's depth along z in working units, None where it has none."""
    depth = views.depths[index] if views.depths else None
    return None if depth is None else _on_device(np.asarray(depth, np.float32), device)


def _on_device(values: Array, device: torch.device | str) -> Tensor:
    """Values on a device."""
    found = torch.from_numpy(np.ascontiguousarray(values))
    if torch.device(device).type == "cuda":  # from memory that stays in place, which nobody has to wait for
        found = found.pin_memory().to(device, non_blocking=True)
    return found.to(device)
