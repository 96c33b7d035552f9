"""Alpha cuts an object out in every layout whose images can hold it, and full alpha says nothing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.images import HEADERS, cut_out
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.types import Frame
from fieldfuse.config import CaptureSettings
from fieldfuse.pipelines.info import see_through
from tests.capture.board import texture
from tests.capture.layouts import LAYOUTS

# Counts as cut out; JPEG and video hold no alpha.
OTHERS = ("blender", "polycam", "record3d", "redwood", "replica", "rgbd", "scannet", "scannetpp", "scanner3d", "sens", "stray")
HIDDEN = (255, 0, 255)  # RGB of what alpha takes away


def with_alpha(path: Path, alpha: Array | int) -> None:
    """A PNG as it is, with alpha (H, W) or one value; where it is 0, the colour is `HIDDEN`."""
    picture = cv2.imread(str(path))
    full = np.broadcast_to(np.asarray(alpha, np.uint8), picture.shape[:2])
    picture[full == 0] = HIDDEN[::-1]
    assert cv2.imwrite(str(path), np.dstack([picture, full]))


def left_half(capture: Capture) -> Array:
    height, width = cv2.imread(str(capture.frames[0].image)).shape[:2]
    return np.broadcast_to(np.where(np.arange(width) < width // 2, 255, 0), (height, width))


def made(root: Path, layout: str) -> Capture:
    if layout == "photos":
        for index in range(5):
            cv2.imwrite(str(root / f"{index}.png"), texture(60, 80, seed=index))
    else:
        LAYOUTS[layout][1](root)
    return open_capture(root)


@pytest.mark.parametrize("layout", ["photos", *(name for name in LAYOUTS if name not in OTHERS)])
def test_only_what_is_cut_out_is_on_white(tmp_path: Path, layout: str) -> None:
    capture = made(tmp_path, layout)
    assert not capture.alpha
    files = {frame.image for frame in capture.frames}
    for file in files:
        with_alpha(file, 255)
    opaque = open_capture(tmp_path)
    assert opaque.kind == capture.kind and not opaque.alpha
    alpha = left_half(capture)
    for file in files:
        with_alpha(file, alpha)
    assert not opaque.alpha
    cut = open_capture(tmp_path)
    assert cut.kind == capture.kind and cut.alpha
    height, width = alpha.shape
    camera = Intrinsics(width, height, 70.0, 70.0, width / 2, height / 2)
    posed = cut.with_frames([Frame(str(index), frame.image, camera, np.eye(4)) for index, frame in enumerate(cut.frames)])
    views = prepare_views(posed, Similarity.identity(), CaptureSettings())
    assert views.background == (1.0, 1.0, 1.0)
    for image, seen in zip(views.images, views.alpha, strict=True):
        assert (image[:, width // 2 + 1 :] == 255).all() and (seen[:, : width // 2] == 255).all()


def test_nerf_synthetic_counts_as_cut_out_whatever_alpha_says(tmp_path: Path) -> None:
    for frame in made(tmp_path, "blender").frames:
        with_alpha(frame.image, 255)
    assert open_capture(tmp_path).alpha


def test_a_few_pictures_are_looked_at(tmp_path: Path) -> None:
    frames = []
    for index in range(3 * HEADERS):
        path = tmp_path / f"{index:03d}.png"
        assert cv2.imwrite(str(path), np.dstack([texture(12, 16, seed=index), np.full((12, 16), 255, np.uint8)]))
        frames.append(Frame(path.stem, path))
    assert not cut_out(frames)
    with_alpha(frames[1].image, 0)
    assert not cut_out(frames)  # one between those
    for index in (0, -1):
        with_alpha(frames[index].image, 0)
        assert cut_out(frames)
        with_alpha(frames[index].image, 255)


def test_one_of_many_with_alpha_and_files_that_are_damaged(tmp_path: Path) -> None:
    frames = []
    for index in range(20):
        path = tmp_path / f"{index}.png"
        assert cv2.imwrite(str(path), texture(12, 16, seed=index))
        frames.append(Frame(path.stem, path))
    frames[2].image.write_bytes(b"no image")
    frames[3].image.unlink()
    assert not cut_out(frames) and not cut_out([])
    with_alpha(frames[13].image, 0)
    assert cut_out(frames)
    frames[13].image.write_bytes(frames[13].image.read_bytes()[:60])  # a good header, and no pixels
    assert not cut_out(frames)


def test_info_says_how_much_alpha_cuts_away(tmp_path: Path) -> None:
    for index in range(3):
        pixels = np.full((40, 50, 4), 255, np.uint8)
        pixels[:, :40, 3] = 0
        pixels[:, :, 0] = 60 * index
        cv2.imwrite(str(tmp_path / f"{index}.png"), pixels)
    assert see_through(open_capture(tmp_path)) == "80% of the pixels are transparent (by 3 of 3 images)"
