"""DTU/IDR: projections of any scale and sign, the known crop, masks, order, and broken archives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.capture import open_capture
from fieldfuse.capture.dtu import camera_for, decompose, read_dtu
from fieldfuse.errors import InputError
from tests.capture.layouts import OFF_CENTRE, write_dtu
from tests.capture.made import eyes, pixel_error, save_picture
from tests.conftest import shared_data


@settings(max_examples=60, deadline=None)
@given(
    st.floats(50, 3000), st.floats(50, 3000), st.floats(-200, 2000), st.floats(-200, 2000),
    st.integers(0, 4), st.floats(1e-3, 1e3), st.booleans(), st.floats(-1e3, 1e3),
)  # fmt: skip
def test_decomposition_undoes_any_projection(
    fx: float, fy: float, cx: float, cy: float, index: int, scale: float, negative: bool, offset: float
) -> None:
    eye = eyes()[index]
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    centre = eye.centre + offset
    projection = k @ np.hstack([eye.rotation(), -eye.rotation() @ centre[:, None]]) * (-scale if negative else scale)
    matrix, pose = decompose(projection, "here")
    np.testing.assert_allclose(matrix, k, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(pose[:3, :3], eye.rotation().T, atol=1e-7)
    np.testing.assert_allclose(pose[:3, 3], centre, rtol=1e-6, atol=1e-5)


ORIGINAL = np.array([[2892.0, 0, 822.7], [0, 2883.0, 619.1], [0, 0, 1]])


@pytest.mark.parametrize(
    ("size", "focal", "centre"),
    [
        ((1600, 1200), 2892.0, (823.2, 619.6)),
        ((800, 600), 1446.0, (411.6, 309.8)),
        ((400, 300), 723.0, (205.8, 154.9)),
        ((384, 384), 925.44, ((823.2 - 200) * 0.32, 619.6 * 0.32)),
        ((1200, 1200), 2892.0, (623.2, 619.6)),
    ],
)
def test_known_crops_and_sizes_of_the_original(size: tuple[int, int], focal: float, centre: tuple[float, float]) -> None:
    camera, warning = camera_for(ORIGINAL, size, "here")
    assert (camera.width, camera.height) == size
    assert camera.fx == pytest.approx(focal)
    assert (camera.cx, camera.cy) == pytest.approx(centre)
    assert (warning is None) == (size == (1600, 1200))


@pytest.mark.parametrize("size", [(300, 400), (768, 576 + 90), (640, 300)])
def test_an_unknown_crop_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="about 1646×1239"):
        camera_for(ORIGINAL, size, "here")


def test_region_and_preferred_archive(tmp_path: Path) -> None:
    write_dtu(tmp_path)
    assert open_capture(tmp_path).extra == {"region": {"centre": [0.1, -0.2, 0.6], "radius": 2.0}}
    np.savez(tmp_path / "cameras_linear_init.npz", world_mat_0=np.eye(4))
    assert len(open_capture(tmp_path).frames) == 5


def test_pictures_are_matched_by_number(tmp_path: Path) -> None:
    write_dtu(tmp_path)
    for index in range(5):
        (tmp_path / f"image/{index:06d}.png").rename(tmp_path / f"image/view{index}_rgb.png")
    with np.load(tmp_path / "cameras.npz") as archive:
        arrays = {key.replace("_mat_", "_mat_1" if key.endswith("0") else "_mat_"): archive[key] for key in archive.files}
    (tmp_path / "image/view0_rgb.png").rename(tmp_path / "image/view10_rgb.png")
    np.savez(tmp_path / "cameras.npz", **arrays)
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["view1_rgb", "view2_rgb", "view3_rgb", "view4_rgb", "view10_rgb"]
    assert pixel_error(capture, [eyes()[i] for i in (1, 2, 3, 4, 0)], OFF_CENTRE) < 1e-3


def test_masks(tmp_path: Path) -> None:
    write_dtu(tmp_path)
    for index in range(5):
        save_picture(tmp_path / f"mask/{index:03d}.png", np.repeat(np.eye(60, 80, dtype=np.uint8)[..., None] * 255, 3, axis=2))
    assert [frame.mask.name for frame in open_capture(tmp_path).frames] == [f"{i:03d}.png" for i in range(5)]
    (tmp_path / "mask/000.png").unlink()
    with pytest.raises(InputError, match="5 images but 4 masks"):
        open_capture(tmp_path)


def test_pictures_and_cameras_must_be_as_many(tmp_path: Path) -> None:
    write_dtu(tmp_path)
    (tmp_path / "image/000000.png").unlink()
    with pytest.raises(InputError, match="4 images but 5 poses"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.full((4, 4), np.nan), "not finite"),
        (np.zeros((4, 4)), "singular"),
        (np.eye(3), "shape"),
        (np.diag([500.0, 500, 1, 1]), "for an image of about"),
        (np.array([["a"] * 4] * 4), "does not hold numbers"),
    ],
)
def test_broken_projections(tmp_path: Path, matrix: np.ndarray, message: str) -> None:
    write_dtu(tmp_path)
    with np.load(tmp_path / "cameras.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "cameras.npz", **{**arrays, "world_mat_2": matrix})
    with pytest.raises(InputError, match=message):
        read_dtu(tmp_path)


def test_pickled_and_broken_archives(tmp_path: Path) -> None:
    write_dtu(tmp_path)
    np.savez(tmp_path / "cameras.npz", world_mat_0=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="not an archive of camera matrices"):
        read_dtu(tmp_path)
    np.savez(tmp_path / "cameras.npz", other=np.eye(4))
    with pytest.raises(InputError, match="no world_mat_0"):
        read_dtu(tmp_path)
    np.savez_compressed(tmp_path / "cameras.npz", world_mat_0=np.zeros((2000, 2000)))
    with pytest.raises(InputError, match="far too large"):
        read_dtu(tmp_path)


def test_scan24() -> None:
    capture = open_capture(shared_data("dtu_scan24_384"))
    assert (capture.kind, len(capture.frames)) == ("dtu", 49)
    assert capture.warnings == ("the cameras are for 1600×1200 images; 384×384 was taken as the middle 1200×1200 of it, resized",)
    assert capture.extra["region"]["radius"] == pytest.approx(223.3332)
