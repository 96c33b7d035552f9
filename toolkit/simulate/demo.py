"""The demo's capture: boxes and balls in the corner of a room, filmed by a hand that walks half around them.

Its light does not depend on the view but for the gloss of balls, so it is baked into the textures once: soft shadows of a round lamp, and
the visible part of an even sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, pixel_grid, rays
from fieldfuse.errors import OutputError
from fieldfuse.files import atomic_path
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate import textures
from fieldfuse.simulate.film import drawing
from fieldfuse.simulate.solids import BALL, BOX, FAR, Solid, Solids, upright

Tensor = torch.Tensor

GAMMA = 2.2
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
class Light:
    """A round lamp and an even sky."""

    lamp: tuple[float, float, float] = (1.6, 1.1, 3.4)
    radius: float = 0.35  # of the lamp: how soft shadows are
    lamp_strength: float = 0.78
    sky_strength: float = 0.42
    samples: int = 12  # shadow rays a baked point
    sky_samples: int = 28


class BakedScene:
    """Solids whose sides have one texture each.

    Args:
        solids: boxes and balls; the materials of a box are the numbers of its faces' textures, −1: one that nobody sees; of a ball, of its
        one. textures: (h, w, 3) sRGB float32; a ball's is a longitude × latitude map. gloss: strength of the lamp's reflection on each
        ball, in their order: the one part of an image that depends on the view.
    """

    def __init__(self, solids: list[Solid], textures: list[Array], gloss: list[float], light: Light) -> None:
        self.light, self.solids = light, Solids(solids)
        self._first_ball = self.solids.ranges[BALL][0]
        self.gloss = torch.tensor(gloss, dtype=torch.float32)
        lit: list[Array] = [np.zeros(0)] * len(textures)
        for number, faces in enumerate(self.solids.materials.tolist()):
            for face, name in enumerate(faces):
                if name >= 0 and not len(lit[name]):
                    height, width = textures[name].shape[:2]
                    lit[name] = textures[name].clip(0, 1) ** GAMMA * self._baked(number, face, name, height, width)[..., None]
        self._height = torch.tensor([texture.shape[0] for texture in textures])
        self._width = torch.tensor([texture.shape[1] for texture in textures])
        self._first = torch.tensor(np.cumsum([0, *[texture.shape[0] * texture.shape[1] for texture in textures]])[:-1])
        self._texels = torch.from_numpy(np.concatenate([texture.reshape(-1, 3) for texture in lit]).astype(np.float32))

    def picture(self, intrinsics: Intrinsics, world_from_camera: Array, samples: int = 2) -> Array:
        """(H, W, 3) uint8 sRGB; every pixel is the mean of samples × samples rays. Black where no solid is."""
        fine = intrinsics.scaled(intrinsics.width * samples, intrinsics.height * samples)
        origins, directions, _ = rays(fine, world_from_camera, pixel_grid(fine.width, fine.height))
        linear = self._colour(origins[:1], directions, *self.solids.cast(origins[:1], directions))
        mean = linear.reshape(intrinsics.height, samples, intrinsics.width, samples, 3).mean(dim=(1, 3))
        return (mean.clamp(0, 1) ** (1 / GAMMA) * 255).round().to(torch.uint8).numpy()

    def depth(self, intrinsics: Intrinsics, world_from_camera: Array) -> Array:
        """(H, W) float32 depth along z at pixel centres; 0 where no solid is."""
        origins, directions, cosine = rays(intrinsics, world_from_camera, pixel_grid(intrinsics.width, intrinsics.height))
        distance, _ = self.solids.cast(origins[:1], directions)
        depth = torch.where(distance < FAR, distance * cosine, 0.0)
        return depth.reshape(intrinsics.height, intrinsics.width).numpy()

    def _colour(self, origins: Tensor, directions: Tensor, distance: Tensor, solid: Tensor) -> Tensor:
        """(N, 3) linear colour: the baked texture between its four nearest texels, and the gloss of balls."""
        number = solid.clamp(min=0)
        points = origins + distance[:, None] * directions
        face, place, normal = self.solids.surface(number, points)
        ball = number >= self._first_ball
        axis, half = face // 2, self.solids.half[number]
        across = half.gather(1, torch.where(axis == 0, 1, 0)[:, None])[:, 0]
        down = half.gather(1, torch.where(axis == 2, 1, 2)[:, None])[:, 0]
        longitude, latitude = torch.atan2(normal[:, 1], normal[:, 0]), torch.acos(normal[:, 2].clamp(-1, 1))
        u = torch.where(ball, longitude / (2 * torch.pi), place[:, 0] / (2 * across)) + 0.5
        v = torch.where(ball, latitude / torch.pi, place[:, 1] / (2 * down) + 0.5)
        texture = self.solids.materials[number, face].clamp(min=0)
        height, width, first = self._height[texture], self._width[texture], self._first[texture]
        x, y = u.clamp(0, 1) * width - 0.5, v.clamp(0, 1) * height - 0.5
        column, row = x.floor(), y.floor()
        right, below = (x - column)[:, None], (y - row)[:, None]
        left, past = (torch.where(ball, c % width, c.clamp(min=0).minimum(width - 1)) for c in (column.long(), column.long() + 1))
        upper, lower = (first + r.clamp(min=0).minimum(height - 1) * width for r in (row.long(), row.long() + 1))
        top = torch.lerp(self._texels[upper + left], self._texels[upper + past], right)
        bottom = torch.lerp(self._texels[lower + left], self._texels[lower + past], right)
        colour = torch.lerp(top, bottom, below)
        balls = ball.nonzero()[:, 0]
        if len(balls):  # Phong's reflection of the lamp
            ray, upwards = directions[balls], normal[balls]
            mirrored = ray - 2 * (ray * upwards).sum(1, keepdim=True) * upwards
            to_lamp = torch.nn.functional.normalize(torch.tensor(self.light.lamp) - points[balls], dim=1)
            shine = (mirrored * to_lamp).sum(1, keepdim=True).clamp(min=0) ** 24
            colour[balls] += self.gloss[number[balls] - self._first_ball, None] * shine
        colour[solid < 0] = 0
        return colour

    def _baked(self, number: int, face: int, seed: int, height: int, width: int) -> Array:
        """(height, width) light that arrives at a side of a solid: soft shadow of the lamp and the visible part of the sky.

        It is found on a grid of about a twelfth of the texture's size.
        """
        rows, columns = max(height // 12, 12), max(width // 12, 12)
        v, u = np.mgrid[0:rows, 0:columns].astype(np.float64)
        points, normals = self._surface(number, face, (u.ravel() + 0.5) / columns, (v.ravel() + 0.5) / rows)
        at, up = torch.tensor(points, dtype=torch.float32), torch.tensor(normals, dtype=torch.float32)
        at = at + 1e-3 * up
        generator = np.random.default_rng(seed)
        lamp, sky = torch.zeros(len(at)), torch.zeros(len(at))
        for offset in _ball(generator, self.light.samples) * self.light.radius:
            to_lamp = torch.tensor(np.array(self.light.lamp) + offset, dtype=torch.float32) - at
            distance = to_lamp.norm(dim=1)
            towards = to_lamp / distance[:, None]
            facing = (towards * up).sum(1).clamp(min=0)
            lit = (facing > 0).nonzero()[:, 0]
            clear = self.solids.cast(at[lit], towards[lit])[0] >= float(distance.min()) * 0.999
            lamp[lit] += facing[lit] * clear / self.light.samples
        for offset in _sphere(generator, self.light.sky_samples):
            # Normal plus a point on the unit sphere: directions with a density of the cosine, as in the irradiance.
            towards = torch.nn.functional.normalize(up + torch.tensor(offset, dtype=torch.float32), dim=1)
            sky += (self.solids.cast(at, towards)[0] >= 1.2) / self.light.sky_samples
        light = (self.light.lamp_strength * lamp + self.light.sky_strength * sky).reshape(1, 1, rows, columns)
        smooth = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(light, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
        return torch.nn.functional.interpolate(smooth, size=(height, width), mode="bilinear")[0, 0].numpy()

    def _surface(self, number: int, face: int, u: Array, v: Array) -> tuple[Array, Array]:
        """Points (N, 3) and outward normals (N, 3) of a solid's side at texture places u, v (N,)."""
        solid = self.solids.items[number]
        if solid.kind == BALL:
            longitude, latitude = (u - 0.5) * 2 * np.pi, v * np.pi
            flat = np.sin(latitude)
            normals = np.stack([np.cos(longitude) * flat, np.sin(longitude) * flat, np.cos(latitude)], axis=1)
            return solid.centre + solid.half * normals, normals
        axis, outwards = face // 2, 1.0 - 2 * (face % 2)
        local = np.zeros((len(u), 3))
        local[:, axis] = outwards
        normals = local @ solid.rotation.T
        local[:, 1 if axis == 0 else 0] = (2 * u - 1) * (-1 if (axis == 1) == (outwards > 0) else 1)
        local[:, 1 if axis == 2 else 2] = 1 - 2 * v
        return solid.centre + (local * solid.half) @ solid.rotation.T, normals


