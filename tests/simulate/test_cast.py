"""Ray casting against solids: exact by a slow float64 reference, for rays from one place, for scattered rays, for any number of rays."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Array
from fieldfuse.simulate.solids import BALL, BOX, CYLINDER, FAR, ROOM, Solid, Solids, rod, upright


def interval(solid: Solid, origin: Array, direction: Array) -> tuple[float, float]:
    """Entry and exit of one ray, float64, by the textbook."""
    o, d = solid.rotation.T @ (origin - solid.centre), solid.rotation.T @ direction
    with np.errstate(divide="ignore"):
        slabs = np.sort(np.stack([(-solid.half - o) / d, (solid.half - o) / d]), axis=0)
    axes = {BOX: (), ROOM: (), BALL: (0, 1, 2), CYLINDER: (0, 1)}[solid.kind]
    enter, leave = -np.inf, np.inf
    if axes:
        i = list(axes)
        p, q = o[i] / solid.half[i], d[i] / solid.half[i]
        a, b, c = q @ q, 2 * p @ q, p @ p - 1
        if b * b < 4 * a * c:
            return np.inf, -np.inf
        root = np.sqrt(b * b - 4 * a * c)
        enter, leave = (-b - root) / (2 * a), (-b + root) / (2 * a)
    flat = [i for i in range(3) if i not in axes]
    if flat:
        enter, leave = max(enter, slabs[0][flat].max()), min(leave, slabs[1][flat].min())
    return (enter, leave) if enter <= leave else (np.inf, -np.inf)


def reference(solids: list[Solid], origin: Array, direction: Array) -> tuple[float, int]:
    best, which = FAR, -1
    for number, solid in enumerate(solids):
        enter, leave = interval(solid, origin, direction)
        t = leave if solid.kind == ROOM else enter
        if 1e-5 < t < best:
            best, which = t, number
    return best, which


def random_solids(rng: np.random.Generator, count: int, room: bool) -> Solids:
    made = [upright(ROOM, rng.uniform(-0.3, 0.3, 3), rng.uniform(2.5, 4, 3), 0, rng.uniform(0, 90))] * room
    for _ in range(count):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        made.append(Solid((BOX, BALL, CYLINDER)[rng.integers(3)], rng.uniform(-2, 2, 3), rng.uniform(0.05, 0.7, 3), turn, (0,)))
    return Solids(made)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 12), st.booleans(), st.booleans(), st.integers(1, 600))
def test_agrees_with_the_reference(seed: int, count: int, room: bool, one_origin: bool, number: int) -> None:
    rng = np.random.default_rng(seed)
    solids = random_solids(rng, count, room or count == 0)
    origins = rng.uniform(-2.2, 2.2, (1 if one_origin else number, 3))
    directions = rng.normal(size=(number, 3)) * [0.5, 0.5, 0.5] + (rng.random() < 0.5) * np.array([1.0, 0.3, 0.1])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance, solid = solids.cast(torch.tensor(origins, dtype=torch.float32), torch.tensor(directions, dtype=torch.float32))
    assert distance.shape == solid.shape == (number,)
    check = rng.permutation(number)[:60]
    expected = [reference(solids.items, np.broadcast_to(origins, (number, 3))[i], directions[i]) for i in check]
    same = solid.numpy()[check] == [which for _, which in expected]
    assert same.mean() >= 0.95  # a ray through an edge may fall on either side in float32
    np.testing.assert_allclose(distance.numpy()[check][same], np.array([t for t, _ in expected])[same], rtol=2e-4, atol=2e-4)


def test_many_rays_on_threads_are_the_same() -> None:
    solids, rng = random_solids(np.random.default_rng(4), 40, True), np.random.default_rng(1)
    directions = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(9000, 3)), dtype=torch.float32), dim=1)
    before = torch.get_num_threads()
    for origins in (torch.tensor([[0.1, 0.2, -2.0]]), torch.tensor(rng.uniform(-1, 1, (9000, 3)), dtype=torch.float32)):
        single = [solids.cast(origins[i : i + 1] if len(origins) > 1 else origins, directions[i : i + 1]) for i in range(0, 9000, 900)]
        torch.set_num_threads(2)
        distance, solid = solids.cast(origins, directions)
        torch.set_num_threads(before)
        assert torch.equal(distance[::900], torch.cat([one for one, _ in single])) and (distance < FAR).all()
        assert torch.equal(solid[::900], torch.cat([one for _, one in single]))


def test_surfaces_know_face_place_and_normal() -> None:
    """Every hit lies on its solid, its normal faces the ray, and texture places measure metres."""
    rng = np.random.default_rng(6)
    solids = random_solids(rng, 15, True)
    origin = torch.tensor([[0.0, -2.3, 0.1]])
    directions = torch.nn.functional.normalize(torch.tensor(rng.normal((0, 2, 0), size=(3000, 3)), dtype=torch.float32), dim=1)
    distance, solid = solids.cast(origin, directions)
    hit = solid >= 0
    points = origin + distance[hit, None] * directions[hit]
    face, place, normal = solids.surface(solid[hit], points)
    assert ((normal * directions[hit]).sum(1) < 1e-3).all()
    torch.testing.assert_close(normal.norm(dim=1), torch.ones(len(normal)))
    assert face.min() >= 0 and face.max() <= 5
    moved = points + 1e-3 * torch.linalg.cross(normal, torch.nn.functional.normalize(torch.rand(len(points), 3), dim=1))
    face_2, place_2, _ = solids.surface(solid[hit], moved)
    flat = (solid[hit] < solids.ranges[BALL][0]) & (face == face_2)
    step, on_texture = (moved - points).norm(dim=1)[flat], (place_2 - place).norm(dim=1)[flat]
    torch.testing.assert_close(on_texture, step, rtol=0.02, atol=2e-5)


def test_a_texture_is_upright_on_every_wall() -> None:
    """On boxes from outside and rooms from inside: to the right is +u, downwards is +v."""
    for kind, sign in ((BOX, 1.0), (ROOM, -1.0)):
        solids = Solids([upright(kind, [0, 0, 0], [1, 1, 1], 0)])
        for outward in np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
            look = -sign * outward
            right = np.cross(look, [0, 0, 1.0])
            points = torch.tensor(np.stack([outward, outward + 0.1 * right, outward - [0, 0, 0.1]]), dtype=torch.float32)
            _, place, normal = solids.surface(torch.zeros(3, dtype=torch.int64), points)
            np.testing.assert_allclose((place[1] - place[0]).numpy(), [0.1, 0], atol=1e-6)
            np.testing.assert_allclose((place[2] - place[0]).numpy(), [0, 0.1], atol=1e-6)
            np.testing.assert_allclose(normal[0].numpy(), sign * outward, atol=1e-6)


def test_clearance_is_the_distance_to_the_nearest_surface() -> None:
    solids = Solids(
        [
            upright(ROOM, [0, 0, 0], [3, 3, 3], 0),
            upright(BOX, [1, 0, 0], [0.5, 0.5, 0.5], 0),
            upright(BALL, [-1.5, 0, 0], [0.5] * 3, 0),
            rod([0, -2, -1], [0, -2, 1], 0.1, 0),
        ]
    )
    points = torch.tensor([[0.0, 0, 0], [2.9, 0, 0], [1.0, 0, 0], [-1.5, 0.9, 0], [0.0, -1.5, 0], [0.0, -2.0, 1.4], [4.0, 0, 0]])
    expected = [0.5, 0.1, -0.5, 0.4, 0.4, 0.4, -1.0]
    np.testing.assert_allclose(solids.clearance(points).numpy(), expected, atol=1e-5)
