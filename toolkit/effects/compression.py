"""Image compression: JPEG (ITU-T T.81) at a quality, colour at half resolution, as cameras and messengers write it.

Blocks of 8 × 8 pixels lose their fine cosines: each coefficient is rounded to a whole multiple of its entry in the quantisation table,
which is coarser the lower the quality.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fieldfuse.camera import Array


@dataclass(frozen=True)
class Compression:
    """Parameters of the effect."""

    quality: int = 60  # 1 to 100


PRESETS = {"weak": Compression(85), "medium": Compression(55), "strong": Compression(22)}


def encode(effect: Compression, picture: Array) -> bytes:
    """(H, W, 3) uint8 sRGB → the bytes of a JPEG file."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, int(effect.quality), cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    _, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), flags)
    return bytes(data.tobytes())


def decode(data: bytes) -> Array:
    """The bytes of a JPEG file → (H, W, 3) uint8 sRGB."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None  # what `encode` wrote can be read
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
