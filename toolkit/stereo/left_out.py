"""Pixels of pictures that a fit does without, in memory and as a file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path

MOST_SIDE = 2**13  # pixels; masks are small, so a file that says more is damaged


@dataclass(frozen=True)
class LeftOut:
    """What of some pictures is left out, since it moves; see `moving.py`."""

    looked_at: int  # pictures
    share: float  # of their pixels that are left out
    masks: dict[str, Array]  # (h, w) bool, of the pictures where something is, by name; True: left out
    seconds: float = 0.0  # that looking took

    @staticmethod
    def of(names: Sequence[str], masks: Sequence[Array], seconds: float = 0.0) -> LeftOut:
        """What the `masks` of the pictures `names` leave out."""
        share = float(np.mean([mask.mean() for mask in masks])) if masks else 0.0
        return LeftOut(len(names), share, {name: mask for name, mask in zip(names, masks, strict=True) if mask.any()}, seconds)

    def to_dict(self) -> dict[str, float]:
        return {"looked_at": self.looked_at, "pictures": len(self.masks), "share": round(self.share, 5), "seconds": round(self.seconds, 2)}

    def mask(self, name: str, width: int, height: int) -> Array:
        """(height, width) bool pixels of the picture `name`, at this size, that are left out."""
        if name not in self.masks:
            return np.zeros((height, width), bool)
        return np.asarray(cv2.resize(self.masks[name].astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)

    def without(self, views: Views) -> Views:
        """`views` in which the pixels that are left out are not valid, and have no depth."""
        valid: list[Array | None] = list(views.valid) if views.valid else [None] * len(views)
        depths = list(views.depths)
        for index, name in enumerate(views.names):
            if name not in self.masks:
                continue
            height, width = views.images[index].shape[:2]
            stays = ~self.mask(name, width, height)
            before = valid[index]
            valid[index] = stays if before is None else before & stays
            if depths and (depth := depths[index]) is not None:
                depths[index] = np.where(stays, depth, np.float32(0))
        return replace(views, valid=valid, depths=depths)


def save_left_out(path: Path | str, left_out: LeftOut) -> None:
    """Write it, eight pixels to a byte.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {f"mask.{index}": np.packbits(mask) for index, mask in enumerate(left_out.masks.values())}
    shapes = {name: list(mask.shape) for name, mask in left_out.masks.items()}
    about = {"looked_at": left_out.looked_at, "share": left_out.share, "seconds": left_out.seconds, "shapes": shapes}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"left_out": json.dumps(about)})


def load_left_out(path: Path | str) -> LeftOut:
    """What `save_left_out` wrote.

    Raises:
        InputError: missing or damaged.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            about = json.loads(file.metadata()["left_out"])
            looked_at, share, seconds = int(about["looked_at"]), float(about["share"]), float(about["seconds"])
            masks: dict[str, Array] = {}
            if not (looked_at >= len(about["shapes"]) and 0 <= share <= 1 and 0 <= seconds < np.inf):
                raise ValueError("its numbers cannot be")
            for index, (name, (height, width)) in enumerate(about["shapes"].items()):
                bits = file.get_tensor(f"mask.{index}")
                if not (0 < height <= MOST_SIDE and 0 < width <= MOST_SIDE and bits.shape == (-(-height * width // 8),)):
                    raise ValueError(f"the mask of {name!r:.80} does not have its size")
                masks[name] = np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)
            return LeftOut(looked_at, share, masks, seconds)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} cannot be read ({first_line(error)}); remove it and run the command again") from error
