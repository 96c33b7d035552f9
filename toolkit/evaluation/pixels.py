"""What image metrics accept: one form for pictures and masks, with a clear refusal of everything else."""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError


def as_float(image: Array) -> Array:
    """(H, W, 3) uint8 or float → float64 in [0, 1]; what is not finite becomes black, as a viewer would show it.

    Raises:
        InputError: not a colour picture.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"a picture of shape {image.shape} cannot be measured; it must be (height, width, 3)")
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255
    return np.clip(np.nan_to_num(image.astype(np.float64), nan=0, posinf=0, neginf=0), 0, 1)


def pair(rendered: Array, truth: Array) -> tuple[Array, Array]:
    """Both pictures as float64 in [0, 1].

    Raises:
        InputError: their sizes differ.
    """
    first, second = as_float(rendered), as_float(truth)
    if first.shape != second.shape:
        sizes = f"{first.shape[1]}×{first.shape[0]} and the true one {second.shape[1]}×{second.shape[0]}"
        raise InputError(f"the rendered picture is {sizes}; render at the size of the view")
    return first, second


def checked_mask(valid: Array | None, shape: tuple[int, ...]) -> Array:
    """(H, W) bool, all true when `valid` is None.

    Raises:
        InputError: the mask has another size than the picture.
    """
    if valid is None:
        return np.ones(shape[:2], dtype=bool)
    valid = np.asarray(valid).astype(bool)
    if valid.shape != tuple(shape[:2]):
        raise InputError(f"a mask of shape {valid.shape} does not fit a picture of {shape[1]}×{shape[0]}")
    return valid