def _sphere(generator: np.random.Generator, count: int) -> Array:
    """(count, 3) evenly spread unit vectors, turned by a random angle."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = index * np.pi * (3 - np.sqrt(5)) + generator.uniform(0, 2 * np.pi)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def _ball(generator: np.random.Generator, count: int) -> Array:
    """(count, 3) points spread through the unit ball."""
    return _sphere(generator, count) * np.cbrt(generator.permutation(count) + 0.5)[:, None] / np.cbrt(count)


@dataclass(frozen=True)
class Filmed:
    """What the video shows, exactly: for comparing with what was found in it."""

    scene: BakedScene
    intrinsics: Intrinsics  # pinhole
    world_from_camera: Array  # (frames, 4, 4) float64, metres, z up


def demo_scene(seed: int = 0) -> BakedScene:
    """The furnished corner. Another seed gives other textures on the same shapes."""
    rng = np.random.default_rng(seed)
    side, height, thick = 3.6 + WALL, 2.4, 0.05
    long, tall, middle = int(side * TEXELS), int(height * TEXELS), side / 2 - WALL
    pictures = [
        textures.terrazzo(rng, long, long),
        textures.wall(rng, tall, long, (0.72, 0.78, 0.76)),
        textures.wall(rng, tall, long, (0.82, 0.76, 0.66)),
    ]
    none, flat, up = -1, side / 2, height / 2
    solids = [  # the floor, the wall at y = −WALL and the one at x = −WALL, of which one side is seen
        upright(BOX, [middle, middle, -thick], [flat, flat, thick], (none, none, none, none, 0, none)),
        upright(BOX, [middle, -WALL - thick, up], [flat, thick, up], (none, none, 1, none, none, none)),
        upright(BOX, [-WALL - thick, middle, up], [thick, flat, up], (2, none, none, none, none, none)),
    ]
    for x, y, z, half_x, half_y, height, degrees in BOXES:
        first = len(pictures)
        # The sides at −y, +x, +y and −x, and the top.
        for across, down in ((2 * half_x, height), (2 * half_y, height), (2 * half_x, height), (2 * half_y, height), (2 * half_x, 2 *
        half_y)):
            pictures.append(textures.carton(rng, *(max(24, int(edge * BOX_TEXELS)) for edge in (down, across))))
        faces = (first + 1, first + 3, first + 2, first, first + 4, none)
        solids.append(upright(BOX, [x, y, z + height / 2], [half_x, half_y, height / 2], faces, degrees))
    for x, y, z, radius, _ in BALLS:
        solids.append(upright(BALL, [x, y, z], [radius] * 3, len(pictures)))
        pictures.append(textures.marble(rng, 360, 720))
    return BakedScene(solids, pictures, [ball[4] for ball in BALLS], Light())


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
    scene = demo_scene(seed)
    with atomic_path(path) as temporary, drawing(lambda pose: scene.picture(intrinsics, pose), poses) as images:
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_A_SECOND, (width, height))
        if not writer.isOpened():
            raise OutputError(f"cannot write {path}: OpenCV has no mp4 encoder or the folder is not writable; see `fieldfuse doctor`")
        try:
            for number, image in enumerate(images):
                progress.check()
                writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
                progress.update(number + 1, frames)
        finally:
            writer.release()
    return Filmed(scene, intrinsics, poses)
