"""Networks, the plane sweep: pictures and cameras that tell nothing about depth, places where nothing can be read, and float64."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.cross_view_consistency import AGAINST, FOR, SHARE, consistency, cross_view
from fieldfuse.nerfusion.extras.matching import LARGE, SMALL, TEMPERATURE, UNKNOWN, patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution, carved, cost_volume, sweep_planes, to_probability
from tests.stability.hard.errors import absolute, not_finite
from tests.stability.hard.within import Within

GROUP = "networks"
WIDTH, HEIGHT, FOCAL = 24, 18, 22.0
NEAR, FAR = 0.5, 8.0
TRUNCATION = 0.1


def poses(*centres: tuple[float, float, float]) -> Cameras:
    """Cameras that look along +z."""
    at = torch.eye(4).repeat(len(centres), 1, 1)
    at[:, :3, 3] = torch.tensor(centres)
    inner = torch.tensor([[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]]).repeat(len(centres), 1)
    return Cameras.same_size(inner, at, WIDTH, HEIGHT)


def turned(cameras: Cameras, view: int, angle: float) -> Cameras:
    """One of the cameras turned about its y axis."""
    at = cameras.world_from_camera.clone()
    c, s = math.cos(angle), math.sin(angle)
    at[view, :3, :3] = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return Cameras(cameras.intrinsics, cameras.size, at)


def textured(seed: int = 0, views: int = 3) -> Tensor:
    """(V, 3, H, W) smooth noise."""
    noise = torch.rand(views, 3, HEIGHT // 3, WIDTH // 3, generator=torch.Generator().manual_seed(seed))
    return F.interpolate(noise, (HEIGHT, WIDTH), mode="bilinear")


def places() -> Tensor:
    """(N, 3): before, at and behind everything, beside the picture, in the camera, behind it, at infinity."""
    line = torch.logspace(-9, 9, 37)
    ahead = torch.stack([torch.zeros(37), torch.zeros(37), line], 1)
    others = [[0, 0, 0], [0, 0, -1], [0, 0, -1e9], [1e6, -1e6, 1], [1e-30, 0, 1e-30], [3, 0, 1], [-1e9, 0, 1e9], [0.01, 0.01, 2]]
    return torch.cat([ahead, ahead + torch.tensor([0.3, -0.2, 0.0]), torch.tensor(others, dtype=torch.float32)])


def awkward() -> dict[str, tuple[Tensor, Cameras]]:
    """Pictures (K, 3, H, W) and their cameras."""
    apart = poses((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0))
    one_bright = torch.zeros(3, 3, HEIGHT, WIDTH)
    one_bright[:, :, 9, 12] = 1
    return {
        "black": (torch.zeros(3, 3, HEIGHT, WIDTH), apart),
        "white": (torch.ones(3, 3, HEIGHT, WIDTH), apart),
        "one constant grey, one another": (torch.tensor([0.3, 0.7])[:, None, None, None].expand(2, 3, HEIGHT, WIDTH), apart[:2]),
        "one bright pixel": (one_bright, apart),
        "no neighbour": (textured()[:1], apart[:1]),
        "one neighbour": (textured()[:2], apart[:2]),
        "identical cameras": (textured()[:1].expand(3, -1, -1, -1), poses((0, 0, 0), (0, 0, 0), (0, 0, 0))),
        "a baseline of 1e-12": (textured(), poses((0, 0, 0), (1e-12, 0, 0), (0, 1e-12, 0))),
        "a baseline of 1e6": (textured(), poses((0, 0, 0), (1e6, 0, 0), (0, 0, -1e6))),
        "one centre, turned": (textured(), turned(turned(poses((0, 0, 0), (0, 0, 0), (0, 0, 0)), 1, 0.2), 2, -0.2)),
        "neighbours that look away": (textured(), turned(turned(apart, 1, math.pi), 2, math.pi / 2)),
        "a neighbour straight ahead": (textured()[:2], poses((0, 0, 0), (0, 0, 1.5))),
    }


def test_nothing_to_match(within: Within) -> None:
    """Plane sweep: constant pictures, one view, no baseline, neighbours that see nothing, places that nobody sees."""
    points = places()
    for name, (images, cameras) in awkward().items():
        wrong, beyond, rising = 0.0, 0.0, 0.0
        for near, far in ((NEAR, FAR), (0.0, FAR), (NEAR, math.inf), (1e-6, 1e6), (0.999, 1.001)):
            made = sweep_planes(list(patch_descriptors(images)), cameras, near, far)
            wrong += not_finite(made.table)
            rising += float((torch.diff(made.table[0], dim=0) > 1e-6).sum())  # what lies nearer is hidden less
            for truncation in (1e-6, TRUNCATION, 1e3):
                read = made.look(points, torch.full((len(points),), truncation))
                for value, low in ((read.expected_sdf, -1), (read.visibility, 0), (read.confidence, 0)):
                    wrong += not_finite(value)
                    beyond += float(((value < low) | (value > 1)).sum())
        within(f"{name}: values that are not finite", wrong, 0.0)
        within(f"{name}: values out of their range", beyond, 0.0)
        within(f"{name}: likelihoods that rise towards the camera", rising, 0.0)


# ------------------------------------------------------------------------------------------------ float64


def slow_costs(descriptors: list[Tensor], cameras: Cameras, made: DepthDistribution) -> tuple[Tensor, Tensor]:
    """(D, h, w) float64 costs through points in space, 4×4 matrices and loops; and where a rounding decides whether a view sees a place."""
    planes, height, width = made.table.shape[1:]
    cost, unsure = torch.zeros(planes, height, width, dtype=torch.float64), torch.zeros(planes, height, width, dtype=torch.bool)
    wide = [each.double() for each in descriptors]
    matrices = [torch.linalg.inv(pose.double()) for pose in cameras.world_from_camera]
    lens = cameras.intrinsics.double().tolist()
    for y in range(height):
        for x in range(width):
            u, v = (x + 0.5) / width * WIDTH, (y + 0.5) / height * HEIGHT
            own = _bilinear(wide[0], u, v)
            for plane in range(planes):
                depth = 1 / (made.lowest + plane * made.step)
                point = torch.tensor([(u - lens[0][2]) / lens[0][0] * depth, (v - lens[0][3]) / lens[0][1] * depth, depth, 1.0])
                world = cameras.world_from_camera[0].double() @ point.double()
                found = []
                for view in range(1, len(descriptors)):
                    a, b, c, _ = (matrices[view] @ world).tolist()
                    if c / depth <= 1e-4:
                        continue
                    pixel = (a / c * lens[view][0] + lens[view][2], b / c * lens[view][1] + lens[view][3])
                    margin = min(pixel[0], WIDTH - pixel[0], pixel[1], HEIGHT - pixel[1])
                    unsure[plane, y, x] |= abs(margin) < 1e-3
                    if margin >= 0:
                        found.append(_difference(own, _bilinear(wide[view], *pixel)))
                cost[plane, y, x] = 0.5 * (sum(found) / len(found) + min(found)) if found else UNKNOWN
    return cost, unsure


def _bilinear(image: Tensor, u: float, v: float) -> Tensor:
    """(C, H, W) at a pixel; outside the border goes on."""
    left, top = math.floor(u - 0.5), math.floor(v - 0.5)
    total = torch.zeros(len(image), dtype=torch.float64)
    for row, column in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
        inside = image[:, min(max(row, 0), image.shape[1] - 1), min(max(column, 0), image.shape[2] - 1)]
        total += (1 - abs(u - 0.5 - column)) * (1 - abs(v - 0.5 - row)) * inside
    return total


def _difference(one: Tensor, other: Tensor) -> float:
    apart = (one - other).tolist()
    colour = min(1.0, 8 * sum(abs(value) for value in apart[:3]) / 3)
    patch = min(1.0, 0.5 * sum(value * value for value in apart[3:]) / len(apart[3:]))
    return 0.5 * (colour + patch)


def slow_likelihood(cost: Tensor) -> Tensor:
    """(D, h, w) float64: cheapest paths from four sides by trying every plane before, then how likely each plane is."""
    planes = len(cost)
    steps = torch.full((planes, planes), LARGE, dtype=torch.float64)
    for plane in range(planes):
        steps[plane, plane] = 0
        for beside in {plane - 1, plane + 1} & set(range(planes)):
            steps[plane, beside] = SMALL
    total = torch.zeros_like(cost)
    for turn in range(4):
        side = torch.rot90(cost, turn, (1, 2))
        paths = [side[:, 0]]
        for row in range(1, side.shape[1]):
            before = paths[-1] - paths[-1].amin(0)
            paths.append(side[:, row] + (before[None] + steps[:, :, None]).amin(1))
        total += torch.rot90(torch.stack(paths, 1), -turn, (1, 2))
    weight = torch.exp(-(total / 4 - (total / 4).amin(0)) / TEMPERATURE)
    return weight / weight.sum(0)


def test_sweep_exact(within: Within) -> None:
    """Plane sweep: costs and likelihoods of each plane against float64."""
    chosen = {
        "beside, above": poses((0, 0, 0), (0.23, 0.02, 0), (-0.03, 0.21, 0.05)),
        "turned": turned(poses((0, 0, 0), (0.3, 0, 0)), 1, -0.15),
        "1e4 from the origin": poses((8192, 0, 4096), (8192.234375, 0, 4096)),
    }
    for name, cameras in chosen.items():
        images = textured(3, len(cameras))
        descriptors = list(patch_descriptors(images))
        made = sweep_planes(descriptors, cameras, NEAR, FAR)
        cost, unsure = slow_costs(descriptors, cameras, made)
        likely = slow_likelihood(cost)
        nearer = likely.flip(0).cumsum(0).flip(0) - 0.5 * likely
        sure = ~unsure.any()
        within(f"{name}: places on a picture's border", float(~sure), 0.0)
        within(f"{name}: likelihood that the surface is nearer", absolute(made.table[0], nearer), 2e-5)


def test_sweep_carved(within: Within) -> None:
    """Plane sweep: silhouettes that leave nothing, one plane, or what pictures say is impossible.

    Likelihoods still sum to one, none is where it is empty, and places at the ends of the earth can be read.
    """
    planes = 32
    one_left = torch.ones(planes, 1, 2, dtype=torch.bool)
    one_left[7] = False
    sharp = torch.zeros(planes, 1, 2)
    sharp[3] = 1
    never = torch.full((planes, 1, 2), 1e-30)
    for name, likely in {"sharp": sharp, "denormal": never, "even": torch.full((planes, 1, 2), 1 / planes)}.items():
        for holes, empty in {"all": torch.ones_like(one_left), "all but one": one_left, "none": torch.zeros_like(one_left)}.items():
            left = carved(likely, empty)
            within(f"{name}, empty {holes}: values that are not finite", not_finite(left), 0.0)
            within(f"{name}, empty {holes}: sum", absolute(left.sum(0), torch.ones(1, 2)), 1e-6)
            if holes == "all but one":
                within(f"{name}, empty {holes}: likely where it is empty", float((left * empty).max()), 0.0)
    for name, (images, cameras) in awkward().items():
        made = sweep_planes(list(patch_descriptors(images)), cameras, NEAR, FAR, empty=lambda points: points[:, 2] < 1)
        seen = made.look(places(), torch.full((len(places()),), TRUNCATION))
        within(f"{name}: values that are not finite", not_finite(seen.expected_sdf, seen.visibility, seen.confidence), 0.0)


def test_sweep_witnessed(within: Within) -> None:
    """Plane sweep: witnesses that know nothing, look away, stand in the picture or at the ends of the earth.

    What is said stays within its bounds, likelihoods are numbers, and who does not look changes none.
    """
    images, cameras = awkward()["one neighbour"]
    costs = cost_volume(list(patch_descriptors(images)), cameras, NEAR, FAR)
    own_estimate = to_probability(costs).table[0]
    low, high = (SHARE * math.log(value) for value in (AGAINST, FOR + AGAINST))
    for name, (others, seen_by) in awkward().items():
        for near, far in ((NEAR, FAR), (1e-6, 1e6)):
            one = cross_view(sweep_planes(list(patch_descriptors(others)), seen_by, near, far))
            correction = consistency(costs, [one, one])
            assert correction is not None
            made = to_probability(costs, correction=correction)
            ends = f"{name}, {near:g} to {far:g}"
            within(f"{ends}: values that are not finite", not_finite(correction, made.table), 0.0)
            beyond = max(0.0, float(correction.max()) - high, low - float(correction.min()))
            within(f"{ends}: said beyond its bounds", beyond, 1e-5)
            rising = float((torch.diff(made.table[0], dim=0) > 1e-6).sum())
            within(f"{ends}: likelihoods that rise towards the camera", rising, 0.0)
    silent = consistency(costs, [cross_view(sweep_planes(list(patch_descriptors(images)), turned(cameras, 0, math.pi), NEAR, FAR))])
    assert silent is not None
    changed = absolute(to_probability(costs, correction=silent).table[0], own_estimate)
    within("one that looks away: change of likelihoods", changed, 1e-6)


def test_unsure(within: Within) -> None:
    """Plane sweep: what tells nothing about depth is not sure of one."""
    points = torch.tensor([[0.0, 0.0, depth] for depth in (0.6, 1.0, 2.0, 7.0)])
    for name in (
        "black",
        "white",
        "no neighbour",
        "identical cameras",
        "a baseline of 1e-12",
        "one centre, turned",
        "neighbours that look away",
    ):
        images, cameras = awkward()[name]
        made = sweep_planes(list(patch_descriptors(images)), cameras, NEAR, FAR)
        likely = -torch.diff(made.table[0], dim=0)[:, HEIGHT // 4, WIDTH // 4]  # a pixel in the middle, which neighbours see at all depths
        even = 5 / made.table.shape[1]  # of five planes about a peak, where all are alike
        read = made.look(points, torch.full((len(points),), TRUNCATION))
        within(f"{name}: likeliest plane against an even share, less one", float(likely.max()) * made.table.shape[1] - 1, 1e-4)
        within(f"{name}: sure beyond an even share", max(0.0, float(read.confidence.max()) - even), 1e-6)
