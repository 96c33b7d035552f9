"""Cameras of photos as their files hold them. Photos are turned upright by their EXIF orientation before anything is done with them; other
programs, and captures that come with poses, take the pixels as they are stored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldfuse.camera import FISHEYE, Array, Intrinsics
from fieldfuse.capture.headers import orientation_of
from fieldfuse.capture.images import turns_by_exif
from fieldfuse.capture.types import Capture

TURNS = {3: (-1, 0), 6: (0, 1), 8: (0, -1)}  # EXIF orientation → cosine and sine of the turn from the upright picture to the stored one
MIRRORED = (2, 4, 5, 7)  # orientations that no camera tells of: rotations do not mirror


def stored_cameras(capture: Capture) -> tuple[list[Intrinsics], Array]:
    """Intrinsics and (N, 4, 4) world_from_camera of a posed capture's frames, for the pixels as their files hold them.

    Those of mirrored files stay as they are; `convert_pictures` writes such pictures anew.
    """
    turned = turns_by_exif(capture)
    found = [
        as_stored(frame.intrinsics, frame.world_from_camera, orientation_of(frame.image) if turned else 1)
        for frame in capture.frames
        if frame.intrinsics is not None and frame.world_from_camera is not None
    ]
    return [camera for camera, _ in found], np.array([pose for _, pose in found], dtype=np.float64).reshape(-1, 4, 4)


def as_stored(camera: Intrinsics, world_from_camera: Array, orientation: int) -> tuple[Intrinsics, Array]:
    """The camera of an upright picture, for the file that EXIF `orientation` turns into it: x_stored = R · x_upright about the axis.

    A lens keeps its radial terms; the tangential ones are a vector across the picture, (p2, p1), and turn with it.
    """
    if orientation not in TURNS:
        return camera, world_from_camera
    cosine, sine = TURNS[orientation]
    turn = np.array([[cosine, sine], [-sine, cosine]], dtype=np.float64)
    width, height = (camera.height, camera.width) if sine else (camera.width, camera.height)
    fx, fy = (camera.fy, camera.fx) if sine else (camera.fx, camera.fy)
    cx, cy = turn @ [camera.cx - camera.width / 2, camera.cy - camera.height / 2] + [width / 2, height / 2]
    lens = camera.distortion
    if camera.lens != FISHEYE and len(lens) >= 4:
        p2, p1 = turn @ [lens[3], lens[2]]
        lens = (*lens[:2], float(p1), float(p2), *lens[4:])
    pose = np.array(world_from_camera, dtype=np.float64)
    pose[:3, :2] = pose[:3, :2] @ turn.T
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=float(cx), cy=float(cy), distortion=lens), pose
