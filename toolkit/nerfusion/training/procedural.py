"""Endless training scenes: procedural geometry and textures, random cameras and sizes, drawn frame by frame as samples ask for them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.effects.models import encode_srgb
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.paths import around, hand_held
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.simulate.eye import eye_of, take, take_all
from fieldfuse.simulate.materials import TextureBank, texture_bank
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.scene import EDGE_SIDE

OBJECTS = ("table", "table", "thin", "sphere")
ROOMS = ("room",) * 5 + ("table",) * 4 + ("thin", "corridor", "corridor", "street", "wall")
SHAPES = (4 / 3, 4 / 3, 3 / 4, 16 / 9, 9 / 16, 1.0)  # width by height
BANKS = 8  # sets of textures that scenes choose from
TEXELS = 256  # a side of a texture: training pictures are small
TRIES = 6
AT_ONCE = 2**21  # rays on a device: 0.3 kB each


@lru_cache(maxsize=2 * BANKS)
def _bank(number: int, device: torch.device) -> TextureBank:
    return texture_bank(number, TEXELS) if device.type == "cpu" else _bank(number, torch.device("cpu")).to(device)


class ProceduralScene:
    """One random scene with a path through it.

    Objects are looked at from around; rooms are filmed by hand. Lengths are multiplied by a random factor, so that nothing in a sample
    tells metres from centimetres.

    Args:
        kind: "object" or "room".
        bank: set of textures, 0 … `BANKS` − 1.
        frames: cameras on the path.
        device: where pictures are drawn, and stay.

    Raises:
        InputError: no path was found after several scenes.
    """

    ordered: bool
    depth_hint: float | None

    def __init__(
        self, kind: str, rng: np.random.Generator, long_side: int, frames: int, bank: int = 0, device: torch.device | str = "cpu"
    ) -> None:
        self.kind, self._device = kind, torch.device(device)
        poses = None
        for _ in range(TRIES):
            named = str(rng.choice(OBJECTS if kind == "object" else ROOMS))
            self._scene = random_scene(named, rng, _bank(bank, torch.device("cpu")))
            self.name = f"procedural {named}"
            focus = np.asarray(self._scene.focus, dtype=np.float64)
            make = around if kind == "object" and rng.random() < 0.75 else hand_held
            poses = make(rng, frames, np.asarray(self._scene.free), focus, self._clearance)
            if poses is not None:
                break
        if poses is None:
            raise InputError(f"no camera path fits into {TRIES} procedural scenes; give fewer pictures.frames")
        self.ordered = make is hand_held
        self.depth_hint = None
        self._scale = float(np.exp(rng.uniform(np.log(0.05), np.log(2.0))))
        self._poses = poses
        self.world_from_camera = poses.copy()
        self.world_from_camera[:, :3, 3] *= self._scale
        self._camera = _camera(rng, long_side)
        if self._device.type != "cpu":
            self._scene = self._scene.to(self._device, _bank(bank, self._device))
        self._eye = eye_of(self._camera, EDGE_SIDE, self._device)  # kept: scenes take turns, and rays are dear to make
        # Exposure and white balance differ between captures, not within one.
        self._gain = torch.from_numpy(np.exp(rng.normal(0, 0.12) + rng.normal(0, 0.04, 3))).float().to(self._device)
        self._noise = float(rng.choice([0.0, rng.uniform(0.0, 0.02)]))
        self._seed = int(rng.integers(2**31))
        self._drawn: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        self._draw([frames // 2])
        middle = self._drawn[frames // 2][1]
        seen = middle[middle > 0]
        self.depth_hint = float(seen.median()) if len(seen) else None

    def _clearance(self, points: Array) -> Array:
        return np.asarray(self._scene.clearance(torch.from_numpy(points)).numpy(), dtype=np.float64)

    def _draw(self, indices: Sequence[int]) -> None:
        """Draw the frames at `indices` that are not drawn yet."""
        new = list(dict.fromkeys(index for index in indices if index not in self._drawn))
        if not new:
            return
        if self._device.type == "cpu":
            taken = [take(self._scene, self._eye, self._poses[index][None]) for index in new]
        else:
            few = max(1, AT_ONCE // (self._camera.width * self._camera.height))
            parts = [new[first : first + few] for first in range(0, len(new), few)]
            taken = [one for part in parts for one in take_all(self._scene, self._eye, self._poses[part])]
        for index, seen in zip(new, taken, strict=True):
            picture = encode_srgb(seen.linear).permute(2, 0, 1) * self._gain[:, None, None]
            if self._noise > 0:
                generator = torch.Generator(self._device).manual_seed(self._seed + index)
                picture = picture + self._noise * torch.randn(picture.shape, generator=generator, device=self._device)
            self._drawn[index] = picture.clamp(0, 1).contiguous(), seen.depth * self._scale

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`."""
        self._draw([int(index) for index in indices])
        drawn = [self._drawn[int(index)] for index in indices]
        c = self._camera
        return Pictures(
            images=torch.stack([picture for picture, _ in drawn]),
            intrinsics=torch.tensor([[c.fx, c.fy, c.cx, c.cy]]).repeat(len(drawn), 1).to(self._device),
            world_from_camera=torch.from_numpy(self.world_from_camera[list(indices)].astype(np.float32)).to(self._device),
            depths=torch.stack([depth for _, depth in drawn]),
        )


def _camera(rng: np.random.Generator, long_side: int) -> Intrinsics:
    """A pinhole camera of 40° to 80° along its long side, of a random shape, its axis a little off the middle."""
    shape = float(rng.choice(SHAPES))
    width, height = (long_side, round(long_side / shape)) if shape >= 1 else (round(long_side * shape), long_side)
    focal = 0.5 * long_side / np.tan(0.5 * np.radians(rng.uniform(40, 80)))
    cx, cy = (0.5 + rng.normal(0, 0.02, 2)) * [width, height]
    return Intrinsics(width, height, float(focal), float(focal), float(cx), float(cy))
