"""Gaussian splats: the kernels against the reference in float64, in values and gradients."""

from __future__ import annotations

import gzip
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fieldfuse.render import splats as S
from fieldfuse.render.splat_files import TURNED, open_splats, save_splats, to_spz
from tests.render import splats_reference
from tests.render.made import SPLAT_CAMERA, SPLAT_POSE, some_splats


def test_a_drawing_is_the_references() -> None:
    values = some_splats(120, 3)
    drawn = S.draw(values, S.make_lens(SPLAT_CAMERA, SPLAT_POSE, 0.0))
    image, light = splats_reference.draw(torch.from_numpy(values).double(), SPLAT_CAMERA, SPLAT_POSE)
    np.testing.assert_allclose(drawn.image[..., :3], image.numpy(), atol=2e-4)
    np.testing.assert_allclose(drawn.image[..., 3], light.numpy(), atol=2e-4)
    assert light.min() < 0.1 and light.max() > 0.5


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gradients_are_the_references(degree: int) -> None:
    values = some_splats(60, degree, seed=degree + 1)
    lens = S.make_lens(SPLAT_CAMERA, SPLAT_POSE, 0.0)
    drawn = S.draw(values, lens)
    rng = np.random.default_rng(5)
    pull, behind = rng.normal(size=(SPLAT_CAMERA.height, SPLAT_CAMERA.width, 3)), np.array([0.3, 0.5, 0.9])
    exact = torch.from_numpy(values).double().requires_grad_(True)
    image, light = splats_reference.draw(exact, SPLAT_CAMERA, SPLAT_POSE)
    ((image + light[..., None] * torch.from_numpy(behind)) * torch.from_numpy(pull)).sum().backward()  # type: ignore[no-untyped-call]
    colour = drawn.image[..., :3] + drawn.image[..., 3:4] * behind
    slope = np.concatenate([pull, (pull * colour).sum(2, keepdims=True)], 2).astype(np.float32)
    found = S.gradient(values, lens, drawn, slope)
    assert exact.grad is not None
    wanted = exact.grad.numpy()
    parts = {"mean": slice(0, 3), "scale": slice(3, 6), "rotation": slice(6, 10), "opacity": slice(10, 11), "sh": slice(11, None)}
    for name, columns in parts.items():
        scale = np.abs(wanted[:, columns]).max()
        np.testing.assert_allclose(found[:, columns], wanted[:, columns], atol=2e-3 * scale, err_msg=name)


def as_unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit quaternions with w ≥ 0."""
    turn = values[:, 6:10] / np.linalg.norm(values[:, 6:10], axis=1, keepdims=True)
    return np.where(turn[:, :1] < 0, -turn, turn)


def as_columns(values: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """The parameters under the names that the authors' files have."""
    count = (values.shape[1] - 11) // 3
    columns = {name: values[:, k] for k, name in enumerate(("x", "y", "z", "scale_0", "scale_1", "scale_2"))}
    turn = as_unit(values)
    columns |= {f"rot_{k}": turn[:, k] for k in range(4)} | {"opacity": values[:, 10]}
    columns |= {f"f_dc_{c}": values[:, 11 + c] for c in range(3)}
    return columns | {f"f_rest_{c * (count - 1) + k - 1}": values[:, 11 + 3 * k + c] for c in range(3) for k in range(1, count)}


@pytest.mark.parametrize("degree", range(4))
def test_a_ply_is_what_another_library_reads(degree: int, tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile", reason="plyfile reads the file independently: pip install plyfile")
    values = some_splats(50, degree)
    save_splats(tmp_path / "splat.ply", S.Splats(values, np.zeros(3)))
    vertex = plyfile.PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    for name, column in as_columns(values).items():
        np.testing.assert_allclose(vertex[name], column, rtol=1e-6, atol=1e-7, err_msg=name)
    assert [p.name for p in vertex.properties][:6] == ["x", "y", "z", "nx", "ny", "nz"] and not vertex["nx"].any()
    back = open_splats(tmp_path / "splat.ply")
    np.testing.assert_allclose(back.values[:, :6], values[:, :6], rtol=1e-6)
    np.testing.assert_array_equal(back.values[:, 10:], values[:, 10:])
    assert back.degree == degree


@pytest.mark.parametrize("degree", range(4))
def test_what_another_library_writes_is_read(degree: int, tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile", reason="plyfile writes the file independently: pip install plyfile")
    values, path = some_splats(50, degree, seed=9), tmp_path / "theirs.ply"
    columns = as_columns(values)
    rows = np.zeros(50, [(name, "f4") for name in reversed(columns)])  # in another order, and with a column of their own
    for name, column in columns.items():
        rows[name] = column
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], text=degree == 0, byte_order=">" if degree == 1 else "<").write(str(path))
    image = S.Splats(values, np.zeros(3)).render(SPLAT_CAMERA, SPLAT_POSE).rgb
    np.testing.assert_allclose(open_splats(path).render(SPLAT_CAMERA, SPLAT_POSE).rgb, image, atol=1e-5)


