"""Tracks through simulated pictures: points taken from the exact depth of some frames and found again in the others."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.effects.effect_specs import parse
from fieldfuse.effects.light import LightTracks
from fieldfuse.effects.models import decode_srgb
from fieldfuse.simulate.film import Film, FilmCamera
from fieldfuse.simulate.materials import TextureBank
from fieldfuse.simulate.paths import PathSettings, plan
from fieldfuse.simulate.procedural import random_scene

CAMERA = Intrinsics(128, 96, 100.0, 100.0, 64.0, 48.0)
FRAMES = 12


@dataclass(frozen=True)
class Filmed:
    film: Film
    tracks: LightTracks


def film_tracks(bank: TextureBank, seed: int, effects: list[str], count: int = 60, kind: str = "room") -> Filmed:
    """Film `FRAMES` pictures and follow up to `count` points of each."""
    scene = random_scene(kind, np.random.default_rng(seed), bank)
    settings = PathSettings("walk", frames=FRAMES, fps=2.0, speed=0.4, shake=8.0)
    motion = plan(scene, settings, np.random.default_rng(seed))
    film = Film(scene, FilmCamera(CAMERA), motion, settings.times(), parse(effects, "test"), seed)
    shots = [film.shot(index) for index in range(FRAMES)]
    linear = [decode_srgb(torch.from_numpy(cv2.blur(shot.rgb, (3, 3)).astype(np.float32) / 255)).numpy() for shot in shots]
    rng = np.random.default_rng(seed)
    columns: dict[str, list[Array]] = {"linear": [], "frame": [], "point": [], "radius": []}
    points = []
    for shot in shots:
        u, v = rng.integers(4, [[CAMERA.width - 4], [CAMERA.height - 4]], (2, count))
        spread = cv2.dilate(shot.depth, np.ones((5, 5))) - cv2.erode(shot.depth, np.ones((5, 5)))
        flat = (shot.depth[v, u] > 0) & (spread[v, u] < 0.05 * shot.depth[v, u])
        first = sum(len(part) for part in points)
        points.append(unproject(CAMERA, shot.world_from_camera, np.stack([u, v], axis=1)[flat] + 0.5, shot.depth[v, u][flat]))
        for other in shots:
            pixels, depth = project(CAMERA, other.world_from_camera, points[-1])
            x, y = np.floor(np.nan_to_num(pixels, nan=-1)).astype(int).T
            inside = (x >= 2) & (y >= 2) & (x < CAMERA.width - 2) & (y < CAMERA.height - 2) & (depth > 0.1)
            seen = inside.copy()
            seen[inside] = np.abs(other.depth[y[inside], x[inside]] / depth[inside] - 1) < 0.02
            at = pixels[seen].astype(np.float32) - 0.5
            colours = cv2.remap(linear[other.index], at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR)[0] if len(at) else np.zeros((0, 3))
            columns["linear"].append(colours.reshape(-1, 3))
            columns["frame"].append(np.full(len(at), other.index))
            columns["point"].append(first + np.flatnonzero(seen))
            off = np.linalg.norm(pixels[seen] - [CAMERA.cx, CAMERA.cy], axis=1)
            columns["radius"].append(off / (0.5 * np.hypot(CAMERA.width, CAMERA.height)))
    return Filmed(film, LightTracks(**{name: np.concatenate(values) for name, values in columns.items()}))
