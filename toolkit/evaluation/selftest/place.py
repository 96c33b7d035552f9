"""Scale and place: similarities from 1e-3 to 1e3 and 6,000 km away, and the same pictures wherever the input lies."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, Similarity, invert, pixel_grid, rays
from fieldfuse.capture.poses import checked_pose
from fieldfuse.evaluation.selftest.case import Measure, absolute, case, not_finite, relative
from fieldfuse.evaluation.selftest.edit import small_field
from fieldfuse.render.image import render_view
from fieldfuse.render.paths import look_at

GROUP = "scale and place"
EARTH = 6.0e6  # metres from an earth-centred frame's origin
SCALES = (1e-3, 1.0, 1e3)
PSNR = 0.05  # dB


def rotation(seed: int) -> Array:
    """(3, 3) random rotation."""
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return matrix * np.sign(np.linalg.det(matrix))


def similarity(scale: float, away: float, seed: int) -> Similarity:
    direction = np.random.default_rng(seed + 1).normal(size=3)
    return Similarity(scale, rotation(seed), away * direction / np.linalg.norm(direction))


def similarity_errors(input_from_working: Similarity, points: Array) -> dict[str, float]:
    """Errors of a similarity against sums written out with `math.fsum`, and of going there and back, by the model's size.

    Far from the origin a place is known to its last float64 digit, which sets what can be asked for.
    """
    digit = float(np.spacing(np.abs(input_from_working.translation).max())) / (input_from_working.scale * float(np.ptp(points)))
    there = input_from_working.points(points)
    written = np.array(
        [
            [
                math.fsum([*(input_from_working.scale * r * p for r, p in zip(row, point, strict=True)), move])
                for row, move in zip(input_from_working.rotation, input_from_working.translation, strict=True)
            ]
            for point in points
        ]
    )
    size = float(np.ptp(points))
    back = input_from_working.inverse().points(there)
    both = input_from_working.inverse().after(input_from_working)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation(5), points
    returned = input_from_working.inverse().poses(input_from_working.poses(poses))
    moved = input_from_working.poses(poses)
    return {
        "points there": absolute(there, written) / (input_from_working.scale * size) / (1e-15 + 4 * digit),
        "points there and back": absolute(back, points) / size / (1e-14 + 8 * digit),
        "composed with its inverse": absolute(both.points(points), points) / size / (1e-14 + 8 * digit),
        "poses there and back": absolute(returned, poses) / size / (1e-14 + 8 * digit),
        "poses no longer rigid": absolute(moved[:, :3, :3] @ np.swapaxes(moved[:, :3, :3], 1, 2), np.tile(np.eye(3), (len(points), 1, 1)))
        / 1e-14,
        "stored and read": absolute(Similarity.from_dict(input_from_working.to_dict()).points(points), there),
    }


@case(GROUP, "similarities ×1e-3 to ×1e3, turned, up to 6,000 km away")
def similarities(folder: Path) -> list[Measure]:
    points = np.random.default_rng(3).uniform(-2, 2, (50, 3))
    worst: dict[str, float] = {}
    for seed, (scale, away) in enumerate((scale, away) for scale in SCALES for away in (0.0, 1.0, EARTH)):
        errors = similarity_errors(similarity(scale, away, seed), points)
        worst = {name: max(worst.get(name, 0.0), error) for name, error in errors.items()}
    return [Measure(f"{name}, in what float64 can hold", error, 0.0 if name == "stored and read" else 4.0) for name, error in worst.items()]


@case(GROUP, "inverting poses 6,000 km away")
def inverted(folder: Path) -> list[Measure]:
    out = []
    for away in (1.0, EARTH):
        poses = similarity(1.0, away, 2).poses(
            look_at(np.random.default_rng(0).normal(size=(20, 3)) * 3, np.zeros(3), np.array([0.0, 0, 1]))
        )
        product = invert(poses) @ poses
        out.append(
            Measure(f"pose times its inverse, {away:g} m away", absolute(product, np.tile(np.eye(4), (20, 1, 1))), 1e-14 + 4e-16 * away)
        )
        checked = np.array([checked_pose(pose, "here") for pose in poses])
        out.append(Measure(f"places changed by the check, {away:g} m away", absolute(checked[:, :3, 3], poses[:, :3, 3]), 0.0))
        out.append(Measure(f"turned by the check, {away:g} m away", absolute(checked[:, :3, :3], poses[:, :3, :3]), 1e-12))
    return out


def placed_pictures(input_from_working: Similarity) -> tuple[Array, Array, Array]:
    """Two pictures and a depth map of one field: its camera as it is, and through a camera that came from the input's frame."""
    field = small_field(6)
    camera = Intrinsics(40, 30, 45.0, 45.0, 20.0, 15.0)
    pose = look_at(np.array([[2.5, -1.8, 1.6]]), np.array([0.1, -0.2, 0.3]), np.array([0.0, 0, 1]))[0]
    again = input_from_working.inverse().poses(input_from_working.poses(pose))
    before, after = render_view(field, camera, pose), render_view(field, camera, again)
    return before.rgb, after.rgb, np.abs(after.depth - before.depth)