@pytest.mark.parametrize("degree", range(4))
def test_a_spz_is_what_another_library_reads(degree: int, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply reads the file independently: pip install gsply")
    values = some_splats(60, degree, seed=3)
    save_splats(tmp_path / "splat.spz", S.Splats(values, np.zeros(3)))
    theirs, ours = gsply.read_spz(str(tmp_path / "splat.spz")), open_splats(tmp_path / "splat.spz").values
    # The library leaves the file's axes as they are: right, up, back.
    rest = np.asarray(theirs.shN).reshape(60, -1, 3) * TURNED[: (degree + 1) ** 2 - 1, None] if degree else np.zeros((60, 0, 3))
    harmonics = np.concatenate([theirs.sh0[:, None], rest], 1)
    found = (theirs.means * [1, -1, -1], theirs.scales, theirs.opacities, harmonics.reshape(60, -1))
    for mine, other in zip((ours[:, :3], ours[:, 3:6], ours[:, 10], ours[:, 11:]), found, strict=True):
        np.testing.assert_allclose(mine, other, rtol=4e-6, atol=2e-6)
    turn = np.asarray(theirs.quats) * [1, 1, -1, -1]
    np.testing.assert_allclose(np.abs((turn * ours[:, 6:10]).sum(1)), 1, atol=1e-5)
    # What the format keeps of the values: 2⁻²⁰ of places here, sixteenths of a logarithm, a part in 255 of the others.
    assert np.abs(ours[:, :3] - values[:, :3]).max() < 1e-6 and np.abs(ours[:, 3:6] - values[:, 3:6]).max() <= 1 / 32 + 1e-6
    assert np.abs(ours[:, 11:14] - values[:, 11:14]).max() < 0.014
    assert np.abs(ours[:, 14:] - values[:, 14:].clip(-1, 1)).max(initial=0) <= 1 / 128
    assert np.abs((ours[:, 6:10] * as_unit(values)).sum(1)).min() > 1 - 1e-5


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_formats_axes_are_those_that_splat_transform_reads(degree: int, tmp_path: Path) -> None:
    if shutil.which("splat-transform") is None:
        pytest.skip("splat-transform reads the file with Niantic's own code: npm install -g @playcanvas/splat-transform")
    values = some_splats(60, degree, seed=4)
    save_splats(tmp_path / "splat.spz", S.Splats(values, np.zeros(3)))
    subprocess.run(["splat-transform", "-q", tmp_path / "splat.spz", tmp_path / "back.ply"], check=True, capture_output=True, timeout=60)
    ours, theirs = (open_splats(tmp_path / name).render(SPLAT_CAMERA, SPLAT_POSE).rgb for name in ("splat.spz", "back.ply"))
    np.testing.assert_allclose(theirs, ours, atol=2e-3)


def test_version_2_of_spz_is_read(tmp_path: Path) -> None:
    """Its rotations are x, y and z in a byte each; w, which is not negative, follows."""
    gsply = pytest.importorskip("gsply", reason="gsply reads the file independently: pip install gsply")
    values, path = some_splats(60, 1, seed=6), tmp_path / "2.spz"
    body = bytearray(gzip.decompress(to_spz(S.Splats(values, np.zeros(3)))))
    body[4] = 2
    turn = np.rint(as_unit(values)[:, 1:] * [127.5, -127.5, -127.5] + 127.5).astype(np.uint8).tobytes()
    begin = 16 + 60 * (9 + 1 + 3 + 3)
    path.write_bytes(gzip.compress(bytes(body[:begin]) + turn + bytes(body[begin + 60 * 4 :])))
    ours, theirs = open_splats(path).values, gsply.read_spz(str(path))
    assert np.abs((ours[:, 6:10] * as_unit(values)).sum(1)).min() > 0.99
    other = np.asarray(theirs.quats) * [1, 1, -1, -1]
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((other * as_unit(ours)).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(ours[:, :3], theirs.means * [1, -1, -1], atol=1e-6)
