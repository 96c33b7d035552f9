"""The usual mistakes in poses that come with a capture, each as what undoes it.

A reader has turned what a file holds into `world_from_camera` with OpenCV's axes, by the conventions of that kind of capture. Here this is
turned back into the file's matrices and read by other conventions: the inverse, other camera axes, rows for columns, another order of the
quaternion, a camera's centre for a translation, swapped axes of positions, another focal length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, invert

OPENGL = np.diag([1.0, -1.0, -1.0])
LLFF = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
FILE_AXES = {"transforms": OPENGL, "blender": OPENGL, "polycam": OPENGL, "record3d": OPENGL, "scanner3d": OPENGL, "llff": LLFF}
WAYS = (("right", "left"), ("down", "up"), ("forward", "backward"))  # of OpenCV's x, y and z
FOCAL = tuple(float(f) for f in np.geomspace(0.25, 4.0, 41) if abs(np.log(f)) > 0.05)  # times the given focal length


@dataclass(frozen=True)
class Reading:
    """One way to read the given poses and intrinsics."""

    text: str  # what is changed, to follow "they fit"
    poses: Array  # (N, 4, 4) world_from_camera
    focal: float = 1.0  # times the given focal length
    centred: bool = False  # the principal point is the middle of the image

    @property
    def of_lens(self) -> bool:
        return self.focal != 1 or self.centred


def readings(poses: Array, kind: str) -> Iterator[Reading]:
    """Other ways to read `poses` (N, 4, 4), which a capture of this kind came with, those that change least first."""
    axes = FILE_AXES.get(kind, np.eye(3))
    raw = poses.copy()
    raw[:, :3, :3] = poses[:, :3, :3] @ axes.T  # as in the file: columns are its own camera axes
    inverse = invert(raw)
    for turn in _rotations():
        into = axes @ turn  # file axes from OpenCV's
        if np.array_equal(turn, np.eye(3)):
            yield Reading("as world-to-camera matrices, inverted", _axes(inverse, axes))
            continue
        name = f"with camera axes x {_way(into[0])}, y {_way(into[1])}, z {_way(into[2])}{_turned(turn)}"
        yield Reading(name, _axes(raw, into))
        yield Reading(f"as world-to-camera matrices, inverted, {name}", _axes(inverse, into))
    yield from _other(raw, inverse, axes)
    for factor, centred in product((1.0, *FOCAL), (False, True)):
        if factor != 1 or centred:
            yield refocused(Reading("", poses, factor, centred), factor)


def refocused(reading: Reading, factor: float) -> Reading:
    """A reading of the lens with another focal length."""
    texts = [f"with {factor:.2f} times the focal length"] * (factor != 1) + ["with the principal point in the middle"] * reading.centred
    return replace(reading, focal=factor, text=" and ".join(texts))


def _other(raw: Array, inverse: Array, axes: Array) -> Iterator[Reading]:
    """Mistakes in rotations or in translations alone. `inverse` are the file's matrices where these are world_to_camera, as COLMAP's."""
    rotation, centre = raw[:, :3, :3], raw[:, :3, 3]
    turned = np.swapaxes(rotation, 1, 2)
    text = "with rotations transposed (rows for columns) and positions kept"
    yield Reading(text, _axes(_joined(turned, centre), axes))
    text = "with rotations transposed (rows for columns) and translations kept"
    yield Reading(text, _axes(invert(_joined(rotation, inverse[:, :3, 3])), axes))
    for given in (raw, inverse):
        quaternions = Rotation.from_matrix(given[:, :3, :3]).as_quat()  # x, y, z, w
        for shift, name in ((1, "qx qy qz qw, not qw qx qy qz"), (-1, "qw qx qy qz, not qx qy qz qw")):
            read = _joined(Rotation.from_quat(np.roll(quaternions, shift, axis=1)).as_matrix(), given[:, :3, 3])
            yield Reading(f"with quaternions in the order {name}", _axes(read if given is raw else invert(read), axes))
    moved = {
        "with the camera's centre where a translation was read": -np.einsum("nij,nj->ni", turned, centre),
        "with a translation where the camera's centre was read": -np.einsum("nij,nj->ni", rotation, centre),
        "with positions negated": -centre,
        "with the y and z of positions swapped": centre[:, [0, 2, 1]],
        "with the y and z of positions swapped, one negated": centre[:, [0, 2, 1]] * [1, -1, 1],
        "with the z and y of positions swapped, one negated": centre[:, [0, 2, 1]] * [1, 1, -1],
        "with the x and y of positions swapped": centre[:, [1, 0, 2]],
    }
    moved |= {f"with {name} of positions negated": centre * sign for name, sign in zip("xyz", 1 - 2 * np.eye(3), strict=True)}
    for text, place in moved.items():
        yield Reading(text, _axes(_joined(rotation, place), axes))


def _rotations() -> list[Array]:
    """The 24 rotations that take axes to axes, those first that change least."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0:
                out.append(turn)
    return sorted(out, key=lambda turn: -float(np.trace(turn)))


def _turned(turn: Array) -> str:
    """What a rotation about the optical axis may mean, too."""
    angle = round(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))) % 360
    return f" (or with the images turned by {min(angle, 360 - angle)}°)" if turn[2, 2] > 0.5 else ""


def _way(row: Array) -> str:
    """The direction of a file's camera axis, a row of (file axes from OpenCV's)."""
    k = int(np.abs(row).argmax())
    return WAYS[k][int(row[k] < 0)]


def _axes(raw: Array, into: Array) -> Array:
    out = raw.copy()
    out[:, :3, :3] = raw[:, :3, :3] @ into
    return out


def _joined(rotation: Array, translation: Array) -> Array:
    out = np.tile(np.eye(4), (len(rotation), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = rotation, translation
    return out
