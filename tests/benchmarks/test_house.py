"""The walk through a building: all rooms that have a door, clear of walls, without haste."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from benchmarks import house
from fieldfuse.camera import Array
from fieldfuse.capture import open_capture
from fieldfuse.errors import InputError
from fieldfuse.simulate.mesh_scene import MeshScene, load_mesh_scene
from fieldfuse.simulate.paths import Curve, Motion

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("open3d")

LEFT, RIGHT, SHUT = (-2.0, 0.0), (2.0, 0.0), (0.0, 3.5)  # the rooms' middles: two with a door between them, and one without
BOXES = [  # low and high corners, metres
    ((-4, -2, -0.1), (4, 5, 0)),
    *(((x - 0.1, -2, 0), (x + 0.1, 5, 2.5)) for x in (-4, 4)),
    *(((-4, y - 0.1, 0), (4, y + 0.1, 2.5)) for y in (-2, 2, 5)),
    *(((-0.1, low, 0), (0.1, high, 2.5)) for low, high in ((-2, -0.5), (0.5, 2))),
    ((1.5, -0.5, 0), (2.5, 0.5, 0.7)),  # a table
]


def built(folder: Path, boxes: list[tuple[tuple[float, ...], tuple[float, ...]]]) -> MeshScene:
    trimesh.util.concatenate([trimesh.creation.box(bounds=box) for box in boxes]).export(folder / "rooms.ply")
    return load_mesh_scene(folder / "rooms.ply")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> MeshScene:
    return built(tmp_path_factory.mktemp("rooms"), BOXES)


def turns(curve: Curve, frames: int) -> Array:
    """(frames - 1,) degrees between frames."""
    turn = Motion(curve, 1.0).poses(np.linspace(0, curve.length, frames))[:, :3, :3]
    cosine = (np.einsum("nij,nij->n", turn[1:], turn[:-1]) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_the_walk_passes_all_that_can_be_reached(scene: MeshScene) -> None:
    free = house.free_space(scene)
    assert abs(free.floor) < 0.01
    path = cKDTree(house.tour(free))
    assert path.query(free.places)[0].max() < house.REACH
    assert all(path.query(room)[0] < 1.5 for room in (LEFT, RIGHT))
    assert path.query(SHUT)[0] > 1.5 and free.places[:, 1].max() < 2
    assert cKDTree(free.places).query(RIGHT)[0] > 0.5 + house.CLEARANCE - house.CELL  # nobody walks over the table


def test_two_passes_at_two_heights_clear_of_walls_and_without_haste(scene: MeshScene) -> None:
    frames = 600
    curve = house.planned(scene, frames, seed=0)
    assert scene.clearance(torch.from_numpy(curve.places).float()).min() > house.CLEARANCE - house.STEP
    middle = len(curve.places) // 4
    assert curve.places[[middle, -middle], 2] == pytest.approx(house.EYES, abs=0.01)
    assert turns(curve, frames).max() < 1.1 * house.TURN * curve.length / frames
    again = house.planned(scene, frames, seed=0)
    assert np.array_equal(curve.places, again.places) and np.array_equal(curve.forward, again.forward)
    once = house.planned(scene, 20, seed=0)
    assert once.places[:, 2] == pytest.approx(house.EYES[0], abs=1e-6) and len(once.places) == len(curve.places) // 2


def test_a_round_trip_without_detours() -> None:
    around = np.exp(1j * np.random.default_rng(0).permutation(12) / 12 * 2 * np.pi)
    lengths = np.abs(around[:, None] - around)
    order = house.shortest_round(lengths)
    assert sorted(order) == list(range(12))
    assert sum(lengths[order, np.roll(order, -1)]) == pytest.approx(24 * np.sin(np.pi / 12))


def test_a_mesh_without_a_floor_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no floor with room to walk"):
        house.free_space(built(tmp_path, [((0, 0, 0), (0.5, 0.5, 2))]))


def test_the_capture_has_poses_and_no_ground_truth_per_pixel(tmp_path: Path) -> None:
    built(tmp_path, BOXES)
    out = tmp_path / "capture"
    house.house(tmp_path / "rooms.ply", out, frames=3, width=32, height=24, quiet=True)
    capture = open_capture(out)
    assert len(capture.frames) == 3 and all(frame.world_from_camera is not None for frame in capture.frames)
    assert sorted(path.name for path in (out / "ground_truth").iterdir()) == ["cameras.json", "effects.json", "mesh.ply", "scene.json"]
    with pytest.raises(InputError, match="already holds something"):
        house.house(tmp_path / "rooms.ply", out, quiet=True)
