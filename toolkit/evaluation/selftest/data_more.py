"""Depth maps with NaN, infinities, 0 and 65535, and what a scene and a surface make of captures that say little."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import FieldfuseError, InputError, PoseError
from fieldfuse.evaluation.selftest.case import Measure, absolute, case, not_finite, refused
from fieldfuse.evaluation.selftest.data import GROUP, no_opacity, poses, prepared, texture, write_capture
from fieldfuse.poses.given import given_poses
from fieldfuse.poses.scene import describe_scene
from fieldfuse.render.paths import look_at
from fieldfuse.tsdf.frames import DepthFrame
from fieldfuse.tsdf.volume import TsdfVolume

HEIGHT, WIDTH = 32, 40


def plane_depth(index: int) -> Array:
    """(H, W) float32 depth of the sphere of radius 1 round the origin, 5 where it is missed."""
    pose = poses(6)[index]
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / (1.1 * WIDTH), (v - HEIGHT / 2) / (1.1 * WIDTH), np.ones_like(u)], axis=2) @ pose[:3, :3].T
    a, b, c = (rays**2).sum(2), rays @ pose[:3, 3], (pose[:3, 3] ** 2).sum() - 1
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 5.0).astype(np.float32)


def spoilt(index: int) -> Array:
    """True depth in millimetres as float32, with rows of NaN, infinities, 0, negative and huge values."""
    depth = plane_depth(index) * 1000
    for row, value in enumerate((np.nan, np.inf, -np.inf, 0.0, -5.0, -0.0)):
        depth[row + 2] = value
    return depth


def spoilt_16_bits(index: int) -> Array:
    depth = np.round(plane_depth(index) * 1000).astype(np.uint16)
    depth[3], depth[4] = 0, 65535
    return depth


def _even(value: float, index: int) -> Array:
    return np.full((HEIGHT, WIDTH), value, np.float32)


@case(GROUP, "depth with rows of NaN, infinity, 0, negative and 65535")
def depth_holes(folder: Path) -> list[Measure]:
    out = []
    for name, make, rows in (("float32", spoilt, range(2, 8)), ("16 bits", spoilt_16_bits, (3, 4))):
        _, views = prepared(write_capture(folder / name.replace(" ", ""), depth=make))
        depths = np.array(views.depths)
        truth = np.array([plane_depth(index) for index in range(6)])
        truth[:, list(rows)] = 0
        out.append(Measure(f"{name}: depth", absolute(depths, truth), 6e-4))
        out.append(Measure(f"{name}: not finite or negative", not_finite(depths) + float((depths < 0).sum()), 0.0))
    for name, value in (("NaN", np.nan), ("infinite", np.inf), ("zero", 0.0), ("negative", -1.0)):
        path = write_capture(folder / f"all{name}", depth=partial(_even, value))
        out.append(Measure(f"all {name} taken", refused(partial(prepared, path), InputError, "depth"), 0.0))
    path = write_capture(folder / "all65535", depth=lambda index: np.full((HEIGHT, WIDTH), 65535, np.uint16))
    out.append(Measure("all 65535 taken", refused(lambda: prepared(path), InputError, "depth"), 0.0))
    return out


@case(GROUP, "fusing depth that is not finite, 0 or beyond the range")
def fused_holes(folder: Path) -> list[Measure]:
    camera = Intrinsics(WIDTH, HEIGHT, 1.1 * WIDTH, 1.1 * WIDTH, WIDTH / 2, HEIGHT / 2)
    volumes = []
    for damaged in (False, True):
        volume = TsdfVolume(0.06, 4.0, expected_blocks=200)
        for index, pose in enumerate(poses(6)):
            depth = plane_depth(index)
            depth[2:8] = 0
            if damaged:
                for row, value in enumerate((np.nan, np.inf, -np.inf, -1.0, 1e30, 65535.0)):
                    depth[row + 2] = value
            volume.integrate(DepthFrame(depth, texture(index, HEIGHT, WIDTH), camera, camera, pose))
        volumes.append(volume.mesh())
    whole, spoilt_mesh = volumes
    away = np.abs(np.linalg.norm(whole.vertices, axis=1) - 1)
    return [
        Measure("vertices that are not finite", not_finite(whole.vertices, spoilt_mesh.vertices), 0.0),
        Measure("vertices that damage added or moved", absolute(_sorted(spoilt_mesh.vertices), _sorted(whole.vertices)), 1e-6),
        Measure("distance from the sphere, median, metres", float(np.median(away)), 0.02),
    ]


def _sorted(vertices: Array) -> Array:
    return vertices[np.lexsort(vertices.round(9).T)]


@case(GROUP, "scenes of pictures without texture, opacity or motion end in a sentence or in finite numbers")
def scenes(folder: Path) -> list[Measure]:
    def still(index: int, height: int, width: int) -> Array:
        return np.asarray(np.minimum(texture(0, height, width).astype(int) + 2 * index, 255), dtype=np.uint8)

    def noise(index: int, height: int, width: int) -> Array:
        return np.asarray(np.random.default_rng(index).integers(0, 255, (height, width, 3)), dtype=np.uint8)

    out = []
    for name, paint, depth in (
        ("still", still, None), ("noise", noise, None), ("without opacity", no_opacity, None), ("spoilt depth", texture, spoilt)
    ):  # fmt: skip
        path = write_capture(folder / name.replace(" ", "_"), paint, depth=depth)
        try:
            capture, _ = prepared(path)
            scene = describe_scene(given_poses(capture).apply(capture))
        except FieldfuseError as error:
            out.append(Measure(f"{name}: refused without a sentence", float("\n" in str(error) or len(str(error)) < 20), 0.0))
            continue
        numbers = [scene.centre, scene.half_size, scene.median_depth, scene.near, scene.far, scene.working_from_input.translation]
        out.append(Measure(f"{name}: not finite", not_finite(*numbers), 0.0))
        out.append(Measure(f"{name}: sizes that are not positive", float((scene.half_size <= 0).sum() + (scene.near <= 0)), 0.0))
    still_one = np.repeat(look_at(np.array([[1.0, 2, 3]]), np.zeros(3), np.array([0.0, 0, 1])), 3, axis=0)
    capture, _ = prepared(write_capture(folder / "spot", count=3))
    frames = tuple(replace(frame, world_from_camera=pose) for frame, pose in zip(capture.frames, still_one, strict=True))
    out.append(Measure("one spot taken", refused(lambda: given_poses(replace(capture, frames=frames)), PoseError), 0.0))
    return out
