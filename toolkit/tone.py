"""What becomes of light on its way into a picture, and back: gains of a frame, light that falls off towards the corners, sRGB.

    stored = encode(g_c · V(r) · L),    V(r) = (1 + a·r²)⁻²,    a = corner^(−1/2) − 1

r is the distance from the principal point in half diagonals, so V(0) = 1 and V(1) = `corner`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics

Gain = tuple[float, float, float]  # of red, green and blue
CLIPPED = 254  # of 255: such a pixel may have been brighter
DARKER = 1.02  # a clipped pixel that is divided by more than this has no known colour
STEPS = 4096
SHOULDER = 0.6  # linear light up to which `brighter` is exact


@dataclass(frozen=True)
class Tone:
    """What one picture has of it. `corner`: share of the light that is left at half a diagonal; None: it does not fall off."""

    gain: Gain = (1.0, 1.0, 1.0)
    corner: float | None = None

    def factor(self, camera: Intrinsics) -> Array:
        """What light was multiplied by: (H, W, 3), or (3,) where it is the same everywhere."""
        gain = np.array(self.gain, dtype=np.float32)
        return gain if self.corner is None else np.asarray(share(self.corner, square_radius(camera))[..., None] * gain)

    def undone(self, image: Array, camera: Intrinsics) -> tuple[Array, Array | None]:
        """(H, W, 3) uint8 sRGB with all of it divided out in linear light, and (H, W) bool where the result is not known; None: nowhere."""
        factor = self.factor(camera)
        clipped: Array = np.asarray((image >= CLIPPED).any(2))
        if factor.ndim == 1:
            table = np.stack([stored(LINEAR / factor[channel]) for channel in range(3)], axis=1)  # (256, 3)
            out = np.stack([table[image[..., channel], channel] for channel in range(3)], axis=2)
            return out, clipped if factor.max() > DARKER else None
        return stored(LINEAR[image] / factor), clipped & (factor.max(2) > DARKER)

    def applied(self, shown: Array, camera: Intrinsics) -> Array:
        """(H, W, 3) sRGB in [0, 1] as the scene is → float64 as the picture has it; what is too bright is clipped, as there."""
        return encode(decode(np.asarray(shown, dtype=np.float64)) * self.factor(camera))

    def to_dict(self) -> dict[str, Any]:
        return {"gain": list(self.gain), "corner": self.corner}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Tone:
        """The reverse of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: the data does not hold what `to_dict` writes.
        """
        red, green, blue = (positive(value) for value in data["gain"])
        return cls((red, green, blue), None if data["corner"] is None else positive(data["corner"]))


def positive(value: Any) -> float:
    """`value` as a number.

    Raises:
        TypeError, ValueError: it is none, or not a positive one.
    """
    if not 0 < float(value) < 1e6:
        raise ValueError(f"{value!r} is not a positive number")
    return float(value)


def share(corner: float, square: Array) -> Array:
    """V at squared distances from the principal point, in half diagonals."""
    return np.asarray((1 + (corner**-0.5 - 1) * square) ** -2)


def square_radius(camera: Intrinsics) -> Array:
    """(H, W) float32 squared distance of pixel centres from the principal point in half diagonals."""
    x = np.arange(camera.width, dtype=np.float32) + 0.5 - camera.cx
    y = np.arange(camera.height, dtype=np.float32) + 0.5 - camera.cy
    return np.asarray((x[None] ** 2 + y[:, None] ** 2) / (0.25 * (camera.width**2 + camera.height**2)), dtype=np.float32)


def decode(shown: Array) -> Array:
    """sRGB in [0, 1] → linear light."""
    shown = np.clip(shown, 0, 1)
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def encode(linear: Array) -> Array:
    """Linear light, clipped to [0, 1] → sRGB."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def shares(numbers: Array) -> Array:
    """Colours as files keep them, whole numbers up to the largest of their type or fractions → float64 in [0, 1]."""
    most = np.iinfo(numbers.dtype).max if numbers.dtype.kind in "iu" else 1
    return np.asarray(np.clip(numbers.astype(np.float64) / most, 0, 1))


def stored(linear: Array) -> Array:
    """Linear light → uint8 sRGB, through a table that is fine enough for 8 bits: steps of the square root, which is nearly even in sRGB."""
    root = np.sqrt(np.clip(linear, 0, 1))
    return ENCODED[(root * (STEPS - 1) + 0.5).astype(np.int32)]


def brighter(linear: Array, exposure: float) -> Array:
    """Linear light in [0, 1] times `exposure`, without anything becoming white that was not.

    Up to `SHOULDER` it is exact; beyond, light is pressed together smoothly (s·u / (1 + (s − 1)·u), as steep as the rest where it begins),
    and 1 stays 1. What becomes darker (`exposure` below 1) is exact throughout.
    """
    light = np.asarray(linear) * exposure
    if exposure <= 1:
        return light
    steep = (exposure - SHOULDER) / (1 - SHOULDER)
    over = np.clip((light - SHOULDER) / (exposure - SHOULDER), 0, 1)
    return np.where(light <= SHOULDER, light, SHOULDER + (1 - SHOULDER) * steep * over / (1 + (steep - 1) * over))


def exposed(colours: Array, exposure: float) -> Array:
    """uint8 sRGB of any shape, `brighter`; the very same object for an `exposure` of 1."""
    return colours if exposure == 1 else np.round(255 * encode(brighter(LINEAR, exposure))).astype(np.uint8)[colours]


def unexposed(shown: Array, exposure: float) -> Array:
    """sRGB in [0, 1] of any shape, what `exposed` made brighter as it was before; the very same object for an `exposure` of 1."""
    return shown if exposure == 1 else np.interp(shown, encode(brighter(LINEAR, exposure)), np.arange(256) / 255).astype(np.float32)


LINEAR = decode(np.arange(256) / 255.0).astype(np.float32)  # (256,) linear light of the stored values
ENCODED = np.round(255 * encode((np.arange(STEPS) / (STEPS - 1)) ** 2)).astype(np.uint8)  # (STEPS,)
