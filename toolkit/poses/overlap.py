"""How much two posed cameras see in common, and under which parallax. Pure NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert

GRID = 5  # pixels a side of the lattice that stands for an image
SWEET = 8.0  # degrees of parallax that suit matching and triangulation best
NARROW = 3.0  # degrees: how fast the worth falls below the sweet spot
WIDE = 12.0  # degrees: how fast it falls above


def convergence(world_from_camera: Array) -> tuple[Array, Array, Array]:
    """The point closest to all optical axes, robustly (least squares reweighted to least absolute distances).

    Returns:
        the point (3,), each camera's depth of it along its axis (N,), and each axis' distance from it (N,).
    """
    centres, axes = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weights = np.ones(len(axes))
    point = centres.mean(axis=0)
    for _ in range(20):
        # A little pull to the cameras' centre keeps parallel axes solvable.
        normal = (weights[:, None, None] * across).sum(axis=0) + 1e-6 * weights.sum() * np.eye(3)
        side = (weights[:, None] * np.einsum("nij,nj->ni", across, centres)).sum(axis=0) + 1e-6 * weights.sum() * centres.mean(axis=0)
        point = np.linalg.solve(normal, side)
        miss = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        weights = 1.0 / np.maximum(miss, 1e-3 * (np.median(miss) + 1e-12))
    depth = np.einsum("ni,ni->n", point - centres, axes)
    return point, depth, miss


def guessed_depth(world_from_camera: Array) -> float:
    """A depth for cameras of which nothing else is known: where their axes meet, else a few times the cameras' spread."""
    _, depth, _ = convergence(world_from_camera)
    spread = 3.0 * float(np.median(np.linalg.norm(world_from_camera[:, :3, 3] - np.median(world_from_camera[:, :3, 3], axis=0), axis=1)))
    front = depth[depth > 0]
    if len(front) >= 0.7 * len(depth):
        return float(max(np.median(front), 0.5 * spread, 1e-9))
    return max(spread, 1e-9)


def _lattice(world_from_camera: Array, intrinsics: Sequence[Intrinsics], depth: float | Array) -> Array:
    """(N, grid, 3) points in the world of a lattice of each image, taken as a plane at `depth` (one, or (N,) one a frame). Lenses are
    ignored."""
    steps = (np.arange(GRID) + 0.5) / GRID
    u, v = (axis.ravel() for axis in np.meshgrid(steps, steps))
    flat = [
        np.stack([(u * one.width - one.cx) / one.fx, (v * one.height - one.cy) / one.fy, np.ones_like(u)], axis=1) for one in intrinsics
    ]
    depths = np.broadcast_to(np.asarray(depth, dtype=np.float64), (len(flat),))
    points = np.array(flat).reshape(-1, len(u), 3) * depths[:, None, None]
    return np.asarray(points @ np.swapaxes(world_from_camera[:, :3, :3], 1, 2) + world_from_camera[:, None, :3, 3])


def overlap(world_from_camera: Array, intrinsics: Sequence[Intrinsics], depth: float | Array) -> Array:
    """(N, N) share of image i, taken as a plane at `depth` (one, or (N,) one a frame), that lies inside image j. Lenses are ignored."""
    camera_from_world = invert(world_from_camera)
    size = np.array([[c.width, c.height] for c in intrinsics], dtype=np.float64).reshape(-1, 1, 2)
    focal = np.array([[c.fx, c.fy] for c in intrinsics]).reshape(-1, 1, 2)
    centre = np.array([[c.cx, c.cy] for c in intrinsics]).reshape(-1, 1, 2)
    shares = np.zeros((len(intrinsics), len(intrinsics)))
    for i, world in enumerate(_lattice(world_from_camera, intrinsics, depth)):
        seen = np.einsum("nij,gj->ngi", camera_from_world[:, :3, :3], world) + camera_from_world[:, None, :3, 3]  # (N, grid, 3)
        z = seen[..., 2]
        pixels = seen[..., :2] / np.where(z > 1e-9, z, 1.0)[..., None] * focal + centre
        shares[i] = ((z > 1e-9) & np.all((pixels >= 0) & (pixels <= size), axis=-1)).mean(axis=1)
    return shares


def parallax(world_from_camera: Array, depth: float | Array) -> Array:
    """(N, N) degrees under which frame i's central point at `depth` sees the two cameras."""
    depths = np.broadcast_to(np.asarray(depth, dtype=np.float64), (len(world_from_camera),))
    return _angles(world_from_camera, (world_from_camera[:, :3, 3] + world_from_camera[:, :3, 2] * depths[:, None])[:, None])


def spread_parallax(world_from_camera: Array, intrinsics: Sequence[Intrinsics], depth: float) -> Array:
    """(N, N) mean degrees under which a lattice of frame i's points at `depth` sees the two cameras, the whole image over. A camera that
    moves along its axis sees the middle of its image from one direction, and what lies around it from several. Lenses are ignored."""
    return _angles(world_from_camera, _lattice(world_from_camera, intrinsics, depth))


def _angles(world_from_camera: Array, points: Array) -> Array:
    """(N, N) mean degrees between the ways from frame i's points (N, K, 3) to its own camera and to another."""
    angles = np.zeros((len(points), len(points)))
    for i, mine in enumerate(points):
        rays = world_from_camera[:, None, :3, 3] - mine  # (N, K, 3)
        rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-15)
        angles[i] = np.degrees(np.arccos(np.clip((rays * rays[i]).sum(-1), -1.0, 1.0))).mean(-1)
    return angles


def worth(angles: Array, sweet: float = SWEET) -> Array:
    """How good degrees of parallax are for a pair, 0–1: a bump at `sweet`, steeper below than above (as in view selection for MVS, Yao
    2018)."""
    off = angles - sweet
    width = np.where(off < 0, NARROW, WIDE)
    bump: Array = np.exp(-0.5 * (off / width) ** 2)
    return bump


def best_neighbours(world_from_camera: Array, shares: Array, angles: Array, count: int, sweet: float = SWEET) -> Array:
    """(N, count) indices of the frames that suit each frame best, best first; later ones prefer another side than earlier ones.

    Frames without any overlap come last, by distance; with fewer than count + 1 frames the columns are as many as there are others.
    """
    total = len(world_from_camera)
    count = min(count, total - 1)
    centres = world_from_camera[:, :3, 3]
    score = np.sqrt(shares * shares.T) * worth(angles, sweet) + 1e-6 * shares
    chosen = np.zeros((total, count), dtype=np.int64)
    for i in range(total):
        offsets = centres - centres[i]
        lengths = np.linalg.norm(offsets, axis=1)
        directions = offsets / np.maximum(lengths, 1e-12)[:, None]
        left = score[i] - 1e-9 * lengths / max(float(lengths.max()), 1e-12)
        left[i] = -np.inf
        for k in range(count):
            best = int(np.argmax(left))
            chosen[i, k] = best
            left[best] = -np.inf
            along = directions @ directions[best]
            left = np.where(left > 0, left * (1 - 0.5 * np.clip(along, 0, 1)), left)
    return chosen