@case(GROUP, "the same picture wherever the input lies")
def same_picture(folder: Path) -> list[Measure]:
    out = []
    for seed, (scale, away) in enumerate(((1e-3, 1.0), (1e3, 1.0), (1.0, EARTH), (1e3, EARTH))):
        before, after, _ = placed_pictures(similarity(scale, away, seed))
        truth = np.clip(before + 0.05 * np.sin(np.arange(before.size)).reshape(before.shape), 0, 1)
        change = abs(_psnr(after, truth) - _psnr(before, truth))
        out.append(Measure(f"PSNR against one truth, ×{scale:g} and {away:g} away, dB", change, PSNR))
    return out


def _psnr(picture: Array, truth: Array) -> float:
    return float(-10 * np.log10(np.mean((picture.astype(np.float64) - truth) ** 2)))


@case(GROUP, "a field's picture does not depend on the unit of its working frame")
def working_unit(folder: Path) -> list[Measure]:
    from dataclasses import replace

    from fieldfuse.volume.space import Space

    field = small_field(6)
    camera = Intrinsics(40, 30, 45.0, 45.0, 20.0, 15.0)
    eye, target = np.array([2.5, -1.8, 1.6]), np.array([0.1, -0.2, 0.3])
    before = render_view(field, camera, look_at(eye[None], target, np.array([0.0, 0, 1]))[0])
    out = []
    for factor in (1e-3, 1 / 3, 1e3):
        x, y, z = (factor * c for c in field.space.centre)
        space = Space((x, y, z), factor * field.space.half, field.space.shell, field.space.box)
        scaled = replace(field, space=space)
        after = render_view(scaled, camera, look_at(factor * eye[None], factor * target, np.array([0.0, 0, 1]))[0])
        both = (before.depth > 0) & (after.depth > 0)
        out.append(Measure(f"colour at ×{factor:.3g}, mean", float(np.abs(after.rgb - before.rgb).mean()), 1e-4))
        away = np.median(np.abs(after.depth[both] / factor / before.depth[both] - 1))
        out.append(Measure(f"depth at ×{factor:.3g}, median, relative", float(away), 1e-5))
        out.append(Measure(f"not finite at ×{factor:.3g}", not_finite(after.rgb, after.depth, after.opacity), 0.0))
    return out


@case(GROUP, "rays of the working frame against float64")
def ray_directions(folder: Path) -> list[Measure]:
    camera = Intrinsics(64, 48, 50.0, 55.0, 30.0, 26.0)
    pose = look_at(np.array([[1.5, -0.3, 0.8]]), np.zeros(3), np.array([0.0, 0, 1]))[0]
    pixels = pixel_grid(64, 48)
    origins, directions, cosine = rays(camera, pose, pixels)
    local = np.stack([(pixels[:, 0] - 30.0) / 50.0, (pixels[:, 1] - 26.0) / 55.0, np.ones(len(pixels))], axis=1)
    length = np.linalg.norm(local, axis=1)
    return [
        Measure("directions", absolute(directions, (local / length[:, None]) @ pose[:3, :3].T), 1e-7),
        Measure("length of directions", absolute(directions.double().norm(dim=1), torch.ones(len(pixels))), 2e-7),
        Measure("cosines, relative", relative(cosine, 1 / length), 1e-7),
        Measure("origins", absolute(origins, np.tile(pose[:3, 3], (len(pixels), 1))), 1e-7),
    ]
