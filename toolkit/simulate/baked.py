"""A scene of textured rectangles and spheres with its light baked in, and pictures of it through a pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, pixel_grid, rays
from fieldfuse.simulate.trace import FAR, Hits, Rectangle, Shapes, Sphere

GAMMA = 2.2


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
    """Shapes with one texture each, rectangles first.

    Args:
        textures: (h, w, 3) sRGB float32, one a shape; a sphere's is a longitude × latitude map.
        gloss: strength of the lamp's reflection on each sphere: the one part of the picture that depends on the view.
    """

    def __init__(self, rectangles: list[Rectangle], spheres: list[Sphere], textures: list[Array], gloss: list[float], light: Light) -> None:
        self.light = light
        self.shapes = Shapes(rectangles, spheres)
        self.gloss = torch.tensor(gloss, dtype=torch.float32)
        lit = [
            texture.clip(0, 1) ** GAMMA * self._baked(rectangles + spheres, number, texture.shape[0], texture.shape[1])[..., None]
            for number, texture in enumerate(textures)
        ]
        self._height = torch.tensor([texture.shape[0] for texture in textures])
        self._width = torch.tensor([texture.shape[1] for texture in textures])
        self._first = torch.tensor(np.cumsum([0, *[texture.shape[0] * texture.shape[1] for texture in textures]])[:-1])
        self._texels = torch.from_numpy(np.concatenate([texture.reshape(-1, 3) for texture in lit]).astype(np.float32))

    def picture(self, intrinsics: Intrinsics, world_from_camera: Array, samples: int = 2) -> Array:
        """(H, W, 3) uint8 sRGB; every pixel is the mean of samples × samples rays. Black where no shape is."""
        fine = intrinsics.scaled(intrinsics.width * samples, intrinsics.height * samples)
        origins, directions, _ = rays(fine, world_from_camera, pixel_grid(fine.width, fine.height))
        hits = self.shapes.cast(origins[:1], directions)
        linear = self._colour(hits, origins[:1], directions)
        mean = linear.reshape(intrinsics.height, samples, intrinsics.width, samples, 3).mean(dim=(1, 3))
        return (mean.clamp(0, 1) ** (1 / GAMMA) * 255).round().to(torch.uint8).numpy()

    def depth(self, intrinsics: Intrinsics, world_from_camera: Array) -> Array:
        """(H, W) float32 depth along z at pixel centres; 0 where no shape is."""
        origins, directions, cosine = rays(intrinsics, world_from_camera, pixel_grid(intrinsics.width, intrinsics.height))
        hits = self.shapes.cast(origins[:1], directions)
        depth = torch.where(hits.distance < FAR, hits.distance * cosine, 0.0)
        return depth.reshape(intrinsics.height, intrinsics.width).numpy()

    def _colour(self, hits: Hits, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """(N, 3) linear colour: the baked texture between its four nearest texels, and the gloss of spheres."""
        shape = hits.shape.clamp(min=0)
        height, width, first = self._height[shape], self._width[shape], self._first[shape]
        x, y = hits.u * width - 0.5, hits.v * height - 0.5
        column, row = x.floor(), y.floor()
        right, below = (x - column)[:, None], (y - row)[:, None]
        round_about = shape >= self.shapes.rectangles  # longitudes wrap
        last = width - 1
        left, past = (torch.where(round_about, c % width, c.clamp(min=0).minimum(last)) for c in (column.long(), column.long() + 1))
        upper, lower = (first + r.clamp(min=0).minimum(height - 1) * width for r in (row.long(), row.long() + 1))
        top = torch.lerp(self._texels[upper + left], self._texels[upper + past], right)
        bottom = torch.lerp(self._texels[lower + left], self._texels[lower + past], right)
        colour = torch.lerp(top, bottom, below)
        balls = round_about.nonzero()[:, 0]
        if len(balls):
            colour[balls] += self._gloss(balls, hits, origins, directions)
        colour[hits.shape < 0] = 0
        return colour

    def _gloss(self, balls: torch.Tensor, hits: Hits, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """(B, 1) Phong reflection of the lamp on the spheres that were hit."""
        which = hits.shape[balls] - self.shapes.rectangles
        ray = directions[balls]
        point = origins + hits.distance[balls, None] * ray
        normal = (point - self.shapes.centre[which]) / self.shapes.radius[which, None]
        mirrored = ray - 2 * (ray * normal).sum(1, keepdim=True) * normal
        to_lamp = torch.nn.functional.normalize(torch.tensor(self.light.lamp) - point, dim=1)
        return self.gloss[which, None] * (mirrored * to_lamp).sum(1, keepdim=True).clamp(min=0) ** 24

    def _baked(self, shapes: list[Rectangle | Sphere], number: int, height: int, width: int) -> Array:
        """(height, width) light that arrives at a shape: soft shadow of the lamp and the visible part of the sky.

        It does not depend on the view, so it is found once per texture, on a grid of about a twelfth of its size.
        """
        rows, columns = max(height // 12, 12), max(width // 12, 12)
        v, u = np.mgrid[0:rows, 0:columns].astype(np.float64)
        u, v = (u.ravel() + 0.5) / columns, (v.ravel() + 0.5) / rows
        points, normals = surface(shapes[number], u, v)
        at, up = torch.tensor(points, dtype=torch.float32), torch.tensor(normals, dtype=torch.float32)
        at = at + 1e-3 * up
        generator = np.random.default_rng(number)
        lamp = torch.zeros(len(at))
        for offset in _ball(generator, self.light.samples) * self.light.radius:
            to_lamp = torch.tensor(np.array(self.light.lamp) + offset, dtype=torch.float32) - at
            distance = to_lamp.norm(dim=1)
            towards = to_lamp / distance[:, None]
            facing = (towards * up).sum(1).clamp(min=0)
            lit = (facing > 0).nonzero()[:, 0]
            clear = ~self.shapes.blocked(at[lit], towards[lit], float(distance.min()) * 0.999)
            lamp[lit] += facing[lit] * clear / self.light.samples
        sky = torch.zeros(len(at))
        for offset in _sphere(generator, self.light.sky_samples):
            # Normal plus a point on the unit sphere: directions with a density of the cosine, as the irradiance asks for.
            towards = torch.nn.functional.normalize(up + torch.tensor(offset, dtype=torch.float32), dim=1)
            sky += ~self.shapes.blocked(at, towards, 1.2) / self.light.sky_samples
        light = (self.light.lamp_strength * lamp + self.light.sky_strength * sky).reshape(1, 1, rows, columns)
        smooth = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(light, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
        return torch.nn.functional.interpolate(smooth, size=(height, width), mode="bilinear")[0, 0].numpy()


def surface(shape: Rectangle | Sphere, u: Array, v: Array) -> tuple[Array, Array]:
    """Points (N, 3) and outward normals (N, 3) at texture places u, v (N,)."""
    if isinstance(shape, Rectangle):
        points = shape.corner + u[:, None] * shape.across + v[:, None] * shape.down
        normal = np.cross(shape.down, shape.across)
        return points, np.broadcast_to(normal / np.linalg.norm(normal), points.shape)
    longitude, latitude = (u - 0.5) * 2 * np.pi, v * np.pi
    normals = np.stack([np.cos(longitude) * np.sin(latitude), np.sin(longitude) * np.sin(latitude), np.cos(latitude)], axis=1)
    return shape.centre + shape.radius * normals, normals


def _sphere(generator: np.random.Generator, count: int) -> Array:
    """(count, 3) evenly spread unit vectors, turned by a random angle."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = index * np.pi * (3 - np.sqrt(5)) + generator.uniform(0, 2 * np.pi)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def _ball(generator: np.random.Generator, count: int) -> Array:
    """(count, 3) points spread through the unit ball."""
    return _sphere(generator, count) * np.cbrt(generator.permutation(count) + 0.5)[:, None] / np.cbrt(count)
