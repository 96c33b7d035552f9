"""Small synthetic views and lattices for tests of the networks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fieldfuse.backends import dispatch
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.nerfusion.model import ModelConfig, NerfusionModel
from fieldfuse.volume.space import Space

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
SMALL = ModelConfig(
    image_channels=16, sampled=4, direction=4, hidden=8, channels=8, gru_hidden=8, features=8, head_hidden=8, decoder_hidden=8
)
INTRINSICS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


def small_model(seed: int = 0, config: ModelConfig = SMALL) -> NerfusionModel:
    torch.manual_seed(seed)
    return NerfusionModel(config)


def poses(count: int, apart: float = 0.25, back: float = 2.0) -> Array:
    """(count, 4, 4) cameras side by side that look along +z at the origin."""
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, 0, 3] = apart * (np.arange(count) - (count - 1) / 2)
    out[:, 2, 3] = -back
    return out


def cameras(count: int = 3) -> Cameras:
    return Cameras.of([INTRINSICS] * count, poses(count))


def pictures(count: int = 3, seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> torch.Tensor:
    """(count, 3, H, W) smooth noise in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((count, 3, size[0] // 4, size[1] // 4), generator=generator)
    return torch.nn.functional.interpolate(coarse, size=size, mode="bilinear", align_corners=False)


def off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch computes, and no kernels."""
    monkeypatch.setattr(dispatch, "can_use_numba", lambda *values: False)


def lattice(resolution: int = 32, shell: float = 0.0) -> Lattice:
    return Lattice(Space((0.0, 0.0, 0.0), 0.8, shell), resolution)


def wall_pictures(count: int, depth: float, seed: int = 0) -> tuple[torch.Tensor, Array]:
    """Pictures (count, 3, H, W) of a textured wall at z = `depth` − 2 seen by `poses(count)`, and those poses."""
    generator = torch.Generator().manual_seed(seed)
    texture = torch.rand((1, 3, 24, 24), generator=generator)
    world = poses(count)
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    out = []
    for pose in world:
        x = (u - WIDTH / 2) / FOCAL * depth + pose[0, 3]
        y = (v - HEIGHT / 2) / FOCAL * depth + pose[1, 3]
        place = torch.stack([x / 1.6, y / 1.6], -1).float()[None]
        out.append(torch.nn.functional.grid_sample(texture, place, align_corners=False, padding_mode="reflection")[0])
    return torch.stack(out), world
