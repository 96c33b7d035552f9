"""How well a mesh fits the true one: accuracy, completeness and F-score (Knapitsch et al. 2017) over points spread on both surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import open3d.core as o3c
import trimesh

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.evaluation.score import in_image
from fieldfuse.tsdf.mesh import Mesh, ray_scene

SAMPLES = 200_000  # on each surface: F-scores of the same meshes then repeat within some thousandths
VOXELS = (1, 2, 4)  # distances at which F-scores are given, in voxels
MARGIN = 0.25  # voxels before a true point where the true surface itself does not hide it
MOST_BYTES = 2 * 2**30
AT_ONCE = 1 << 19  # rays

Region = tuple[Array, Array]  # lowest and highest corner (3,)


def read_mesh(path: Path | str) -> Mesh:
    """The triangles of a .ply or .obj file, with vertex colours where there are any.

    Raises:
        InputError: missing, too large, damaged, or without triangles.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"the mesh {path} is larger than the {MOST_BYTES / 2**30:.0f} GB that are read; thin it out")
        loaded = trimesh.load_mesh(path, process=False)
        visual: Any = loaded.visual
        colours = np.asarray(visual.vertex_colors)[:, :3] if visual.kind == "vertex" else None
        mesh = Mesh.create(np.asarray(loaded.vertices), np.asarray(loaded.faces), colours)
    except OSError as error:
        raise InputError(f"cannot read the mesh {path}: {error.strerror or error}") from error
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise InputError(f"{path} is not a mesh that can be read ({type(error).__name__}); write it again as .ply") from error
    if len(mesh.triangles) == 0:
        raise InputError(f"the mesh {path} has no triangles; write it with its faces")
    return mesh


def surface_points(mesh: Mesh, count: int, seed: int = 0) -> tuple[Array, Array]:
    """(count, 3) points spread evenly by area over a mesh, and the triangle (count,) that each lies in; always the same for a seed, none
    for a mesh without area."""
    areas = mesh.areas()
    total = float(areas.sum())
    if not total > 0:
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    rng = np.random.default_rng(seed)
    # One sample in each of `count` equal shares of the area: less uneven than independent draws.
    at = (np.arange(count) + rng.random(count)) / count * total
    triangle = np.minimum(np.searchsorted(np.cumsum(areas), at, side="right"), len(areas) - 1)
    first, second = rng.random((2, count, 1))
    root = np.sqrt(first)
    a, b, c = (mesh.vertices[mesh.triangles[triangle, corner]] for corner in range(3))
    return np.asarray((1 - root) * a + root * (1 - second) * b + root * second * c), triangle


def distances(points: Array, mesh: Mesh) -> tuple[Array, Array]:
    """(N,) distance of (N, 3) points to the nearest point of a mesh's surface, and the triangle (N,) int64 that this lies in; infinite and
    0 when the mesh has no surface."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if len(mesh.triangles) == 0:
        return np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    origin = mesh.bounds().mean(axis=0)
    query = (points - origin).astype(np.float32)
    found = ray_scene(mesh, origin).compute_closest_points(o3c.Tensor.from_numpy(query))
    gaps = np.linalg.norm(found["points"].numpy().astype(np.float64) - query, axis=1)
    return gaps, found["primitive_ids"].numpy().astype(np.int64)


def inside(points: Array, region: Region | None) -> Array:
    """(N,) bool: which (N, 3) points lie in a box; None: all."""
    if region is None:
        return np.ones(len(points), bool)
    return np.asarray(np.all((points >= region[0]) & (points <= region[1]), axis=1))


def seen_points(points: Array, mesh: Mesh, cameras: Sequence[Intrinsics], world_from_camera: Array, margin: float) -> Array:
    """(N,) bool: which (N, 3) points on the surface of `mesh` some camera sees, inside its image and with nothing of the mesh before it.

    Args:
        cameras: one a pose (N, 4, 4); lenses are ignored.
        margin: length before a point where the surface itself does not hide it; some tenths of a voxel.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    seen = np.zeros(len(points), bool)
    if len(points) == 0 or len(mesh.triangles) == 0:
        return seen
    origin = mesh.bounds().mean(axis=0)  # float32 rays start near zero, wherever the scene lies
    scene = ray_scene(mesh, origin)
    for camera, pose in zip(cameras, np.asarray(world_from_camera, dtype=np.float64), strict=True):
        unseen = np.flatnonzero(~seen)
        inside = unseen[in_image(points[unseen], camera, pose)]
        for start in range(0, len(inside), AT_ONCE):
            part = inside[start : start + AT_ONCE]
            away = points[part] - pose[:3, 3]
            distance = np.linalg.norm(away, axis=1, keepdims=True)
            rays = np.concatenate([np.broadcast_to(pose[:3, 3] - origin, away.shape), away / np.maximum(distance, 1e-12)], axis=1)
            hit = scene.cast_rays(o3c.Tensor.from_numpy(rays.astype(np.float32)))["t_hit"].numpy()
            seen[part] = hit >= distance[:, 0] - margin
    return seen


