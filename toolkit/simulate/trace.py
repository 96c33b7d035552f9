"""Ray casting against rectangles and spheres, exact, in torch: no mesh and no other library needed."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from fieldfuse.camera import Array

FAR = 1e9
RAYS_A_CHUNK = 1 << 15  # the (rays, shapes) intermediates stay in the processor's cache


@dataclass(frozen=True)
class Rectangle:
    """A one-sided rectangle: `corner + u·across + v·down`, u and v in [0, 1]; its front is where down × across points."""

    corner: Array  # (3,)
    across: Array  # (3,) full width
    down: Array  # (3,) full height, perpendicular to `across`


@dataclass(frozen=True)
class Sphere:
    centre: Array  # (3,)
    radius: float


@dataclass(frozen=True)
class Hits:
    """What rays hit first. `shape` counts the rectangles, then the spheres; −1 with distance `FAR` where nothing was hit."""

    distance: torch.Tensor  # (N,)
    shape: torch.Tensor  # (N,) int64
    u: torch.Tensor  # (N,) place on the shape's texture, in [0, 1]
    v: torch.Tensor  # (N,)


class Shapes:
    """All shapes of a scene as tensors, ready for rays."""

    def __init__(self, rectangles: list[Rectangle], spheres: list[Sphere]) -> None:
        def stack(rows: list[Array], width: int) -> torch.Tensor:
            return torch.tensor([list(map(float, row)) for row in rows], dtype=torch.float32).reshape(-1, width)

        corner = stack([r.corner for r in rectangles], 3)
        across, down = stack([r.across for r in rectangles], 3), stack([r.down for r in rectangles], 3)
        self.rectangles, self.spheres = len(rectangles), len(spheres)
        self.normal = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=1)  # (R, 3)
        # One product of a point with this gives its height over every rectangle and its u and v.
        u, v = across / across.square().sum(1, keepdim=True), down / down.square().sum(1, keepdim=True)
        self._axes = torch.cat([self.normal, u, v]).T.contiguous()  # (3, 3·R)
        self._offset = torch.cat([(axis * corner).sum(1) for axis in (self.normal, u, v)])  # (3·R,)
        self.centre = stack([s.centre for s in spheres], 3)  # (S, 3)
        self.radius = torch.tensor([s.radius for s in spheres], dtype=torch.float32)  # (S,)

    def cast(self, origins: torch.Tensor, directions: torch.Tensor) -> Hits:
        """First hits of rays: (N, 3) or (1, 3) origins, (N, 3) unit directions."""
        chunks = [
            self._cast(origins if len(origins) == 1 else origins[i : i + RAYS_A_CHUNK], directions[i : i + RAYS_A_CHUNK])
            for i in range(0, max(len(directions), 1), RAYS_A_CHUNK)
        ]
        return Hits(*(torch.cat(parts) for parts in zip(*chunks, strict=True)))

    def blocked(self, origins: torch.Tensor, directions: torch.Tensor, limit: float = FAR) -> torch.Tensor:
        """(N,) whether something stands within `limit` along each ray."""
        return self.cast(origins, directions).distance < limit

    def _cast(self, origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        axes, offset, numbers = self._axes, self._offset, torch.arange(self.rectangles)
        if len(origins) == 1:  # from one place, rectangles that show it their backs cannot be seen
            numbers = (origins @ self.normal.T - offset[: self.rectangles] > 0)[0].nonzero()[:, 0]
            of_seen = torch.cat([numbers + i * self.rectangles for i in range(3)])
            axes, offset = axes[:, of_seen], offset[of_seen]
        count = len(numbers)
        start = origins @ axes - offset  # (N or 1, 3·count)
        slope = directions @ axes  # (N, 3·count)
        facing = slope[:, :count]
        t = -start[:, :count] / torch.where(facing < 0, facing, -1e-12)  # (N, count); backs are not hit
        u = torch.addcmul(start[:, count : 2 * count].expand_as(t), t, slope[:, count : 2 * count])
        v = torch.addcmul(start[:, 2 * count :].expand_as(t), t, slope[:, 2 * count :])
        inside = ((u - 0.5).abs() <= 0.5) & ((v - 0.5).abs() <= 0.5) & (t > 1e-6) & (facing < 0)
        reach = torch.where(inside, t, FAR)
        if self.spheres:
            reach = torch.cat([reach, self._cast_spheres(origins, directions)], dim=1)
        distance, column = reach.min(dim=1)
        shape = torch.cat([numbers, torch.arange(self.rectangles, self.rectangles + self.spheres)])[column]
        flat = column.clamp(max=max(count - 1, 0))[:, None]
        u, v = (torch.nn.functional.pad(value, (0, int(count == 0))).gather(1, flat)[:, 0].clamp(0, 1) for value in (u, v))
        ball = (column >= count).nonzero()[:, 0]
        if len(ball):
            start_ball = origins if len(origins) == 1 else origins[ball]
            which = shape[ball] - self.rectangles
            outward = (start_ball + distance[ball, None] * directions[ball] - self.centre[which]) / self.radius[which, None]
            u[ball] = torch.atan2(outward[:, 1], outward[:, 0]) / (2 * torch.pi) + 0.5
            v[ball] = torch.acos(outward[:, 2].clamp(-1, 1)) / torch.pi
        return distance, torch.where(distance < FAR, shape, -1), u, v

    def _cast_spheres(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """(N, S) distances to the spheres' fronts, `FAR` where missed."""
        to_centre = self.centre - origins[:, None]  # (N or 1, S, 3)
        along = (directions[:, None] * to_centre).sum(-1)  # (N, S)
        # The distance of the centre from the ray, not a difference of squares: that loses the digits of small spheres.
        miss = (to_centre - along[..., None] * directions[:, None]).square().sum(-1)
        half = (self.radius**2 - miss).clamp(min=0).sqrt()
        t = along - half
        return torch.where((miss < self.radius**2) & (t > 1e-6), t, FAR)
