"""Views' images and measured depth on the device that the networks run on, the most recently used ones cached."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.capture.types import Views

CACHED = 48  # images on a device of its own, as bytes
T = TypeVar("T")


class Recent(Generic[T]):
    """A cache of the most recently used values by index.

    `functools.lru_cache` of a method would refer to its owner, which then stays in memory until the garbage collector comes by.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._cached: OrderedDict[int, T] = OrderedDict()

    def __contains__(self, index: int) -> bool:
        return index in self._cached

    def get(self, index: int, make: Callable[[int], T]) -> T:
        """The cached value of `index`, or what `make` gives for it."""
        return self.put(index, self._cached[index] if index in self._cached else make(index))

    def put(self, index: int, value: T) -> T:
        """Cache `value` as the most recently used."""
        self._cached[index] = value
        self._cached.move_to_end(index)
        while len(self._cached) > self.most:
            self._cached.popitem(last=False)
        return value


class ImageCache:
    """Views' images on a device: call with an index for (1, 3, H, W) RGB in [0, 1].

    Args:
        measured: whether `depth` gives what a sensor measured.
    """

    def __init__(self, views: Views, device: torch.device | str = "cpu", measured: bool = False) -> None:
        self.views, self.device, self.measured = views, torch.device(device), measured
        self._cached: Recent[Tensor] = Recent(CACHED)

    def __call__(self, index: int) -> Tensor:
        pixels = self._cached.get(index, lambda index: to_device_async(self.views.images[index], self.device))
        return pixels.permute(2, 0, 1)[None] / 255

    def depth(self, index: int) -> Tensor | None:
        """(H, W) of a view's measured depth along z in working units, None where it has none."""
        depth = self.views.depths[index] if self.measured and self.views.depths else None
        return None if depth is None else to_device_async(np.asarray(depth, np.float32), self.device)
