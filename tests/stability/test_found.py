"""What the fuzz runs have found, one small test for each."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from benchmarks.table import sections
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.types import Capture
from fieldfuse.config import load_settings
from fieldfuse.effects.correct import Corrections
from fieldfuse.errors import InputError
from fieldfuse.evaluation.compare_truth import find_truth
from fieldfuse.export.mesh import mesh_facts
from fieldfuse.files import read_json, write_json
from fieldfuse.nerfusion.training.settings import load_train_settings
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import RunFolder
from fieldfuse.pipelines.stages import Stage, Stages, StoredStage
from fieldfuse.poses.scene import Scene
from fieldfuse.render.bake import bake
from fieldfuse.render.bake_file import METADATA_KEY, read_baked, write_baked
from fieldfuse.simulate.mesh_scene import load_mesh_scene
from fieldfuse.simulate.settings import read_scene_file
from fieldfuse.tsdf.mesh import Mesh
from tests.stability.hard.captures import scene_of
from tests.stability.hard.fields import small_field


def test_numbers_of_400_digits_in_a_stored_capture() -> None:
    data = {**capture_to_dict(Capture("photos", Path("/x"), ())), "depth_scale": 10**400}
    with pytest.raises(InputError, match="not usable"):
        capture_from_dict(data)


@pytest.mark.parametrize("text", ["1", "- 1", "[", "null", "text", "{a: [1, 2", "? x", "a: b: c", "\x00", "[" * 50_000])
def test_yaml_that_is_no_table(text: str, tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    for read in (read_scene_file, load_train_settings, lambda path: load_settings(file=path)):
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error) and str(path) in str(error)


@pytest.mark.parametrize("value", ["NaN", "Infinity"])
def test_a_baked_field_before_a_background_that_is_no_colour(value: str, tmp_path: Path) -> None:
    path = tmp_path / "baked.safetensors"
    write_baked(path, bake(small_field(1, 0.2)))
    with safe_open(str(path), framework="np") as source:
        about = json.loads(source.metadata()[METADATA_KEY])
    about["background"][0] = float(value)
    save_file(load_file(str(path)), str(path), metadata={METADATA_KEY: json.dumps(about)})
    with pytest.raises(InputError, match="background is not a colour"):
        read_baked(path)


def test_numbers_of_400_digits_among_corrections() -> None:
    data = {**Corrections().to_dict(), "corner": 10**400}
    with pytest.raises(InputError, match=r"effects\.json is not"):
        Corrections.from_dict(data)


def test_a_surface_does_not_depend_on_the_order_in_which_threads_came_to_its_parts() -> None:
    """Open3D's threads number vertices and triangles as they come; sums over them, and so `facts.json`, differed between equal runs."""
    rng = np.random.default_rng(5)
    sphere = trimesh.creation.icosphere(4)
    vertices = np.asarray(sphere.vertices, np.float32).astype(np.float64)
    colours = rng.integers(0, 256, vertices.shape, dtype=np.uint8)
    shuffled = []
    for _ in range(12):
        places, turns = rng.permutation(len(vertices)), rng.integers(0, 3, (len(sphere.faces), 1))
        rank = np.argsort(places)
        triangles = np.take_along_axis(rank[sphere.faces], (turns + np.arange(3)) % 3, axis=1)[rng.permutation(len(sphere.faces))]
        shuffled.append(Mesh.create(vertices[places], triangles, colours[places], vertices[places]))
    assert len({mesh.areas().cumsum()[-1] for mesh in shuffled}) > 1  # what went wrong: a sum that depends on the order
    ordered = [mesh.ordered() for mesh in shuffled]
    facts = [mesh_facts(mesh) for mesh in ordered]
    assert all(fact == facts[0] for fact in facts) and facts[0]["watertight"] and facts[0]["triangles"] == len(sphere.faces)
    for mesh in ordered[1:]:
        for name in ("vertices", "triangles", "colours", "normals"):
            assert np.array_equal(getattr(mesh, name), getattr(ordered[0], name))
    corners = [mesh.vertices[mesh.triangles] for mesh in (shuffled[0], ordered[0])]
    outward = [np.einsum("tj,tj->t", np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), c.mean(1)) for c in corners]
    assert all((side > 0).all() for side in outward)  # no triangle was turned over


