"""Which way is up, and how to turn the working frame about it."""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array

LEVEL = 0.25  # eigenvalue ratio below which the cameras' x axes lie in a plane (held level while turning)
ORBIT = 0.05  # the same for camera centres: they lie in a plane
AGREE = 15.0  # degrees between two estimates that count as one
NEAR = 60.0  # degrees that an estimate may lie off the mean up vector of the cameras
TURNED = 0.01  # least share of the x axes' second direction: about 6° of turning
UNDECIDED = 0.15  # length of a mean of unit vectors below which it points nowhere
SHORT = 0.5  # and below which it does not overrule the x axes
STEEP = 0.7  # cosine between a camera's axis and up above which that axis tells no heading
PERCENTILES = (0.5, 99.5)  # of points, that a footprint spans


def up_direction(world_from_camera: Array, given: tuple[float, float, float] | None = None) -> tuple[Array, str]:
    """A unit up vector (3,) in the frame of the poses, and the reason for it.

    Without a given one: people hold cameras level, so the direction across all x axes is up, when the cameras turned enough to
    tell; else the mean up vector of the cameras (−y). Where the camera centres lie in a plane whose normal agrees within
    15°, as on an orbit, the two are averaged.
    """
    if given is not None:
        vector = np.asarray(given, dtype=np.float64)
        return vector / np.linalg.norm(vector), "given by the source"
    mean = -world_from_camera[:, :3, 1].mean(axis=0)  # shorter than 1 the more cameras disagree
    behind = -world_from_camera[:, :3, 2].mean(axis=0)
    length = float(np.linalg.norm(mean))
    x = world_from_camera[:, :3, 0]
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    level = vectors[:, 0]
    # Cameras that look straight down have their up vectors in the ground plane: then up is where they stand.
    level = _towards(level, mean if abs(level @ mean) > UNDECIDED else behind)
    turned = values[0] < LEVEL * values[1] and values[1] > TURNED
    if turned and (length < SHORT or _degrees(level, mean / length) < NEAR):
        up, reason = level, "direction across the cameras' x axes (held level)"
    elif length > UNDECIDED:
        up, reason = mean / length, "mean up vector of the cameras"
    else:
        return np.array([0.0, 0.0, 1.0]), "kept as it is: the cameras' up vectors point everywhere"
    centres = world_from_camera[:, :3, 3] - world_from_camera[:, :3, 3].mean(axis=0)
    values, vectors = np.linalg.eigh(centres.T @ centres / len(centres))
    normal = _towards(vectors[:, 0], up)
    if values[0] < ORBIT * values[1] and _degrees(normal, up) < AGREE:
        up, reason = (up + normal) / np.linalg.norm(up + normal), reason + ", averaged with the normal of the cameras' plane"
    return up, reason


def turn_about_z(degrees: float) -> Array:
    """(3, 3)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def camera_frame(world_from_camera: Array, given: tuple[float, float, float] | None = None) -> tuple[Array, str]:
    """(3, 3) rotation into a frame that the cameras alone decide, and the reason for its z, which is up (see `up_direction`).

    Its x lies along the first camera's right, or along its view where it lies on its side. However a capture is turned, it is the same
    there: what comes after looks at the same numbers, to rounding, and lays the same lattice.
    """
    up, reason = up_direction(world_from_camera, given)
    right, ahead = world_from_camera[0, :3, 0], world_from_camera[0, :3, 2]
    heading = right if abs(right @ up) < STEEP else ahead
    x = heading - (heading @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up]), reason


def tight_turn(points: Array) -> float:
    """Degrees to turn (P, 3) points about z for the smallest axis-aligned footprint, within ±45°, to a tenth of a degree.

    The footprint spans percentiles, so that stray points do not decide.
    """
    coarse = np.arange(-45.0, 45.0, 1.5)
    best = float(coarse[np.argmin(_footprints(points, coarse))])
    fine = best + np.arange(-1.4, 1.45, 0.1)
    return float(fine[np.argmin(_footprints(points, fine))])


def _footprints(points: Array, degrees: Array) -> Array:
    """(A,) areas of the axis-aligned footprints of points that are turned by each of the angles (A,)."""
    areas = []
    for angle in degrees:
        low, high = np.percentile(points[:, :2] @ turn_about_z(float(angle))[:2, :2].T, PERCENTILES, axis=0)
        areas.append(float(np.prod(high - low)))
    return np.array(areas)


def _towards(vector: Array, other: Array) -> Array:
    return vector if vector @ other >= 0 else -vector


def _degrees(first: Array, second: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0))))
