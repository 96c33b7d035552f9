"""Filming: one frame of a scene after the other, through exactly the effects that are listed, with the truth behind each.

Light takes this way: scene (passers, background, highlights) → lens and rows (distortion, rolling shutter) → open shutter (motion blur) →
vignetting → exposure → sensor noise → clipping, sRGB and 8 bits → compression. An effect that is not listed is not called.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from copy import copy
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.effects.effect_specs import Effects, generator
from fieldfuse.effects.models import encode_srgb, to_bytes
from fieldfuse.effects.scenery import Walk
from fieldfuse.simulate.eye import Picture, Scenery, eye_of, take
from fieldfuse.simulate.paths import Motion
from fieldfuse.simulate.people import peopled
from fieldfuse.simulate.scene import Scene
from fieldfuse.threads import in_order
from fieldfuse.tone import share, square_radius

Tensor = torch.Tensor
T = TypeVar("T")
R = TypeVar("R")

FLOOR = 0.0  # metres: of procedural scenes
PASSED = 1e-3  # metres before what stands still


@dataclass(frozen=True)
class Shot:
    """One filmed frame with its truth."""

    index: int
    seconds: float
    world_from_camera: Array  # (4, 4) float64: in the middle of the exposure, for the middle row
    rgb: Array  # (H, W, 3) uint8 sRGB
    jpeg: bytes | None  # the image as it was compressed, when compression is listed
    depth: Array  # (H, W) float32 metres along z: what a perfect camera at that pose sees; 0 = nothing
    normals: Array  # (H, W, 3) float32 unit, world axes; 0 = nothing
    sensor_depth: Array | None  # (H, W) float32 metres: what the depth sensor gives; None when the capture has no depth
    passed: Array | None = None  # (H, W) bool: somebody stands before the scene here; None when passers are not listed
    facts: dict[str, Any] = field(default_factory=dict)  # parameters of the effects in this frame


@dataclass(frozen=True)
class FilmCamera:
    """What films."""

    intrinsics: Intrinsics  # pinhole; a listed lens distortion is put before it
    side: int = 2  # pixels that hold an edge are the mean of side × side rays
    depth: bool = False  # whether there is a depth sensor, too


class Film:
    """A scene, a camera on its way through it, and the effects.

    Args:
        times: (N,) seconds of the frames.

    Raises:
        InputError: the lens distortion is not one-to-one over the image.
    """

    def __init__(self, scene: Scenery, camera: FilmCamera, motion: Motion, times: Array, effects: Effects, seed: int = 0) -> None:
        scene = copy(scene)  # the caller's scene keeps its own background and highlights
        scene.background, scene.highlights = effects.background, effects.highlights
        self.scene, self.motion, self.effects, self.seed, self.has_depth = scene, motion, effects, seed, camera.depth
        self.times = np.asarray(times, dtype=np.float64)
        self.world_from_camera = motion.poses(self.times)
        intrinsics = camera.intrinsics
        self.intrinsics = intrinsics if effects.distortion is None else effects.distortion.before(intrinsics)
        self.eye, self._plain = (eye_of(self.intrinsics, side, scene.device) for side in (camera.side, 1))
        self._falloff: Tensor | None = None
        if effects.vignetting is not None:
            falloff = share(effects.vignetting.corner, square_radius(self.intrinsics)).astype(np.float32)
            self._falloff = torch.from_numpy(falloff)[..., None].to(scene.device)
        self._walks: list[Walk] = []
        if effects.passers is not None:
            wide, floor = intrinsics.width / intrinsics.fx, FLOOR if isinstance(scene, Scene) else None
            who = generator(seed, "passers")
            self._walks = effects.passers.walks(self.times, self.world_from_camera, scene.focus, wide, floor, who)
        self._gains = None if effects.exposure is None else effects.exposure.gains(len(self.times), generator(seed, "exposure"))

    def __len__(self) -> int:
        return len(self.times)

    def shot(self, index: int) -> Shot:
        """Frame `index`; frames do not depend on each other, in whichever order or thread they are taken."""
        effects, seconds, pose = self.effects, float(self.times[index]), self.world_from_camera[index]
        facts: dict[str, Any] = {}
        moving = effects.rolling_shutter is not None or effects.motion_blur is not None
        there = self._there(seconds)
        picture = None if moving else take(there, self.eye, pose[None])
        linear = self._gathered(seconds, facts) if picture is None else picture.linear
        rgb, jpeg = self._developed(linear, index, facts)
        alone = there is self.scene
        still = picture if picture is not None and alone else take(self.scene, self._plain, pose[None])
        depth, normals = still.depth.cpu().numpy(), still.normals.cpu().numpy()
        passed = None if effects.passers is None else np.zeros(depth.shape, bool)
        if not alone:
            still = take(there, self._plain, pose[None])
            seen = still.depth.cpu().numpy()
            passed = (seen > 0) & ((depth == 0) | (seen < depth - PASSED))
            facts["passers"] = {"share": float(passed.mean())}
        if effects.depth_offset is not None and self.has_depth:
            still = take(there, self._plain, (pose @ invert(effects.depth_offset.forward()))[None])
        sensor_depth = self._measured(still, index) if self.has_depth else None
        return Shot(index, seconds, pose, rgb, jpeg, depth, normals, sensor_depth, passed, facts)

    def _there(self, seconds: float) -> Scenery:
        """The scene, with whoever passes at that time."""
        return peopled(self.scene, self._walks, seconds) if self._walks else self.scene

    def _gathered(self, seconds: float, facts: dict[str, Any]) -> Tensor:
        """(H, W, 3) linear light of a frame during which the camera moves."""
        effects = self.effects
        rows = np.array([seconds])
        if effects.rolling_shutter is not None:
            rows = effects.rolling_shutter.rows(seconds, self.intrinsics.height)
            facts["rolling_shutter"] = {"first_row_seconds": float(rows[0]), "last_row_seconds": float(rows[-1])}
        if effects.motion_blur is None:
            return take(self._there(seconds), self.eye, self.motion.poses(rows)).linear
        offsets = effects.motion_blur.instants()
        half = effects.motion_blur.exposure / 2
        facts["motion_blur"] = {
            "exposure_seconds": effects.motion_blur.exposure,
            "path": self.motion.poses(seconds + np.array([-half, 0.0, half])).tolist(),  # world_from_camera at start, middle and end
        }
        total = take(self._there(seconds + offsets[0]), self.eye, self.motion.poses(rows + offsets[0])).linear.clone()
        for offset in offsets[1:]:  # always summed in their order
            total += take(self._there(seconds + offset), self.eye, self.motion.poses(rows + offset)).linear
        return total / len(offsets)

    def _developed(self, linear: Tensor, index: int, facts: dict[str, Any]) -> tuple[Array, bytes | None]:
        """Linear light on the lens → the stored image."""
        effects = self.effects
        if self._falloff is not None:
            linear = linear * self._falloff
        if self._gains is not None:
            gain = self._gains[index]
            facts["exposure"] = {"gain": gain.tolist()}
            linear = linear * torch.tensor(gain, dtype=torch.float32, device=linear.device)
        if effects.sensor_noise is not None:
            noisy = effects.sensor_noise.forward(linear.cpu().numpy(), generator(self.seed, "sensor_noise", index))
            linear = torch.from_numpy(noisy)
        rgb = to_bytes(encode_srgb(linear)).cpu().numpy()
        if effects.compression is None:
            return rgb, None
        jpeg = effects.compression.encode(rgb)
        facts["compression"] = {"bytes": len(jpeg)}
        return effects.compression.decode(jpeg), jpeg

    def _measured(self, still: Picture, index: int) -> Array:
        """(H, W) what the depth sensor gives."""
        depth = still.depth.cpu().numpy()
        if self.effects.depth_noise is None:
            return depth
        albedo, gloss = still.albedo.mean(2).cpu().numpy(), still.gloss.cpu().numpy()
        return self.effects.depth_noise.forward(depth, albedo, gloss, generator(self.seed, "depth_noise", index))


@contextmanager
def drawing(work: Callable[[T], R], items: Iterable[T], workers: int | None = None) -> Iterator[Iterator[R]]:
    """`work` of each item, in order, on worker threads with one torch thread each: threads that wait for each other are far slower.

    Args:
        workers: None: one a core, at most 4.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with closing(in_order(work, items, workers or min(os.cpu_count() or 1, 4))) as results:
            yield results
    finally:
        torch.set_num_threads(before)
