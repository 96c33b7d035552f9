"""Samples of what people give besides captures: meshes with textures, ground truth, published data sets to train on."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors.numpy import save_file

from fieldfuse.camera import Intrinsics
from fieldfuse.capture import open_capture
from fieldfuse.capture.types import Views
from fieldfuse.evaluation.compare_truth import find_truth, true_depths
from fieldfuse.files import write_json
from fieldfuse.nerfusion.training.scenes import (
    CapturedScene,
    dtu_scene,
    dtu_scenes,
    scanned_object_folders,
    scanned_object_scene,
    scannet_folders,
    scannet_scene,
    synthetic_folders,
    synthetic_scene,
)
from fieldfuse.render.splat_files import open_splats, save_splats, to_ply
from fieldfuse.render.splats import Splats
from fieldfuse.simulate.eye import Rays
from fieldfuse.simulate.mesh_scene import load_mesh_scene
from tests.capture.layouts import LAYOUTS
from tests.nerfusion.training import layouts
from tests.render.made import some_splats
from tests.stability.fuzz.watch import all_of

MESHES = ("ascii.ply", "binary.ply", "coloured.ply", "model.obj", "model.mtl", "picture.png", "model.glb", "model.gltf")
TRUTH = ("ground_truth/cameras.json", "ground_truth/0.safetensors", "ground_truth/mesh.ply")
DATASETS = (
    "dtu/Cameras/train/00000001_cam.txt", "dtu/Depths/scan1_train/depth_map_0002.pfm", "dtu/train.txt",
    "scannet/scans/scene0000_00/pose/3.txt", "scannet/scans/scene0000_00/intrinsic/intrinsic_depth.txt",
    "objects/object_0/pose/002.txt", "objects/object_0/intrinsics/001.txt", "synthetic/chair/transforms_train.json",
)  # fmt: skip


def make_meshes(root: Path) -> None:
    """A box in every format that is read, one with colours at vertices, two with a picture on it."""
    import trimesh

    root.mkdir(parents=True)
    box = trimesh.creation.box()
    (root / "ascii.ply").write_bytes(box.export(file_type="ply", encoding="ascii"))
    (root / "binary.ply").write_bytes(box.export(file_type="ply"))
    coloured = box.copy()
    coloured.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (len(box.vertices), 4), dtype=np.uint8)
    (root / "coloured.ply").write_bytes(coloured.export(file_type="ply"))
    Image.fromarray(layouts.picture(1, 16, 12)).save(root / "picture.png")
    (root / "model.mtl").write_text("newmtl paint\nKd 0.5 0.6 0.7\nmap_Kd picture.png\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    (root / "model.obj").write_text(f"mtllib model.mtl\n{corners}usemtl paint\nf 1/1 2/2 3/3\nf 1/1 2/2 4/3\n")
    painted = trimesh.load(root / "model.obj", process=False)
    (root / "model.glb").write_bytes(painted.export(file_type="glb"))
    for name, content in painted.export(file_type="gltf").items():
        (root / name).write_bytes(content)


def read_meshes(root: Path, number: int) -> None:
    """Each file as a mesh and as a scene to film, with a few rays."""
    from fieldfuse.evaluation.geometry import read_mesh, surface_points  # here, for workers that read other things: it brings Open3D

    directions = torch.nn.functional.normalize(torch.tensor([[0.1, 0.1, -1.0], [0.0, 0.2, -1.0]]), dim=1)
    rays = Rays(torch.tensor([[0.0, 0.0, 3.0]]), directions, 0.01)
    names = [name for name in MESHES if not name.endswith((".mtl", ".png"))]
    all_of(
        *(lambda name=name: surface_points(read_mesh(root / name), 50) for name in names),  # type: ignore[misc]
        *(lambda name=name: load_mesh_scene(root / name).see(rays) for name in names),  # type: ignore[misc]
    )


SPLATS = ("0.ply", "1.ply", "ascii.ply", "3.spz", "1.spz")


def make_splats(root: Path) -> None:
    """Splats of several degrees in both formats."""
    root.mkdir(parents=True, exist_ok=True)
    for name in SPLATS:
        values = some_splats(12, 0 if name == "ascii.ply" else int(name[0]))
        save_splats(root / name, Splats(values, np.zeros(3)))
    header, rows = to_ply(Splats(values[:, :14], np.zeros(3))).split(b"end_header\n", 1)
    lines = "\n".join(" ".join(f"{value:.5g}" for value in row) for row in np.frombuffer(rows, "<f4").reshape(12, -1))
    text = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode()
    (root / "ascii.ply").write_bytes(text)


def read_splats(root: Path, number: int) -> None:
    """Read them and draw what was read."""

    def drawn(name: str) -> None:
        splats = open_splats(root / name)
        if not np.isfinite(splats.render(Intrinsics(40, 30, 35.0, 36.0, 21.0, 14.0), np.eye(4)).rgb).all():
            raise ValueError("a colour that is not finite")

    all_of(*(partial(drawn, name) for name in SPLATS))


def make_truth(root: Path) -> None:
    """A capture that brings its true surface and depth."""
    import trimesh

    LAYOUTS["transforms"][1](root)
    (root / "ground_truth").mkdir()
    (root / "ground_truth" / "mesh.ply").write_bytes(trimesh.creation.box().export(file_type="ply"))
    save_file({"depth": np.ones((30, 40), np.float32)}, root / "ground_truth" / "0.safetensors")
    pictures = json.loads((root / "transforms.json").read_text())["frames"]
    frames = [{"picture": frame["file_path"], "truth": "ground_truth/0.safetensors"} for frame in pictures]
    camera = Intrinsics(80, 60, 71.0, 73.0, 42.25, 27.5).to_dict()
    write_json(root / "ground_truth" / "cameras.json", {"intrinsics": camera, "frames": frames})


def read_truth(root: Path, number: int) -> None:
    """Depth of one view and points of the surface."""
    from fieldfuse.evaluation.geometry import read_mesh, surface_points

    capture = open_capture(root)
    truth = find_truth(capture)
    if truth is None:
        return
    camera = Intrinsics(40, 30, 35.0, 36.0, 21.0, 14.0)
    picture = np.zeros((30, 40, 3), np.uint8)
    (depth,) = true_depths(truth, capture, Views(["a"], [picture], [camera], np.eye(4)[None], np.ones(1, bool)), [0], 2.0)
    if depth is not None and depth.shape != (30, 40):
        raise ValueError("a depth of another size")
    if truth.mesh is not None:
        surface_points(read_mesh(truth.mesh), 50)


def make_datasets(root: Path) -> None:
    """The layouts that `fieldfuse train` reads, small."""
    layouts.dtu(root / "dtu", views=4, scans=(1,), lights=(0,))
    (root / "dtu" / "train.txt").write_text("scan1\n", encoding="utf-8")
    layouts.scannet(root / "scannet", scenes=1, frames=4)
    layouts.scanned_objects(root / "objects", objects=1, views=4)
    layouts.synthetic(root / "synthetic", scenes=("chair",), views=4)


def read_datasets(root: Path, number: int) -> None:
    """A picture of each."""
    all_of(
        lambda: finite(dtu_scene(dtu_scenes(root / "dtu")[0], 160)),
        lambda: finite(scannet_scene(scannet_folders(root / "scannet")[0], 64)),
        lambda: finite(scanned_object_scene(scanned_object_folders(root / "objects")[0], 32)),
        lambda: finite(synthetic_scene(synthetic_folders(root / "synthetic")[0], 32)),
    )


def finite(scene: CapturedScene) -> None:
    """Look at the last picture; views whose pose is not known are left out."""
    found = scene.pictures([len(scene.world_from_camera) - 1])
    if not bool(torch.isfinite(found.world_from_camera).all() and torch.isfinite(found.intrinsics).all()):
        raise ValueError("a camera that is not finite")
