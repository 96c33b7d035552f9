"""Meshes as PLY, OBJ or GLB with vertex colours, or as GLB with a texture, in the input's frame; and facts about a mesh."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.atlas import Atlas
from fieldfuse.export.ply import single_precision, write_ply
from fieldfuse.files import atomic_path
from fieldfuse.tone import LINEAR
from fieldfuse.tsdf.mesh import Mesh

FORMATS = (".ply", ".obj", ".glb")
JPEG_QUALITY = 95
ROWS_AT_ONCE = 100_000
COLOUR, FULL_LIGHT = "_COLOUR", 2**16 - 1  # what trimesh calls them, and full light


def write_mesh(path: Path | str, mesh: Mesh, working_from_input: Similarity | None = None) -> None:
    """Write a mesh in the format that the suffix names: .ply, .obj (colours behind the positions, `v x y z r g b`) or .glb.

    Colours are sRGB, but linear in .glb, as glTF has them; what is lit is in them, so there its material takes no light.
    With `working_from_input` the mesh is in the working frame and is brought back to the input's; without it it is written as it is.
    Axes are kept as they are in every format: glTF viewers take y as up, so a z-up model lies on its side there and is right again in
    tools that read it back.

    Raises:
        InputError: another suffix, or an empty mesh as .glb (glTF has none).
        OutputError: the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise InputError(f"a mesh is written as {', '.join(FORMATS)}, not {path.suffix or 'without a suffix'}; rename {path.name}")
    if working_from_input is not None:
        mesh = mesh.transformed(working_from_input.inverse())
    if kind == ".ply":
        write_ply(path, mesh.vertices, mesh.colours, mesh.normals, mesh.triangles)
    elif kind == ".obj":
        _write_obj(path, mesh)
    else:
        _write_glb(path, mesh)