def seen_surface(
    truth: Mesh,
    cameras: Sequence[Intrinsics],
    world_from_camera: Array,
    voxel_size: float,
    region: Region | None = None,
    samples: int = SAMPLES,
) -> tuple[Array, float]:
    """Points of the true surface that a reconstruction should have: those that some camera saw, in the region.

    Returns:
        (N, 3) points, and their share of the whole true surface.

    Raises:
        InputError: the cameras saw nothing of it, so mesh and poses do not belong together.
    """
    points, _ = surface_points(truth, samples)
    kept = inside(points, region)
    kept[kept] = seen_points(points[kept], truth, cameras, world_from_camera, MARGIN * voxel_size)
    if not kept.any():
        raise InputError("no camera sees anything of the ground-truth mesh; mesh and poses must be in the same frame")
    return points[kept], float(kept.mean())


def geometry_metrics(
    mesh: Mesh,
    truth: Mesh,
    wanted: Array,
    voxel_size: float,
    region: Region | None = None,
    samples: int = SAMPLES,
) -> dict[str, Any]:
    """Compare a mesh with the true one; all lengths in the meshes' unit.

    Args:
        wanted: (N, 3) points of the true surface that it has to cover, from `seen_surface`.
        voxel_size: unit of the distances at which F-scores are given.
        region: box outside which neither surface counts.

    Returns:
        plain data: `accuracy` and `accuracy_median`, distance of the mesh's points from the true surface; `completeness` and
        `completeness_median`, distance of the wanted points from the mesh; `normals`, degrees between the mesh's triangles and the
        nearest true ones in the mean, where they are at most four voxels apart, whichever side is out; for 1, 2 and 4 voxels
        `precision_n` and `recall_n`, the shares of both within that distance, and `f_score_n`, their harmonic mean; `voxel_size`.
        Without a surface: accuracy None, scores 0.
    """
    own, triangle = surface_points(mesh, samples, 1)
    kept = inside(own, region)
    own, triangle = own[kept], triangle[kept]
    to_truth, nearest = distances(own, truth)
    to_mesh, _ = distances(wanted, mesh)
    close = to_truth <= VOXELS[-1] * voxel_size
    alike = np.abs((mesh.facing(triangle[close]) * truth.facing(nearest[close])).sum(axis=1))
    out: dict[str, Any] = {
        "accuracy": _number(to_truth, np.mean),
        "accuracy_median": _number(to_truth, np.median),
        "completeness": _number(to_mesh, np.mean),
        "completeness_median": _number(to_mesh, np.median),
        "normals": _number(np.degrees(np.arccos(np.minimum(alike, 1))), np.mean),
        "voxel_size": float(voxel_size),
    }
    for n in VOXELS:
        precision, recall = (float((gap <= n * voxel_size).mean()) if len(gap) else 0.0 for gap in (to_truth, to_mesh))
        out[f"precision_{n}"], out[f"recall_{n}"] = precision, recall
        out[f"f_score_{n}"] = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return out


def _number(gaps: Array, of: Any) -> float | None:
    return float(of(gaps)) if len(gaps) and np.isfinite(gaps).all() else None
