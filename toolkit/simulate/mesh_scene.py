"""Textured meshes (GLB, OBJ, PLY) as scenes: read by trimesh, met by Open3D's ray casting. The only module here that needs either."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.effects.models import decode_srgb
from fieldfuse.effects.scenery import Background, Highlights
from fieldfuse.errors import InputError
from fieldfuse.simulate.eye import Rays, Seen
from fieldfuse.simulate.materials import Atlas
from fieldfuse.simulate.solids import FAR, Mesh
from fieldfuse.tone import shares

Tensor = torch.Tensor

LARGEST = 1e18  # of what is read; its square must be a float32
GLTF = (".glb", ".gltf")
SUFFIXES = (*GLTF, ".obj", ".ply")
TEXTURE_SIDE = 1024  # pixels: larger textures are halved to it
SUN = (0.35, 0.25, 0.9)  # towards the light
SUN_LIGHT, SKY_LIGHT, GROUND_LIGHT = 0.38, 0.5, 0.34  # linear
STEPS_OF_DEPTH = 12.0  # a jump of distance by more than e^(1/12) is an edge


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with their textures, z up."""

    vertices: Array  # (V, 3) metres
    triangles: Array  # (F, 3)
    texture: Array  # (F,) number in the atlas of each triangle
    places: Array  # (F, 3, 2) texture place of each corner, from the upper left
    tint: Array  # (F, 3, 3) linear factor at each corner
    gloss: Array  # (F,)


