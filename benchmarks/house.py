"""`python -m benchmarks.house --mesh GLB --out DIR`: a walk through all rooms of a furnished building, as a capture with given poses.

A very large scene with exact cameras and surfaces. The mesh is in metres, z up, on one floor.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from scipy.ndimage import gaussian_filter1d, label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from benchmarks.experiment import application, markdown, program, show
from fieldfuse.camera import Array
from fieldfuse.effects.effect_specs import parse
from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet
from fieldfuse.simulate.eye import Rays, Scenery
from fieldfuse.simulate.film import Film, FilmCamera, drawing
from fieldfuse.simulate.mesh_scene import load_mesh_scene
from fieldfuse.simulate.paths import Curve, Motion
from fieldfuse.simulate.settings import CameraSettings
from fieldfuse.simulate.simulate import CaptureWriter

CELL = 0.2  # metres, of the grid on which ways are planned
EYES = (1.2, 1.5)  # metres above the floor: the first and the second pass
BODY = (0.5, 0.85, *EYES)  # metres above the floor, where a person needs clearance
CLEARANCE = 0.35  # metres to walls and furniture
FLAT = 0.15  # metres by which the floor may rise or fall
NARROW = 1.0  # metres cost up to twice as much near walls and furniture, so that ways keep off them
REACH = 2.0  # metres, those: from every free place to the next stop of the walk
STEP = 0.05  # metres between samples of the path
ROUNDING, ROUNDS = 0.3, 4  # metres over which corners are rounded, and how often
AHEAD = 1.0  # metres: the camera looks at where it will be then
ASIDE = 0.3  # metres that it looks farther away from walls, so that it turns round towards the room
SWAY, WAVE = 30.0, 6.0  # degrees to the left and right; metres of a period
DOWN = (8.0, 14.0)  # degrees below the horizon, of the two passes
TURN = 60.0  # degrees a metre at full speed: where the view turns faster, the walk slows down
SPEED = 0.5  # metres a second
LONGEST = 0.25  # metres between frames at most, with two passes; else there is one
FOV = 72.0  # degrees
EFFECTS = [{"background": {"detail": 0}}, {"compression": {"quality": 95}}]  # a plain sky; JPEG
WORKERS = 2


@dataclass(frozen=True)
class FreeSpace:
    """Where a person can walk: the largest connected part of a building's floor, as a grid."""

    scene: Scenery
    floor: float  # metres, z
    places: Array  # (N, 2) metres, x and y of free cells
    graph: csr_array  # (N, N) metres between neighbouring cells, up to twice as many where it is narrow

    def clearance(self, places: Array) -> Array:
        """(K,) metres from a person who stands at (K, 2) to the nearest surface."""
        return _clearance(self.scene, self.floor, places)

    def slope(self, places: Array) -> Array:
        """(K, 2) gradient of the clearance: away from what is nearest, about 1 long."""
        return np.stack([self.clearance(places + step) - self.clearance(places - step) for step in CELL * np.eye(2)], axis=1) / (2 * CELL)


def _clearance(scene: Scenery, floor: float, places: Array) -> Array:
    """(K,) metres from a person who stands at (K, 2) to the nearest surface."""
    points = np.concatenate([np.column_stack([places, np.full(len(places), floor + height)]) for height in BODY])
    return np.asarray(scene.clearance(torch.from_numpy(points).float()).view(len(BODY), -1).amin(0).numpy())


