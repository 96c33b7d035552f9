"""Ray casting against a slow float64 reference, and the shapes' own geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Array
from fieldfuse.simulate.baked import surface
from fieldfuse.simulate.trace import FAR, Rectangle, Shapes, Sphere


def reference(rectangles: list[Rectangle], spheres: list[Sphere], origin: Array, direction: Array) -> tuple[float, int]:
    """Nearest hit of one ray, one shape after the other."""
    best, shape = FAR, -1
    for number, r in enumerate(rectangles):
        normal = np.cross(r.down, r.across)
        slope = direction @ normal
        if slope >= 0:
            continue
        t = (r.corner - origin) @ normal / slope
        place = origin + t * direction - r.corner
        u, v = place @ r.across / (r.across @ r.across), place @ r.down / (r.down @ r.down)
        if 0 <= u <= 1 and 0 <= v <= 1 and 1e-6 < t < best:
            best, shape = t, number
    for number, s in enumerate(spheres):
        b = direction @ (origin - s.centre)
        root = b * b - (origin - s.centre) @ (origin - s.centre) + s.radius**2
        if root > 0 and 1e-6 < -b - np.sqrt(root) < best:
            best, shape = -b - np.sqrt(root), len(rectangles) + number
    return best, shape


def random_shapes(rng: np.random.Generator, rectangles: int, spheres: int) -> tuple[list[Rectangle], list[Sphere]]:
    made = []
    for _ in range(rectangles):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        made.append(Rectangle(rng.uniform(-1, 1, 3), turn[0] * rng.uniform(0.5, 2), turn[1] * rng.uniform(0.5, 2)))
    return made, [Sphere(rng.uniform(-1, 1, 3), float(rng.uniform(0.1, 0.6))) for _ in range(spheres)]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 8), st.integers(1, 4), st.booleans())
def test_agrees_with_the_reference(seed: int, rectangles: int, spheres: int, one_origin: bool) -> None:
    rng = np.random.default_rng(seed)
    flat, round_ones = random_shapes(rng, rectangles, spheres)
    origins = rng.uniform(-3, 3, (1 if one_origin else 200, 3))
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = Shapes(flat, round_ones).cast(torch.tensor(origins, dtype=torch.float32), torch.tensor(directions, dtype=torch.float32))
    expected = [reference(flat, round_ones, origin, d) for origin, d in zip(np.broadcast_to(origins, (200, 3)), directions, strict=True)]
    same = hits.shape.numpy() == [shape for _, shape in expected]
    assert same.mean() >= 0.99  # a ray through an edge may fall on either side in float32
    distance = np.array([t for t, _ in expected])
    np.testing.assert_allclose(hits.distance.numpy()[same], distance[same], rtol=2e-3)


def test_a_hit_is_where_its_texture_place_says() -> None:
    rng = np.random.default_rng(3)
    flat, round_ones = random_shapes(rng, 6, 3)
    origin = np.array([[0.3, -2.5, 0.4]])
    directions = rng.normal(size=(4000, 3)) * [0.4, 0.1, 0.4] + [0, 1, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = Shapes(flat, round_ones).cast(torch.tensor(origin, dtype=torch.float32), torch.tensor(directions, dtype=torch.float32))
    seen = set()
    for number, shape in enumerate([*flat, *round_ones]):
        mine = (hits.shape == number).numpy()
        if mine.any():
            points, normals = surface(shape, hits.u.numpy()[mine].astype(float), hits.v.numpy()[mine].astype(float))
            np.testing.assert_allclose(points, origin + hits.distance.numpy()[mine, None] * directions[mine], atol=2e-3)
            assert (np.einsum("ij,ij->i", normals, directions[mine]) < 1e-2).all()
            seen.add(type(shape))
    assert seen == {Rectangle, Sphere}


def test_backs_are_not_hit_and_blocked_has_a_limit() -> None:
    facing_up = Shapes([Rectangle(np.array([-1.0, 1.0, 0.0]), np.array([2.0, 0, 0]), np.array([0, -2.0, 0]))], [])
    above, below = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -2.0]])
    down, up = torch.tensor([[0.0, 0.0, -1.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    assert facing_up.blocked(above, down).tolist() == [True]
    assert facing_up.blocked(above, down, 1.9).tolist() == [False]
    both = facing_up.cast(torch.cat([above, below]), torch.cat([down, up]))
    assert both.shape.tolist() == [0, -1]
    assert both.distance.tolist() == [pytest.approx(2.0), pytest.approx(FAR)]