def test_a_stage_whose_file_rounds_answers_what_the_file_holds(tmp_path: Path) -> None:
    """Points of structure from motion keep seven digits on disk: a run that was killed after them went on with other numbers."""
    kept = tmp_path / "third.json"

    def save(value: float) -> list[Path]:
        write_json(kept, round(value, 7))
        return [kept]

    with RunFolder(tmp_path) as folder:
        stages = Stages(folder, ConsoleProgress())
        assert stages.run(Stage("plain", lambda: 1 / 3, save, lambda: read_json(kept))) == 1 / 3
        assert stages.run(StoredStage("rounded", lambda: 1 / 3, save, lambda: read_json(kept))) == 0.3333333


def test_a_scene_between_no_depths() -> None:
    """The plane sweep divides by the step from plane to plane, and said NaN."""
    data = scene_of().to_dict()
    assert Scene.from_dict(data).far == data["far"]
    for near, far in ((2.0, 2.0), (3.0, 2.0), (-1.0, 2.0), (float("nan"), 2.0), (1.0, float("nan"))):
        with pytest.raises(InputError, match=r"scene\.json is not .*depths from"):
            Scene.from_dict({**data, "near": near, "far": far})


@pytest.mark.parametrize(
    "damaged",
    [
        {
            "budget": {"asked_seconds": 1, "predicted_seconds": 0.0, "real_seconds": 1, "stages": {}, "choice": {}},
            "source": "a",
            "command": "b",
        },
        {"rows": [{"psnr": 10**400}], "command": "a"},
        {"rows": [{"id": "a", "method": "field"}], "command": "a", "unit": None, "machine": {}},
        {"methods": [{"key": "a", "stages": [1]}], "command": "a"},
        {"suite": "llff", "rows": [1], "command": "a"},
        [],
    ],
)
def test_measurements_that_are_none(damaged: object, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps(damaged))
    with pytest.raises(InputError) as told:
        sections([path], None, None)
    assert str(path) in str(told.value) or "damaged" in str(told.value) or "methods" in str(told.value)


@pytest.mark.parametrize("damage", ["a picture cut short", "a corner that is not there", "a number beyond float32", "nothing"])
def test_meshes_to_film_with_damaged_surfaces(damage: str, tmp_path: Path) -> None:
    """Textures are read where they are first looked at, behind the reader's own checks; rays were cast at triangles between no vertices."""
    cv2.imwrite(str(tmp_path / "picture.png"), np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8))
    (tmp_path / "model.mtl").write_text("newmtl paint\nKd 0.5 0.6 0.7\nmap_Kd picture.png\n")
    first = "1e200" if damage == "a number beyond float32" else "0"
    corners = f"v {first} 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    last = "9" if damage == "a corner that is not there" else "4"
    (tmp_path / "model.obj").write_text(f"mtllib model.mtl\n{corners}usemtl paint\nf 1/1 2/2 3/3\nf 1/1 2/2 {last}/3\n")
    if damage == "a picture cut short":
        data = (tmp_path / "picture.png").read_bytes()
        (tmp_path / "picture.png").write_bytes(data[: len(data) - 300])
    if damage == "nothing":
        assert len(load_mesh_scene(tmp_path / "model.obj").mesh().triangles) == 2
    else:
        with pytest.raises(InputError, match=r"model\.obj"):
            load_mesh_scene(tmp_path / "model.obj")


def test_ground_truth_whose_camera_is_no_numbers(tmp_path: Path) -> None:
    (tmp_path / "ground_truth").mkdir()
    camera = {**Intrinsics(8, 6, 7.0, 7.0, 4.0, 3.0).to_dict(), "fx": [1.0, 2.0]}
    write_json(tmp_path / "ground_truth" / "cameras.json", {"intrinsics": camera, "frames": []})
    with pytest.raises(InputError, match="does not list cameras"):
        find_truth(Capture("photos", tmp_path, ()))
