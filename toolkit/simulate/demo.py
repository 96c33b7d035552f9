"""The demo's capture: boxes and balls in the corner of a room, filmed by a hand that walks half around them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import OutputError
from fieldfuse.files import atomic_path
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate import textures
from fieldfuse.simulate.baked import BakedScene, Light
from fieldfuse.simulate.trace import Rectangle, Sphere
from fieldfuse.simulate.workers import drawing

FRAMES_A_SECOND = 12
WALL = 1.3  # metres from the middle of the floor to each wall
TEXELS = 300  # a metre, on floor and walls
BOX_TEXELS = 700
# centre of the bottom x, y, z; half width, half depth, height; turn in degrees
BOXES = (
    (-0.28, -0.34, 0.00, 0.28, 0.19, 0.62, 20),
    (0.42, -0.40, 0.00, 0.17, 0.21, 0.42, -15),
    (-0.50, 0.36, 0.00, 0.21, 0.15, 0.30, 40),
    (-0.30, -0.32, 0.62, 0.15, 0.12, 0.22, -12),
    (0.12, 0.50, 0.00, 0.22, 0.15, 0.07, 10),
    (0.40, -0.38, 0.42, 0.10, 0.13, 0.12, 25),
)
# centre x, y, z; radius; gloss
BALLS = ((0.30, 0.10, 0.18, 0.18, 0.16), (-0.10, 0.10, 0.12, 0.12, 0.10), (0.12, 0.50, 0.16, 0.09, 0.20))


@dataclass(frozen=True)
class Filmed:
    """What the video shows, exactly: for comparing with what was found in it."""

    scene: BakedScene
    intrinsics: Intrinsics  # pinhole
    world_from_camera: Array  # (frames, 4, 4) float64, metres, z up


def demo_scene(seed: int = 0) -> BakedScene:
    """The furnished corner. Another seed gives other pictures on the same shapes."""
    rng = np.random.default_rng(seed)
    side, height = 3.6 + WALL, 2.4
    corner = np.array([-WALL, -WALL, 0.0])
    x, y, z = np.eye(3)
    rectangles = [
        Rectangle(corner + side * y, side * x, -side * y),  # the floor, seen from above
        Rectangle(corner + side * x + height * z, -side * x, -height * z),  # the wall at y = −WALL
        Rectangle(corner + height * z, side * y, -height * z),  # the wall at x = −WALL
    ]
    long, tall = int(side * TEXELS), int(height * TEXELS)
    pictures = [
        textures.terrazzo(rng, long, long),
        textures.wall(rng, tall, long, (0.72, 0.78, 0.76)),
        textures.wall(rng, tall, long, (0.82, 0.76, 0.66)),
    ]
    for box in BOXES:
        for face in _box_faces(*box):
            size = [max(24, int(np.linalg.norm(edge) * BOX_TEXELS)) for edge in (face.down, face.across)]
            rectangles.append(face)
            pictures.append(textures.carton(rng, size[0], size[1]))
    spheres = [Sphere(np.array(ball[:3]), ball[3]) for ball in BALLS]
    pictures += [textures.marble(rng, 360, 720) for _ in BALLS]
    return BakedScene(rectangles, spheres, pictures, [ball[4] for ball in BALLS], Light())


def _box_faces(x: float, y: float, z: float, half_x: float, half_y: float, height: float, degrees: float) -> list[Rectangle]:
    """The four sides and the top of an upright box."""
    angle = np.deg2rad(degrees)
    a = np.array([np.cos(angle), np.sin(angle), 0]) * half_x
    b = np.array([-np.sin(angle), np.cos(angle), 0]) * half_y
    up = np.array([0, 0, height])
    top = np.array([x, y, z]) + up
    return [
        Rectangle(top - a - b, 2 * a, -up),
        Rectangle(top + a - b, 2 * b, -up),
        Rectangle(top + a + b, -2 * a, -up),
        Rectangle(top - a + b, -2 * b, -up),
        Rectangle(top - a + b, 2 * a, -2 * b),
    ]


def hand_held(frames: int, seed: int = 0) -> Array:
    """(frames, 4, 4) world_from_camera: an arc of 116° around the objects, rising and sinking, with the sway of a hand."""
    rng = np.random.default_rng([seed, 1])
    s = np.linspace(0, 1, frames)

    def sway(size: float, fastest: int = 7) -> Array:
        """(frames, 3) smooth wander of about `size`."""
        waves = np.arange(2, fastest)
        phase, weight = rng.uniform(0, 2 * np.pi, (len(waves), 3)), rng.normal(0, 1, (len(waves), 3)) / np.sqrt(len(waves))
        return size * (np.sin(2 * np.pi * waves[:, None, None] * s[:, None] + phase[:, None]) * weight[:, None]).sum(0)

    azimuth = np.deg2rad(-13 + 116 * s)
    radius = 1.95 + 0.16 * np.sin(2 * np.pi * 1.3 * s)
    height = 1.05 + 0.38 * np.sin(2 * np.pi * 1.5 * s + 0.4)
    centres = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1) + sway(0.03)
    targets = np.array([-0.05, -0.05, 0.30]) + sway(0.05)
    forward = targets - centres
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]) + sway(0.03))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :] = np.stack([right, np.cross(forward, right), forward, centres], axis=-1)
    return poses


def write_demo_video(
    path: Path | str, frames: int = 48, size: tuple[int, int] = (480, 360), seed: int = 0, progress: Progress = SILENT
) -> Filmed:
    """Film the demo scene into an mp4 of `size` (width, height), and return the truth behind it.

    Raises:
        OutputError: the file cannot be written, or OpenCV has no encoder for mp4.
    """
    width, height = size
    intrinsics = Intrinsics(width, height, 0.85 * width, 0.85 * width, width / 2, height / 2)
    poses = hand_held(frames, seed)
    with drawing() as side_by_side, atomic_path(path) as temporary:
        scene = demo_scene(seed)
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_A_SECOND, (width, height))
        if not writer.isOpened():
            raise OutputError(f"cannot write {path}: OpenCV has no mp4 encoder or the folder is not writable; see `fieldfuse doctor`")
        try:
            for number, picture in enumerate(side_by_side(lambda pose: scene.picture(intrinsics, pose), poses)):
                progress.check()
                writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
                progress.update(number + 1, frames)
        finally:
            writer.release()
    return Filmed(scene, intrinsics, poses)