def free_space(scene: Scenery) -> FreeSpace:
    """Free cells and the ways between them, from rays down to the floor and distances to the nearest surface.

    Raises:
        InputError: there is no room to walk.
    """
    low, high = scene.free
    x, y = (np.arange(low[axis], high[axis], CELL) for axis in (0, 1))
    cells = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)  # (X, Y, 2)
    places = cells.reshape(-1, 2)
    start = min(scene.mesh().vertices[:, 2].min() + EYES[0], high[2])
    origins = torch.from_numpy(np.column_stack([places, np.full(len(places), start)])).float()
    below = start - scene.see(Rays(origins, torch.tensor([0.0, 0.0, -1.0]).repeat(len(origins), 1), 0.0)).distance.numpy()
    hit = below > start - EYES[0] - 1  # outside the building there is nothing below
    floor = float(np.median(below[hit])) if hit.any() else 0.0
    room = _clearance(scene, floor, places)
    free = hit & (np.abs(below - floor) < FLAT) & (room >= CLEARANCE)
    parts, _ = label(free.reshape(cells.shape[:2]), np.ones((3, 3)))
    sizes = np.bincount(parts.ravel())[1:]
    if not len(sizes) or sizes.max() < 4:
        raise InputError("the mesh has no floor with room to walk; it must be a building, in metres, z up")
    inside = parts == 1 + sizes.argmax()
    number = np.where(inside, np.cumsum(inside.ravel()).reshape(inside.shape) - 1, -1)
    padded = np.pad(number, 1, constant_values=-1)
    pairs = list[Array]()
    for right, up in ((1, 0), (0, 1), (1, 1), (1, -1)):
        other = padded[1 + right : 1 + right + number.shape[0], 1 + up : 1 + up + number.shape[1]]
        pairs.append(np.stack([number, other], axis=-1)[(number >= 0) & (other >= 0)])
    ends = np.concatenate(pairs)
    length = np.linalg.norm(cells[inside][ends[:, 0]] - cells[inside][ends[:, 1]], axis=1)
    length *= 1 + NARROW * (CLEARANCE / room.reshape(inside.shape)[inside])[ends].mean(axis=1)
    return FreeSpace(scene, floor, cells[inside], csr_array((length, ends.T), shape=(inside.sum(),) * 2))


def stops(free: FreeSpace) -> Array:
    """(K,) cells from which every free cell is within `REACH`: a greedy set cover."""
    parts = np.array_split(np.arange(len(free.places)), 1 + len(free.places) // 512)
    near = np.concatenate([dijkstra(free.graph, directed=False, indices=part, limit=REACH) <= REACH for part in parts])
    missing, chosen = np.ones(len(near), bool), list[int]()
    while missing.any():
        chosen.append(int((near @ missing.astype(np.float32)).argmax()))
        missing &= ~near[chosen[-1]]
    return np.array(chosen)


def shortest_round(lengths: Array) -> list[int]:
    """The order of a short round trip over (K, K) distances: always to the nearest, then improved by reversing parts of it (2-opt)."""
    order, left = [0], set(range(1, len(lengths)))
    while left:
        order.append(min(left, key=lambda stop: lengths[order[-1], stop]))
        left.remove(order[-1])
    shorter = True
    while shorter:
        shorter = False
        for first in range(1, len(order) - 1):
            for last in range(first + 1, len(order)):
                a, b, c, d = order[first - 1], order[first], order[last], order[(last + 1) % len(order)]
                if lengths[a, c] + lengths[b, d] < lengths[a, b] + lengths[c, d] - 1e-9:
                    order[first : last + 1] = order[first : last + 1][::-1]
                    shorter = True
    return order


def tour(free: FreeSpace) -> Array:
    """(S, 2) metres, a closed path past all free places, a sample each `STEP`, its corners rounded as far as there is room."""
    chosen = stops(free)
    lengths, before = dijkstra(free.graph, directed=False, indices=chosen, return_predecessors=True)
    order, cells = shortest_round(lengths[:, chosen]), list[int]()
    for start, end in zip(order, order[1:] + order[:1], strict=True):
        cell = int(chosen[start])
        while cell != chosen[end]:  # predecessors lead from here back to the end
            cells.append(cell)
            cell = int(before[end, cell])
    path = _resampled(free.places[cells] if len(cells) > 1 else free.places[[0, 1]])
    for _ in range(ROUNDS):
        rounded = gaussian_filter1d(path, ROUNDING / STEP, axis=0, mode="wrap")
        path = np.where((free.clearance(rounded) >= CLEARANCE)[:, None], rounded, path)
    return _resampled(path)


def _resampled(path: Array) -> Array:
    """A closed path (P, 2) with samples each `STEP`."""
    closed = np.concatenate([path, path[:1]])
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    where = np.linspace(0, at[-1], max(2, round(at[-1] / STEP)), endpoint=False)
    return np.stack([np.interp(where, at, column) for column in closed.T], axis=1)


def walk(free: FreeSpace, path: Array, passes: int, rng: np.random.Generator) -> Curve:
    """The camera's way along a closed path (S, 2): once, or also back at another height.

    Its length is in metres; where the view turns fast, each `TURN` degrees count as one.
    """
    there = np.concatenate([path, path[::-1]][:passes])
    number = np.repeat(np.arange(passes), len(path))
    along = np.arange(len(there)) * STEP
    way = np.roll(there, -round(AHEAD / STEP), axis=0) - there + ASIDE * free.slope(there)
    yaw = gaussian_filter1d(np.unwrap(np.arctan2(way[:, 1], way[:, 0])), AHEAD / 2 / STEP, mode="nearest")
    yaw += np.radians(SWAY) * np.sin(2 * np.pi * along / WAVE + rng.uniform(0, 2 * np.pi))
    height, down = (gaussian_filter1d(np.array(values)[number], AHEAD / STEP) for values in (EYES, np.radians(DOWN)))
    places = np.column_stack([there, free.floor + height])
    forward = np.column_stack([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)])
    steps = np.maximum(np.linalg.norm(np.diff(places, axis=0), axis=1), np.abs(np.diff(np.degrees(yaw))) / TURN)
    return Curve(np.concatenate([[0], np.cumsum(np.maximum(steps, 1e-6))]), places, forward, closed=False)