def write_textured(path: Path | str, mesh: Mesh, atlas: Atlas, texture: Array, working_from_input: Similarity | None = None) -> None:
    """Write a mesh with its texture (S, S, 3) uint8 as one .glb file; frames and axes as in `write_mesh`.

    What is lit is in the images already, so the material is marked as one that takes no light (KHR_materials_unlit).

    Raises:
        InputError: an empty mesh.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if len(mesh.triangles) == 0:
        raise InputError(f"the mesh has no triangles, which {path.name} cannot hold; check the depth it was made from")
    if working_from_input is not None:
        mesh = mesh.transformed(working_from_input.inverse())
    offset = np.zeros(3) if single_precision(mesh.vertices) else mesh.bounds().mean(axis=0)
    packed = packed_texture(texture)
    material = PBRMaterial(baseColorTexture=Image.open(io.BytesIO(packed)), metallicFactor=0.0, roughnessFactor=1.0)
    visual = TextureVisuals(uv=atlas.coordinates().reshape(-1, 2), material=material)
    # Each triangle has a place of its own in the texture, so it has vertices of its own.
    vertices = (mesh.vertices - offset)[mesh.triangles].reshape(-1, 3)
    triangles = np.arange(len(vertices)).reshape(-1, 3)
    solid = trimesh.Trimesh(vertices, triangles, visual=visual, process=False)

    def put_picture(buffers: dict[Any, bytes], tree: dict[str, Any]) -> None:
        """In place of what trimesh makes of the image, which it packs again, worse."""
        buffers[list(buffers)[tree["images"][0]["bufferView"]]] = packed + bytes(-len(packed) % 4)

    data = _as_glb(solid, offset, include_normals=False, buffer_postprocessor=put_picture, tree_postprocessor=_unlit)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def packed_texture(texture: Array) -> bytes:
    """(S, S, 3) uint8 as JPEG."""
    packed = io.BytesIO()
    # Neighbouring triangles of the texture need not be neighbours in space, so colours are kept for each texel, not for four of them.
    Image.fromarray(texture).save(packed, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return packed.getvalue()


def _unlit(tree: dict[str, Any]) -> None:
    """Mark the materials of a glTF file as such that show their colours whatever the light."""
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), "KHR_materials_unlit"})


def mesh_facts(mesh: Mesh) -> dict[str, Any]:
    """`vertices`, `triangles`, `watertight` (every edge has two triangles, by trimesh), `components`, `area` and `bounds` of a mesh."""
    components = mesh.components()
    return {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "watertight": bool(len(mesh.triangles)) and bool(to_trimesh(mesh).is_watertight),
        "components": int(components.max()) + 1 if len(components) else 0,
        "area": math.fsum(mesh.areas().tolist()),
        "bounds": mesh.bounds().tolist(),
    }


def to_trimesh(mesh: Mesh, offset: Array | None = None) -> trimesh.Trimesh:
    """As a trimesh mesh, nothing merged or removed; `offset` (3,) is taken off the positions."""
    vertices = mesh.vertices if offset is None else mesh.vertices - offset
    colours = np.concatenate([mesh.colours, np.full((len(mesh.colours), 1), 255, np.uint8)], axis=1)
    # A copy: trimesh marks the arrays that it is given as read-only, and Open3D cannot take such an array afterwards.
    normals = None if mesh.normals is None else mesh.normals.copy()
    return trimesh.Trimesh(vertices.copy(), mesh.triangles.copy(), vertex_normals=normals, vertex_colors=colours, process=False)


def _write_obj(path: Path, mesh: Mesh) -> None:
    normals = mesh.normals
    # Nine digits hold a float32; a model far from its frame's origin needs all seventeen of a float64.
    vertex = "v {0} {0} {0} %.5g %.5g %.5g\n".format("%.9g" if single_precision(mesh.vertices) else "%.17g")
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii") as file:
        file.write("# vertices: x y z red green blue (colours 0 to 1)\n")
        for start in range(0, len(mesh.vertices), ROWS_AT_ONCE):
            part = slice(start, start + ROWS_AT_ONCE)
            rows = np.concatenate([mesh.vertices[part], mesh.colours[part] / 255], axis=1)
            file.write(_lines(vertex, rows))
            if normals is not None:
                file.write(_lines("vn %.5g %.5g %.5g\n", normals[part]))
        template = "f %d//%d %d//%d %d//%d\n" if normals is not None else "f %d %d %d\n"
        for start in range(0, len(mesh.triangles), ROWS_AT_ONCE):
            corners = mesh.triangles[start : start + ROWS_AT_ONCE] + 1
            rows = np.repeat(corners, 2, axis=1) if normals is not None else corners
            file.write(_lines(template, rows))


def _lines(template: str, rows: Array) -> str:
    """Each row of numbers as a line: all at once takes half the time."""
    return (template * len(rows)) % tuple(rows.reshape(-1).tolist())


def _write_glb(path: Path, mesh: Mesh) -> None:
    if len(mesh.triangles) == 0:
        raise InputError(f"the mesh has no triangles, which {path.name} cannot hold; write it as .ply or check the depth it was made from")
    # glTF positions are float32: a model far from its origin keeps its place in the node, whose matrix is written in full.
    offset = np.zeros(3) if single_precision(mesh.vertices) else mesh.bounds().mean(axis=0)
    solid = to_trimesh(mesh, offset)
    solid.visual = TextureVisuals(material=PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0))
    # glTF multiplies light by them, so they are linear; in 8 bits the dark ones would lie in bands.
    linear = np.round(LINEAR[mesh.colours].astype(np.float64) * FULL_LIGHT).astype(np.uint16)
    solid.vertex_attributes[COLOUR] = np.concatenate([linear, np.full((len(linear), 1), FULL_LIGHT, np.uint16)], axis=1)

    def name_colours(tree: dict[str, Any]) -> None:
        """trimesh writes colours of vertices in 8 bits, and other numbers of vertices as they are."""
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["COLOR_0"] = attributes.pop(COLOUR)
        tree["accessors"][attributes["COLOR_0"]]["normalized"] = True
        _unlit(tree)

    data = _as_glb(solid, offset, include_normals=mesh.normals is not None, tree_postprocessor=name_colours)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _as_glb(mesh: trimesh.Trimesh, offset: Array, **options: Any) -> bytes:
    """A file of one mesh in a node that moves it by `offset`."""
    node = np.eye(4)
    node[:3, 3] = offset
    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="mesh", geom_name="mesh", transform=node)
    return bytes(scene.export(file_type="glb", **options))
