"""Poses as files hold them: quaternions, and matrices that may be rounded, scaled, or no poses at all.

Inside `lenient_poses` one bad frame does not refuse a whole capture: it is noted and excluded.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from fieldfuse.errors import InputError

FARTHEST = 1e12  # of a camera from the origin, in any unit: geocentric millimetres stay below 1e10
RIGID = 1e-14  # how far RᵀR of a rotation in float64 is from the identity by rounding alone
TOLERANCE = 0.005  # how far RᵀR may be from 1 anywhere: what single precision and printed digits leave
ROUNDED = 0.04  # the same where poses are read leniently: numbers of two digits
_lenient: ContextVar[PoseNotes | None] = ContextVar("lenient poses", default=None)


@dataclass
class PoseNotes:
    """What was wrong with poses, and other parts of single frames, that were read leniently."""

    unusable: list[str] = field(default_factory=list)  # a sentence for each pose that became NaN
    scales: list[float] = field(default_factory=list)  # of rotations that were scaled
    rounding: list[float] = field(default_factory=list)  # how far RᵀR was from 1 where rotations were made rigid
    unread: dict[str, str] = field(default_factory=dict)  # frames that could not be read, and why


@contextmanager
def lenient_poses() -> Iterator[PoseNotes]:
    """Inside, `checked_pose` removes a uniform scale and rounding from rotations, and returns NaN for an unusable pose, with a note."""
    notes = PoseNotes()
    token = _lenient.set(notes)
    try:
        yield notes
    finally:
        _lenient.reset(token)


@contextmanager
def single_frame(name: str) -> Iterator[None]:
    """What is read inside belongs to one frame: while a capture is read leniently, a failure excludes this frame and is noted."""
    notes = _lenient.get()
    try:
        yield
    except InputError as error:
        if notes is None:
            raise
        notes.unread[name] = str(error)


def unread_frames() -> dict[str, str]:
    """Frames of the capture being read that could not be read, and why."""
    notes = _lenient.get()
    return {} if notes is None else notes.unread


def reads_leniently() -> bool:
    return _lenient.get() is not None


def checked_pose(pose: Array, where: str) -> Array:
    """A rigid float64 (4, 4) pose, re-orthonormalised where it is off, or a clear refusal. See `lenient_poses`.

    What is rigid to the last digits stays as it is: a pose that was written and read back is the same pose.

    Raises:
        InputError: wrong shape, not finite, singular, mirrored, not rigid (beyond `TOLERANCE`) or astronomically far away.
    """
    notes = _lenient.get()

    def unusable(why: str) -> Array:
        if notes is None:
            raise InputError(f"{where}: {why}")
        notes.unusable.append(f"{where}: {why}")
        return np.full((4, 4), np.nan)

    try:
        pose = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: the pose is not a matrix of numbers; correct it") from error
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0, 0, 0, 1]]])
    if pose.shape != (4, 4):
        raise InputError(f"{where}: the pose has shape {pose.shape}, it must be 4×4")
    if not np.all(np.isfinite(pose)):
        return unusable("the pose holds a value that is not finite; remove this frame or correct it")
    rotation = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged files: huge numbers are no rotation either
        size, off = np.linalg.det(rotation), np.abs(rotation.T @ rotation - np.eye(3)).max()
    least = 1e-6 if notes is None else 1e-6 * np.abs(rotation).max() ** 3  # where scale is removed, a small one is no fault
    if not abs(size) > least:
        return unusable("the pose's rotation is singular; remove this frame or correct it")
    if notes is not None and size > 0 and not off <= ROUNDED:
        scale = float(np.cbrt(size))
        plain = rotation / scale
        left = float(np.abs(plain.T @ plain - np.eye(3)).max())
        if left <= ROUNDED:
            rotation, off = plain, left
            notes.scales.append(scale)
    if size < 0:
        raise InputError(
            f"{where}: the pose mirrors space (its rotation has determinant < 0); its axis convention is not what this kind of capture uses"
        )
    if notes is not None and TOLERANCE < off <= ROUNDED:
        notes.rounding.append(float(off))
    elif not off <= TOLERANCE:  # NaN, too
        return unusable(f"the pose is not rigid (its rotation is sheared or its axes differ in length: R'R is {off:.2g} off 1); correct it")
    checked_place(pose[:3, 3], where)
    out = np.eye(4)
    if off > RIGID:
        u, _, vt = np.linalg.svd(rotation)
        rotation = u @ vt
    out[:3, :3] = rotation
    out[:3, 3] = pose[:3, 3]
    return out


def checked_place(place: Array, where: str) -> None:
    """Refuse a translation (3,) further than `FARTHEST` from the origin: it leaves no digits for all else."""
    farthest = float(np.abs(place).max())
    if not farthest <= FARTHEST:
        raise InputError(
            f"{where}: the pose's translation is {farthest:g}, further than {FARTHEST:g} from the origin; remove this frame or correct it"
        )


def rigid(quaternion: Array, translation: Array, where: str) -> Array:
    """(4, 4) from a quaternion (w, x, y, z) of any length and a translation.

    Raises:
        InputError: the quaternion has no direction.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion)
    if not np.isfinite(length) or length < 1e-9:
        raise InputError(f"{where}: the pose's quaternion {quaternion.tolist()} is not a rotation; correct or remove this frame")
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat((quaternion / length)[[1, 2, 3, 0]]).as_matrix()
    out[:3, 3] = translation
    return out