def planned(scene: Scenery, frames: int, seed: int) -> Curve:
    """The walk through a building, twice where the frames suffice."""
    free = free_space(scene)
    path = tour(free)
    passes = 2 if frames * LONGEST >= 2 * STEP * len(path) else 1
    return walk(free, path, passes, np.random.default_rng(seed))


def house(
    mesh: Annotated[Path, typer.Option(help="A building with textures: GLB, OBJ, PLY.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the capture; must not hold anything yet.", show_default=False)],
    frames: Annotated[int, typer.Option(min=2, max=100_000, help="Images.")] = 900,
    width: Annotated[int, typer.Option(min=16, max=4096, help="Pixels.")] = 640,
    height: Annotated[int, typer.Option(min=16, max=4096, help="Pixels.")] = 480,
    seed: Annotated[int, typer.Option(min=0, help="Where to the view sways first.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Walk through all rooms of a building and write what the camera sees as a capture with given poses."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} already holds something; give a new folder with --out, or remove it")
    progress = make_progress(quiet)
    with progress.listening(), progress.stage("plan"):
        scene = load_mesh_scene(mesh)
        curve = planned(scene, frames, seed)
    camera = FilmCamera(CameraSettings(width=width, height=height, fov=FOV).intrinsics())
    times = np.linspace(0, curve.length / SPEED, frames)
    film = Film(scene, camera, Motion(curve, SPEED), times, parse(EFFECTS, "the effects"), seed)
    with (
        progress.listening(),
        progress.stage("film"),
        atomic_path(out) as temporary,
        closing(CaptureWriter(temporary, film.intrinsics, frames / times[-1], "frames", ".jpg", per_pixel=False)) as writer,
        drawing(film.shot, range(frames), WORKERS) as shots,
    ):
        for done, shot in enumerate(shots):
            progress.check()
            writer.add(shot)
            progress.update(done + 1, frames)
        writer.finish({"scene": mesh.name, "seed": seed, "frames": frames}, film.effects.describe(), scene.mesh())
    metres = np.linalg.norm(np.diff(film.world_from_camera[:, :3, 3], axis=0), axis=1)
    show(markdown(["frames", "metres", "longest step, m"], [[frames, f"{metres.sum():.0f}", f"{metres.max():.2f}"]]), quiet)


app = application(house)
if __name__ == "__main__":
    program(app)
