"""What no camera does: corrections beyond these are not used, whatever evidence speaks for them."""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array, Intrinsics, distort
from fieldfuse.effects.correct import Corrections, bent

STOPS, TINT = 2.0, 1.0  # of a frame's exposure from the usual one, and of its red and blue from green
STRAY = 0.1  # share of the frames that may lie beyond: their gains are bounded; with more of them none is believed
CORNER = 0.4  # of cos⁴, the natural fall of light to the corner: what a lens and its barrel may leave
BENT = 0.25  # of the half diagonal, by which a lens may move the corners beyond the lens that is given
TURN, MOVE = 10.0, 0.25  # degrees and shares of the scene's median depth by which the usual pose may be corrected
DEPTH_CAMERA, DEPTH_TURN = 0.10, 5.0  # metres and degrees between the cameras of one phone or sensor
DEPTH_SHARE = 0.1  # of the median depth, where a unit of length is not known


def bounded_gains(gain: dict[str, tuple[float, float, float]]) -> dict[str, tuple[float, float, float]] | None:
    """Gains within `STOPS` and `TINT` of the usual; None: too many frames lie beyond."""
    if not gain:
        return gain
    stops = np.log2(np.array(list(gain.values())))
    usual = np.median(stops, axis=0)
    level = np.clip(stops[:, 1] - usual[1], -STOPS, STOPS)
    tint = np.clip((stops - stops[:, 1:2]) - (usual - usual[1]), -TINT, TINT)
    kept = usual + level[:, None] + tint
    if np.mean(np.abs(kept - stops).max(axis=1) > 1e-9) > STRAY:
        return None
    return {name: (float(r), float(g), float(b)) for name, (r, g, b) in zip(gain, np.exp2(kept), strict=True)}


def beyond(corrections: Corrections, cameras: list[Intrinsics], given: dict[str, Array], depth: float) -> dict[str, str]:
    """Which effects' corrections no camera explains, and why.

    Args:
        cameras: of the frames, as the capture gives them.
        given: (4, 4) poses by frame name, before they were refined.
        depth: the scene's usual depth, units of the poses.
    """
    out = {}
    if corrections.gain and bounded_gains(corrections.gain) is None:
        out["exposure"] = f"more than {100 * STRAY:.0f}% of the frames would be more than {STOPS:g} stops off the usual exposure or tint"
    if corrections.corner is not None and cameras:
        least = CORNER * min(_cos4(camera) for camera in cameras)
        if not least <= corrections.corner <= 1.0:
            out["vignetting"] = f"the corners would keep {100 * corrections.corner:.0f}% of their light, which no lens of this angle does"
    if corrections.lens is not None and cameras:
        moved = max(_corner_moved(camera, corrections.lens) for camera in cameras[:1])
        if not moved <= BENT:
            out["distortion"] = f"the corners would move by {100 * moved:.0f}% of the half diagonal, more than {100 * BENT:.0f}%"
    moved_poses = [(given[name], pose) for name, pose in corrections.poses.items() if name in given]
    if moved_poses:
        way, turn = apart(np.array([one for one, _ in moved_poses]), np.array([other for _, other in moved_poses]))
        way, turn = np.median(way), np.median(turn)
        if not (way <= MOVE * depth and turn <= TURN):
            out["poses"] = (
                f"cameras would move by {100 * way / max(depth, 1e-12):.0f}% of the usual depth and turn by {turn:.1f}° in the median, "
                f"more than {100 * MOVE:.0f}% and {TURN:g}° are not refined but found anew: use --poses sfm"
            )
    return out


def beyond_depth(depth_pose: Array, metric: bool, depth: float) -> str | None:
    """Why no device has a depth camera that stands at (4, 4) `depth_pose`; None: one may."""
    way = float(np.linalg.norm(depth_pose[:3, 3]))
    turn = float(apart(np.eye(4)[None], depth_pose[None])[1][0])
    if metric and way > DEPTH_CAMERA:
        return (
            f"the depth camera would stand {100 * way:.1f} cm beside the images', "
            f"and none of a phone or a sensor stands farther than {100 * DEPTH_CAMERA:.0f} cm"
        )
    if not metric and way > DEPTH_SHARE * depth:
        return f"the depth camera would stand {100 * way / max(depth, 1e-12):.0f}% of the usual depth beside the images'"
    if turn > DEPTH_TURN:
        return f"the depth camera would be turned by {turn:.1f}°, more than {DEPTH_TURN:g}°"
    return None


def apart(one: Array, other: Array) -> tuple[Array, Array]:
    """(N,) distances and (N,) degrees between poses (N, 4, 4)."""
    way = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", one[:, :3, :3], other[:, :3, :3]) - 1) / 2
    return way, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _reach(camera: Intrinsics) -> tuple[float, float]:
    """The farthest corner on the ideal image plane."""
    return max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy


def _cos4(camera: Intrinsics) -> float:
    """Of the angle at half a diagonal, where `Corrections.corner` is measured."""
    return float((1 + 0.25 * np.hypot(camera.width / camera.fx, camera.height / camera.fy) ** 2) ** -2)


def _corner_moved(camera: Intrinsics, lens: tuple[float, float]) -> float:
    corner = np.array([_reach(camera)])
    return float(np.linalg.norm(distort(bent(camera.pinhole(), lens), corner) - corner) / np.linalg.norm(corner))
