"""Gaussian splats: the kernels against the reference in float64, in values and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fieldfuse.backends.numba import splats as G
from fieldfuse.camera import Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.render import splats as S
from tests.render import splats_reference

CAMERA = Intrinsics(45, 37, 40.0, 42.0, 21.0, 19.5)
POSE = np.array([[0.936, -0.275, 0.218, 0.1], [0.289, 0.956, -0.036, -0.2], [-0.199, 0.097, 0.975, 0.05], [0, 0, 0, 1]])


def some(count: int, degree: int, seed: int = 0) -> NDArray[np.float32]:
    """Gaussians before the camera, a few of them beside the image or behind it, some large, some nearly opaque."""
    rng, columns = np.random.default_rng(seed), 11 + 3 * (degree + 1) ** 2
    values = rng.normal(0, 0.3, (count, columns))
    depth = rng.uniform(1, 3, count)
    depth[: count // 10] *= -1
    at = np.stack([rng.uniform(-0.7, 0.7, count) * depth, rng.uniform(-0.6, 0.6, count) * depth, depth], 1)
    values[:, :3] = at @ POSE[:3, :3].T + POSE[:3, 3]
    values[:, 3:6] = rng.uniform(np.log(0.01), np.log(0.25), (count, 3))
    values[:, 6:10] = rng.normal(size=(count, 4))
    values[:, 10] = rng.uniform(-4, 5, count)
    return values.astype(np.float32)


def test_a_drawing_is_the_references() -> None:
    values = some(120, 3)
    drawn = S.draw(values, S.make_lens(CAMERA, POSE, 0.0))
    image, light = splats_reference.draw(torch.from_numpy(values).double(), CAMERA, POSE)
    np.testing.assert_allclose(drawn.image[..., :3], image.numpy(), atol=2e-4)
    np.testing.assert_allclose(drawn.image[..., 3], light.numpy(), atol=2e-4)
    assert light.min() < 0.1 and light.max() > 0.5


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gradients_are_the_references(degree: int) -> None:
    values = some(60, degree, seed=degree + 1)
    lens = S.make_lens(CAMERA, POSE, 0.0)
    drawn = S.draw(values, lens)
    rng = np.random.default_rng(5)
    pull, behind = rng.normal(size=(CAMERA.height, CAMERA.width, 3)), np.array([0.3, 0.5, 0.9])
    exact = torch.from_numpy(values).double().requires_grad_(True)
    image, light = splats_reference.draw(exact, CAMERA, POSE)
    ((image + light[..., None] * torch.from_numpy(behind)) * torch.from_numpy(pull)).sum().backward()  # type: ignore[no-untyped-call]
    colour = drawn.image[..., :3] + drawn.image[..., 3:4] * behind
    slope = np.concatenate([pull, (pull * colour).sum(2, keepdims=True)], 2).astype(np.float32)
    found = S.gradient(values, lens, drawn, slope)
    assert exact.grad is not None
    wanted = exact.grad.numpy()
    for name, columns in {"mean": slice(0, 3), "scale": slice(3, 6), "rotation": slice(6, 10), "opacity": slice(10, 11), "sh": slice(11, None)}.items():
        scale = np.abs(wanted[:, columns]).max()
        np.testing.assert_allclose(found[:, columns], wanted[:, columns], atol=2e-3 * scale, err_msg=name)
