"""Endless training scenes: procedural geometry and textures, filmed along random paths; frames are drawn on demand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.effects.models import encode_srgb
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.simulate.eye import eye_of, take, take_all
from fieldfuse.simulate.materials import TextureBank, texture_bank
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.scene import EDGE_SIDE

OBJECTS = ("table", "table", "thin", "sphere")
ROOMS = ("room",) * 5 + ("table",) * 4 + ("thin", "corridor", "corridor", "street", "wall")
SHAPES = (4 / 3, 4 / 3, 3 / 4, 16 / 9, 9 / 16, 1.0)  # width by height
BANKS = 8  # sets of textures that scenes choose from
TEXELS = 256  # a side of a texture: training images are small
TRIES = 6  # scenes …
PATHS = 24  # … and paths through one
CLEAR = 0.12  # of the distance to the focus: cameras keep this far from surfaces
AT_ONCE = 2**21  # rays on a device: 0.3 kB each

Clearance = Callable[[Array], Array]  # (N, 3) points → (N,) distance to the nearest surface


@lru_cache(maxsize=2 * BANKS)
def _bank(number: int, device: torch.device) -> TextureBank:
    return texture_bank(number, TEXELS) if device.type == "cpu" else _bank(number, torch.device("cpu")).to(device)


class ProceduralScene:
    """One random scene with a path through it.

    Objects are looked at from around; rooms are filmed by hand. Lengths are multiplied by a random factor, so that nothing in a sample
    distinguishes metres from centimetres.

    Args:
        kind: "object" or "room".
        bank: set of textures, 0 … `BANKS` − 1.
        frames: cameras on the path.
        device: where images are drawn, and stay.

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
        self._eye = eye_of(self._camera, EDGE_SIDE, self._device)  # cached: scenes take turns, and rays are dear to make
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


# Camera paths -------------------------------------------------------------------------------------------------------------------------


def look_at(centres: Array, targets: Array, roll: Array) -> Array:
    """(N, 3) places, (N, 3) what each looks at, (N,) radians of roll → (N, 4, 4) world_from_camera, z up."""
    forward = targets - centres
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    flat = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(flat > 1e-6, right / np.maximum(flat, 1e-12), [1.0, 0.0, 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, :] = np.stack([c * right + s * down, c * down - s * right, forward, centres], axis=-1)
    return poses


def wander(rng: np.random.Generator, count: int, size: float, fastest: int = 5) -> Array:
    """(count, 3) a smooth random walk about zero, of deviation `size`."""
    s = np.linspace(0, 1, count)
    waves = np.arange(1, fastest)
    phase = rng.uniform(0, 2 * np.pi, (len(waves), 3))
    weight = rng.normal(0, 1, (len(waves), 3)) / waves[:, None]
    out = (np.sin(np.pi * waves[:, None, None] * s[:, None] + phase[:, None]) * weight[:, None]).sum(0)
    return np.asarray(size * out / np.sqrt((1 / waves**2).sum() / 2))


def hand_held(rng: np.random.Generator, count: int, free: Array, focus: Array, clearance: Clearance) -> Array | None:
    """(count, 4, 4) a walk through the free space (2, 3), looking ahead, aside or at the focus; None when no clear walk was found."""
    for _ in range(PATHS):
        start = rng.uniform(free[0], free[1])
        place = focus + rng.normal(0, 0.6, 3) if rng.random() < 0.6 else rng.uniform(free[0], free[1]) + rng.normal(0, 1.0, 3)
        away = float(np.linalg.norm(place - start))
        if away < 0.5:
            continue
        # Most walks go to the side of what is looked at, as people film; the others anywhere.
        heading = np.cross(place - start, [0, 0, 1.0]) if rng.random() < 0.7 else rng.normal(0, 1, 3) * [1, 1, 0.3]
        heading = heading / max(float(np.linalg.norm(heading)), 1e-9)
        length = away * np.exp(rng.uniform(np.log(0.5), np.log(1.8)))
        s = np.linspace(-0.5, 0.5, count)[:, None]
        centres = start + s * length * heading + wander(rng, count, 0.05 * length)
        targets = place + s * rng.uniform(-0.3, 0.8) * length * heading + wander(rng, count, 0.05 * away)
        if clearance(centres).min() > CLEAR * min(away, 1.5):
            return look_at(centres, targets, rng.normal(0, 0.04) + wander(rng, count, 0.03)[:, 0])
    return None


def around(rng: np.random.Generator, count: int, free: Array, focus: Array, clearance: Clearance) -> Array | None:
    """(count, 4, 4) cameras around the focus on part of a dome, in order of the azimuth; None when they do not fit."""
    widest = float(np.max(np.linalg.norm((free - focus)[:, :2], axis=1)))
    for _ in range(PATHS):
        radius = widest * np.exp(rng.uniform(np.log(0.2), np.log(0.85)))
        arc = np.exp(rng.uniform(np.log(0.5), np.log(2 * np.pi)))
        azimuth = rng.uniform(0, 2 * np.pi) + np.sort(rng.uniform(0, arc, 3 * count))
        lift = np.clip(rng.normal(rng.uniform(0.15, 0.9), rng.uniform(0.03, 0.25), 3 * count), 0.03, 1.4)
        reach = radius * rng.uniform(0.9, 1.1, 3 * count)
        flat = reach * np.cos(lift)
        centres = focus + np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(lift)], axis=1)
        clear = np.flatnonzero(clearance(centres) > CLEAR * radius)
        if len(clear) < count:
            continue
        chosen = np.sort(rng.permutation(clear)[:count])
        targets = focus + rng.normal(0, 0.08 * radius, (count, 3))
        return look_at(centres[chosen], targets, rng.normal(0, 0.05, count))
    return None
