"""Draw training scenes from textured meshes (GLB, OBJ, PLY) ahead of time: one shard a walk, see docs/training.md.

python -m benchmarks.make_shards house.glb hospital.glb --out shards --scenes 200
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from benchmarks.experiment import application, program
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.effects.models import encode_srgb
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.procedural import hand_held
from fieldfuse.nerfusion.training.scenes import write_shard
from fieldfuse.simulate.eye import eye_of, take
from fieldfuse.simulate.mesh_scene import MeshScene, load_mesh_scene

EYES = (0.7, 1.8)  # metres above the floor
TRIES = 200
SEEN = 0.9  # share of a picture's pixels that must hit the mesh
NEAREST, FARTHEST = 0.6, 8.0  # metres: the median depth of every picture


def draw_walk(scene: MeshScene, rng: np.random.Generator, frames: int, long_side: int) -> tuple[Array, Array, Array, Array]:
    """Pictures (N, 3, H, W) uint8, depths (N, H, W), cameras (N, 4) and poses (N, 4, 4) of one walk.

    Raises:
        InputError: no walk with something to see was found.
    """
    low, high = np.asarray(scene.free, dtype=np.float64)
    floor = low[2] - 0.3
    free = np.array([[low[0], low[1], floor + EYES[0]], [high[0], high[1], floor + EYES[1]]])
    camera = Intrinsics(long_side, long_side * 3 // 4, *_focal(rng, long_side), long_side / 2, long_side * 3 // 4 / 2)
    eye = eye_of(camera, 2, torch.device("cpu"))
    for _ in range(TRIES):
        focus = rng.uniform(free[0], free[1]) * [1, 1, 0] + [0, 0, floor + rng.uniform(0.2, 1.5)]
        near = np.stack([np.maximum(free[0], focus - 3.0), np.minimum(free[1], focus + 3.0)])
        near[:, 2] = free[:, 2]
        poses = hand_held(rng, frames, near, focus, lambda p: scene.clearance(torch.from_numpy(p).float()).numpy().astype(np.float64))
        if poses is None or not all(_usable(take(scene, eye, poses[i][None]).depth) for i in (0, frames // 2, frames - 1)):
            continue
        drawn = [take(scene, eye, pose[None]) for pose in poses]
        images = np.stack([(encode_srgb(one.linear) * 255).round().byte().permute(2, 0, 1).numpy() for one in drawn])
        intrinsics = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (frames, 1))
        return images, np.stack([one.depth.numpy() for one in drawn]), intrinsics, poses
    raise InputError("no walk through the mesh shows enough of it; is it a building, in metres, z up?")


def _focal(rng: np.random.Generator, long_side: int) -> tuple[float, float]:
    focal = float(0.5 * long_side / np.tan(0.5 * np.radians(rng.uniform(45, 75))))
    return focal, focal


def _usable(depth: torch.Tensor) -> bool:
    seen = depth[depth > 0]
    return len(seen) > SEEN * depth.numel() and NEAREST < float(seen.median()) < FARTHEST


def make_shards(
    meshes: Annotated[list[Path], typer.Argument(help="Buildings with textures: GLB, OBJ, PLY.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the shards.", show_default=False)],
    scenes: Annotated[int, typer.Option(min=1, help="Walks, spread over the meshes.")] = 100,
    frames: Annotated[int, typer.Option(min=2, help="Frames of each walk.")] = 24,
    long_side: Annotated[int, typer.Option(min=16, help="Long side of the images.")] = 208,
    up: Annotated[str, typer.Option(help="The meshes' axis that points up: y or z.")] = "z",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the walks.")] = 0,
) -> None:
    """Draw training shards from textured meshes."""
    if up not in ("y", "z"):
        raise InputError(f"--up {up!r} must be y or z")
    loaded = [(path.stem, load_mesh_scene(path, up)) for path in meshes]
    for number in range(scenes):
        name, scene = loaded[number % len(loaded)]
        images, depths, intrinsics, poses = draw_walk(scene, np.random.default_rng([seed, number]), frames, long_side)
        path = out / f"{name}-{number:05d}.safetensors"
        write_shard(path, images, depths, intrinsics, poses, kind="room", ordered=True)
        sys.stderr.write(f"{path}\n")


app = application(make_shards)
if __name__ == "__main__":
    program(app)