class MeshScene:
    """A mesh under the sky and a sun."""

    def __init__(self, mesh: TexturedMesh, atlas: Atlas) -> None:
        import open3d as o3d

        self._o3d, self.atlas = o3d, atlas
        vertices, triangles, texture, places = mesh.vertices, mesh.triangles, mesh.texture, mesh.places
        self._mesh = Mesh(vertices.astype(np.float64), triangles.astype(np.int64))
        self._caster = o3d.t.geometry.RaycastingScene()
        as_tensor = o3d.core.Tensor.from_numpy
        self._caster.add_triangles(as_tensor(vertices.astype(np.float32)), as_tensor(triangles.astype(np.uint32)))
        corners = vertices[triangles]  # (F, 3, 3)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        u, v = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
        size = atlas.table[: atlas.count, 1:].numpy()[texture]  # (F, 2)
        texels = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) * size[:, 0] * size[:, 1]
        self.density = torch.from_numpy(np.sqrt(texels / np.maximum(area, 1e-12)) / size[:, 0]).float()  # texture widths a metre
        self.texture = torch.from_numpy(texture.astype(np.int64))
        self.places, self.tint, self.gloss = (torch.from_numpy(values).float() for values in (places, mesh.tint, mesh.gloss))
        low, high = vertices.min(0), vertices.max(0)
        margin = np.minimum([0.3, 0.3, 0.3], (high - low) / 4)
        self.free = np.stack([low + margin, high - margin])
        self.focus = (low + high) / 2
        self.background: Background | None = None
        self.highlights: Highlights | None = None

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def mesh(self) -> Mesh:
        return self._mesh

    def clearance(self, points: Tensor) -> Tensor:
        """(N,) metres to the nearest triangle, on whichever side."""
        answer = self._caster.compute_distance(self._o3d.core.Tensor.from_numpy(points.numpy().astype(np.float32)))
        return torch.from_numpy(answer.numpy())

    def see(self, beam: Rays) -> Seen:
        """What rays see. Triangles are seen from both sides; their own normal, turned to the viewer, is the surface's."""
        origins = beam.origins.expand(len(beam.directions), 3)
        rays = torch.cat([origins, beam.directions], dim=1).contiguous().numpy()
        answer = self._caster.cast_rays(self._o3d.core.Tensor.from_numpy(rays))
        distance = torch.from_numpy(answer["t_hit"].numpy())
        hit = torch.isfinite(distance)
        distance = torch.where(hit, distance, FAR)
        normals = torch.nn.functional.normalize(torch.from_numpy(answer["primitive_normals"].numpy()), dim=1)
        normals = normals * -torch.sign((normals * beam.directions).sum(1, keepdim=True)) * hit[:, None]
        face = torch.from_numpy(answer["primitive_ids"].numpy().astype(np.int64)).clamp(max=len(self.texture) - 1)
        texture = self.texture[face]
        part = (torch.log(distance) * STEPS_OF_DEPTH).long() * 97 + torch.round(normals * 2).long() @ torch.tensor([1, 5, 25])
        part = torch.where(hit, part * self.atlas.count + texture, -1)
        uv = torch.from_numpy(answer["primitive_uvs"].numpy())
        weights = torch.stack([1 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], dim=1)[..., None]  # (N, 3 corners, 1)
        slant = (beam.directions * normals).sum(1).abs().clamp(min=0.1).sqrt()
        footprint = distance * beam.spread / slant * self.density[face]
        colour = self.atlas.sample(texture, (self.places[face] * weights).sum(1), footprint)
        albedo = (colour * (self.tint[face] * weights).sum(1)).clamp(max=0.95) * hit[:, None]
        linear, gloss = self._shaded(origins, beam.directions, distance, normals, albedo, self.gloss[face] * hit)
        if self.background is not None and not bool(hit.all()):
            missed = (~hit).nonzero()[:, 0]
            linear[missed] = self.background.forward(beam.directions[missed])
        return Seen(linear, distance, normals, albedo, gloss, part)

    def _shaded(
        self, origins: Tensor, directions: Tensor, distance: Tensor, normals: Tensor, albedo: Tensor, gloss: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Light from the sky and the sun, with its shadows."""
        sun = torch.nn.functional.normalize(torch.tensor(SUN), dim=0)
        facing = (normals * sun).sum(1)
        lit = (facing > 0).nonzero()[:, 0]
        points = origins[lit] + distance[lit, None] * directions[lit] + 2e-3 * normals[lit]
        rays = torch.cat([points, sun.expand_as(points)], dim=1).contiguous().numpy()
        blocked = self._caster.test_occlusions(self._o3d.core.Tensor.from_numpy(rays)).numpy()
        light = torch.zeros_like(distance)
        light[lit] = facing[lit] * torch.from_numpy(~blocked)
        sky = GROUND_LIGHT + (0.5 + 0.5 * normals[:, 2]) * (SKY_LIGHT - GROUND_LIGHT)
        linear = albedo * (sky + SUN_LIGHT * light)[:, None]
        if self.highlights is not None:
            sharpness = torch.full_like(gloss, 40.0)
            shine = self.highlights.forward(directions, normals, sun.expand_as(normals), gloss, sharpness)
            linear = linear + (SUN_LIGHT * shine * (light > 0))[:, None]
        return linear, gloss


def load_mesh_scene(path: Path | str, up: str = "z", scale: float = 1.0) -> MeshScene:
    """Read a mesh with its textures.

    Args:
        up: "z" or "y" (glTF's own convention): which axis of the file points up.
        scale: metres a unit of the file.

    Raises:
        InputError: no such file, not a mesh, no triangles.
    """
    import trimesh

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} is no mesh that can be read; give a {', '.join(SUFFIXES)} file")
    if not path.is_file():
        raise InputError(f"the mesh {path} does not exist; correct `scene` (paths are relative to the scene file)")
    try:
        loaded = trimesh.load_scene(str(path), process=False)
        placed = [(loaded.graph[node][0], loaded.geometry[loaded.graph[node][1]]) for node in loaded.graph.nodes_geometry]
        parts = [(place, part) for place, part in placed if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # trimesh and its parsers raise many families
        raise InputError(f"{path} cannot be read as a mesh ({type(error).__name__}); open it in a viewer and save it again") from error
    if not parts:
        raise InputError(f"{path} holds no triangles; point clouds cannot be filmed")
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "y" else np.eye(3)
    try:
        pictures, joined = _joined(parts, turn * scale, path.suffix.lower() in GLTF)
    except Exception as error:  # textures are read where they are first looked at
        raise InputError(f"{path} has surfaces or textures that cannot be read ({type(error).__name__}); save it again") from error
    if not all((np.abs(joined[name]) < LARGEST).all() for name in ("vertices", "places", "tint")):  # NaN is not, either
        raise InputError(f"{path} has vertices or colours that are not finite or too large; repair the mesh")
    if joined["triangles"].min() < 0 or joined["triangles"].max() >= len(joined["vertices"]):
        raise InputError(f"{path} has triangles between vertices that it does not have; repair the mesh")
    return MeshScene(TexturedMesh(**joined), Atlas(pictures, mirrored=False))


def _joined(parts: list[tuple[Array, Any]], turn: Array, gltf: bool) -> tuple[list[Array], dict[str, Array]]:
    """All textures, and the columns of `TexturedMesh` over all parts; `turn` (3, 3) goes from the file's axes and unit to metres."""
    pictures: list[Array] = [np.ones((4, 4, 3), dtype=np.float32)]
    known: dict[int, int] = {}
    columns: dict[str, list[Array]] = {name: [] for name in ("vertices", "triangles", "texture", "places", "tint", "gloss")}
    count = 0
    for place, part in parts:
        number, tint, gloss = _surface(part, pictures, known, gltf)
        vertices = np.asarray(part.vertices) @ place[:3, :3].T + place[:3, 3]
        places = getattr(part.visual, "uv", None)
        places = np.zeros((len(part.vertices), 2)) if places is None or len(places) != len(part.vertices) else np.asarray(places)
        columns["vertices"].append(vertices @ turn.T)
        columns["triangles"].append(np.asarray(part.faces) + count)
        columns["texture"].append(np.full(len(part.faces), number))
        columns["places"].append(np.stack([places[:, 0], 1 - places[:, 1]], axis=1)[part.faces])  # trimesh counts rows from below
        columns["tint"].append(tint[part.faces])
        columns["gloss"].append(np.full(len(part.faces), gloss))
        count += len(part.vertices)
    return pictures, {name: np.concatenate(values) for name, values in columns.items()}


def _surface(part: Any, pictures: list[Array], known: dict[int, int], gltf: bool) -> tuple[int, Array, float]:
    """Texture number, linear tint of each vertex (V, 3) and gloss of one part; new textures are added to `pictures`.

    Colours of vertices are sRGB, but linear in glTF, where they multiply the material's.
    """
    white = np.ones((len(part.vertices), 3))
    material = getattr(part.visual, "material", None)
    if material is None:  # colours by vertex or by face
        if not part.visual.defined:
            return 0, _linear(white * 0.7), 0.0
        colours = shares(np.asarray(part.visual.vertex_colors)[:, :3])
        return 0, colours if gltf else _linear(colours), 0.0
    if gltf and (kept := part.visual.vertex_attributes.get("color")) is not None and len(kept) == len(white):
        white = shares(np.asarray(kept)[:, :3])
    image = getattr(material, "baseColorTexture", None)
    image = getattr(material, "image", None) if image is None else image
    factor = getattr(material, "baseColorFactor", None)
    factor = getattr(material, "diffuse", None) if factor is None else factor
    shade = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64).reshape(-1)[:3]
    shade = shade / 255.0 if shade.max() > 1 else shade
    rough = getattr(material, "roughnessFactor", None)
    gloss = 0.0 if rough is None else 0.5 * float(np.clip(1 - rough, 0, 1))
    if image is None:
        return 0, white * _linear(shade), gloss
    if id(image) not in known:
        known[id(image)] = len(pictures)
        pixels = np.asarray(image.convert("RGB"))
        share = TEXTURE_SIDE / max(pixels.shape[:2])
        if share < 1:
            pixels = cv2.resize(pixels, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        pictures.append(_linear(np.arange(256) / 255.0)[pixels])
    # Only glTF defines that the factor multiplies the texture; in OBJ files it is often a grey that nobody meant.
    return known[id(image)], white * (_linear(shade) if hasattr(material, "baseColorFactor") else 1.0), gloss


def _linear(stored: Array) -> Array:
    return np.asarray(decode_srgb(torch.from_numpy(np.asarray(stored, dtype=np.float32))).numpy())
