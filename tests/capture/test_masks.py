"""Masks beside images of every layout: found by their names, of any size and depth, inverted, missing, whole, broken."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from fieldfuse.camera import Array, Similarity
from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.images import load_image, load_mask, usable_pixels
from fieldfuse.capture.masks import is_mask_folder
from fieldfuse.capture.photos import read_photos
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.capture.types import Frame
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from fieldfuse.poses.points import triangulate
from tests.capture.layouts import write_blender, write_colmap_bin, write_llff, write_transforms
from tests.conftest import shared_data

SAME = Similarity(1.0, np.eye(3), np.zeros(3))


def half(width: int = 80, height: int = 60, left: int = 40, dtype: type = np.uint8) -> Array:
    """White to the left, black to the right."""
    mask = np.zeros((height, width), dtype)
    mask[:, :left] = np.iinfo(dtype).max
    return mask


def save(path: Path, picture: Array, **how: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, **how)
    return path


def photos(root: Path, names: list[str], size: tuple[int, int] = (80, 60)) -> None:
    random = np.random.default_rng(0)
    for name in names:
        save(root / name, cv2.resize(random.integers(0, 255, (6, 8, 3), dtype=np.uint8), size, interpolation=cv2.INTER_CUBIC))


def kept(capture: Capture) -> list[float]:
    masks = [load_mask(frame) for frame in capture.frames]
    return [1.0 if mask is None else round(float(mask.mean()), 3) for mask in masks]


@pytest.mark.parametrize(
    "name", ["masks/{stem}.png", "masks/{name}.png", "images_mask/{stem}.png", "mask/{stem}_mask.png", "imageMasks/mask_{stem}.png"]
)
@pytest.mark.parametrize("write", [write_transforms, write_colmap_bin, write_llff])
def test_masks_in_a_folder_of_any_layout(tmp_path: Path, write, name: str) -> None:
    write(tmp_path)
    without = open_capture(tmp_path)
    assert kept(without) == [1.0] * len(without.frames)
    for frame in without.frames:
        save(tmp_path / name.format(stem=frame.image.stem, name=frame.image.name), half())
    capture = open_capture(tmp_path)
    assert capture.kind == without.kind and [frame.name for frame in capture.frames] == [frame.name for frame in without.frames]
    assert kept(capture) == [0.5] * len(capture.frames)
    assert any(f"{len(capture.frames)} of {len(capture.frames)} images have a mask in" in warning for warning in capture.warnings)
    views = prepare_views(capture, SAME, CaptureSettings(image_size=80))
    assert all(valid is not None and valid[:, :38].all() and not valid[:, 40:].any() for valid in views.valid)


def test_masks_follow_the_folders_of_a_split(tmp_path: Path) -> None:
    write_blender(tmp_path)
    for frame in open_capture(tmp_path).frames:
        save(tmp_path / "masks" / frame.image.relative_to(tmp_path.resolve()), half(left=20 if frame.split == "train" else 60))
    capture = open_capture(tmp_path)
    assert {(frame.split, share) for frame, share in zip(capture.frames, kept(capture), strict=True)} == {("train", 0.25), ("test", 0.75)}


@pytest.mark.parametrize(
    "name", ["{stem}_mask.png", "mask_{stem}.png", "{stem}.mask.png", "{stem}-mask.jpg", "{stem}.alpha.png", "{stem}.png"]
)
def test_masks_among_photos_are_no_photos(tmp_path: Path, name: str) -> None:
    stems = ["1", "11", "2"]
    photos(tmp_path, [f"{stem}.jpg" for stem in stems])
    for stem in stems:
        save(tmp_path / name.format(stem=stem), half())
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["1", "2", "11"]
    assert kept(capture) == [0.5] * 3


@pytest.mark.parametrize("name", ["mask.png", "images/camera_mask.png", "mask/all.png"])
def test_one_mask_for_all_images(tmp_path: Path, name: str) -> None:
    photos(tmp_path, [f"images/{index}.jpg" for index in range(3)])
    save(tmp_path / name, half())
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["0", "1", "2"] and kept(capture) == [0.5] * 3


def test_cut_outs_among_photos_are_their_masks(tmp_path: Path) -> None:
    photos(tmp_path, [f"{index}.jpg" for index in range(3)])
    for index in range(3):
        picture = np.array(Image.open(tmp_path / f"{index}.jpg"))
        save(tmp_path / f"{index}-removebg-preview.png", np.dstack([picture, half()]))
    assert kept(open_capture(tmp_path)) == [0.5] * 3


def test_photos_of_masks_are_photos(tmp_path: Path) -> None:
    photos(tmp_path, ["venetian.jpg", "venetian_mask.jpg", "mask_2.jpg", "mask.jpg", "venetian.png"])
    assert len(read_photos(tmp_path).frames) == 5
    assert not any(is_mask_folder(name) for name in ("unmasked_photos", "depth_masks", "damask"))


def test_dynamic_masks_leave_out_what_is_white(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for frame in open_capture(tmp_path).frames:
        save(frame.image.parent / f"dynamic_mask_{frame.image.stem}.png", half(left=20))
    capture = open_capture(tmp_path)
    assert kept(capture) == [0.75] * len(capture.frames)
    assert any("white is left out" in warning for warning in capture.warnings)
    assert kept(capture_from_dict(json.loads(json.dumps(capture_to_dict(capture))))) == kept(capture)


def test_a_folder_of_dynamic_masks_leaves_out_what_is_white(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for frame in open_capture(tmp_path).frames:
        save(tmp_path / "dynamic_masks" / f"{frame.image.stem}.png", half(left=20))
    assert kept(open_capture(tmp_path)) == [0.75] * len(open_capture(tmp_path).frames)


@pytest.mark.parametrize(("key", "share"), [("mask_path", 0.25), ("mask_file_path", 0.25), ("dynamic_mask_path", 0.75)])
def test_masks_that_a_json_lists(tmp_path: Path, key: str, share: float) -> None:
    write_transforms(tmp_path)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for index, entry in enumerate(data["frames"][:-1]):
        save(tmp_path / f"any/{index}.png", half(left=20))
        entry[key] = f"any/{index}.png"
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    capture = open_capture(tmp_path)
    assert sorted(kept(capture)) == sorted([share] * (len(capture.frames) - 1) + [1.0])
    assert f"a mask (listed by the capture), which leaves {100 * share:.0f}% of the pixels" in " ".join(capture.warnings)
    assert {round(1 - one, 3) for one in kept(open_capture(tmp_path, "inverted"))} == {share, 0.0}
    assert kept(open_capture(tmp_path, "off")) == [1.0] * len(capture.frames)


@pytest.mark.parametrize("name", ["{stem}_mask.png", "{name}.mask.png"])
@pytest.mark.parametrize("write", [write_transforms, write_blender, write_colmap_bin, write_llff])
def test_masks_beside_the_images_of_any_layout(tmp_path: Path, write, name: str) -> None:
    write(tmp_path)
    before = open_capture(tmp_path)
    for frame in before.frames:
        save(frame.image.parent / name.format(stem=frame.image.stem, name=frame.image.name), half())
    capture = open_capture(tmp_path)
    assert (capture.kind, len(capture.frames)) == (before.kind, len(before.frames)) and kept(capture) == [0.5] * len(capture.frames)


@pytest.mark.parametrize(
    "mask",
    [
        half() > 0,
        half(dtype=np.uint16),
        half(40, 30, 20),
        np.dstack([np.full((60, 80, 3), 90, np.uint8), half()]),
        np.minimum(half(), 1),
        np.repeat(half()[..., None], 3, axis=2),
    ],
    ids=["1 bit", "16 bit", "half the size", "alpha", "0 and 1", "rgb"],
)
def test_masks_of_all_depths_and_sizes(tmp_path: Path, mask: Array) -> None:
    photos(tmp_path, [f"images/{index}.jpg" for index in range(3)])
    for index in range(3):
        save(tmp_path / f"masks/{index}.png", mask)
    capture = open_capture(tmp_path)
    assert kept(capture) == [0.5] * 3
    usable = usable_pixels(capture.frames[0], load_image(capture.frames[0]))
    assert usable is not None and usable.shape == (60, 80) and usable.mean() == 0.5


def test_soft_and_lossy_masks_are_cut_at_half(tmp_path: Path) -> None:
    ramp = np.repeat(np.linspace(0, 255, 200).astype(np.uint8)[None], 100, axis=0)
    photos(tmp_path, ["a.jpg"])
    soft = Frame("a", tmp_path / "a.jpg", mask=save(tmp_path / "m.png", ramp))
    assert load_mask(soft).mean() == pytest.approx(0.5, abs=0.01)
    lossy = replace(soft, mask=save(tmp_path / "m.jpg", half(), quality=30))
    assert load_mask(lossy).mean() == 0.5


def test_masks_are_turned_as_their_photos_are(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x0112] = 6
    upright = np.zeros((80, 60), np.uint8)
    upright[:40] = 255
    for index in range(3):
        save(tmp_path / f"images/{index}.jpg", np.random.default_rng(index).integers(0, 255, (60, 80, 3), dtype=np.uint8), exif=tags)
    for name, mask in (("seen", upright), ("stored", np.rot90(upright))):
        for index in range(3):
            save(tmp_path / f"masks/{index}.png", np.ascontiguousarray(mask))
        frame = open_capture(tmp_path).frames[0]
        np.testing.assert_array_equal(load_mask(frame, exif=True), upright > 0, err_msg=name)


def test_masks_that_leave_everything_are_dropped_and_missing_ones_said(tmp_path: Path) -> None:
    photos(tmp_path, [f"images/{index}.jpg" for index in range(4)])
    for index in range(3):
        save(tmp_path / f"masks/{index}.png", np.full((60, 80), 255, np.uint8))
    capture = open_capture(tmp_path)
    assert kept(capture) == [1.0] * 4 and not any("mask" in warning for warning in capture.warnings)
    save(tmp_path / "masks/1.png", half())
    capture = open_capture(tmp_path)
    assert kept(capture) == [1.0, 0.5, 1.0, 1.0]
    assert "3 of 4 images have a mask" in capture.warnings[0] and "images without one are used whole" in capture.warnings[0]


def test_masks_that_leave_nothing_are_refused_and_those_that_leave_little_remarked(tmp_path: Path) -> None:
    photos(tmp_path, [f"images/{index}.jpg" for index in range(4)])
    for index in range(4):
        save(tmp_path / f"masks/{index}.png", half(left=0))
    with pytest.raises(InputError, match=r"leave nothing of any image .*capture.masks=inverted"):
        open_capture(tmp_path)
    assert kept(open_capture(tmp_path, "off")) == [1.0] * 4
    assert kept(open_capture(tmp_path, "inverted")) == [1.0] * 4
    for index in range(3):
        save(tmp_path / f"masks/{index}.png", half(left=4))
    capture = open_capture(tmp_path)
    assert kept(capture) == [0.05] * 3 and [frame.name for frame in capture.frames] == ["0", "1", "2"]
    assert any("1 image of which the masks leave nothing is not used" in warning for warning in capture.warnings)
    assert any("leave less than 10%" in warning and "capture.masks=inverted" in warning for warning in capture.warnings)
    assert kept(open_capture(tmp_path, "inverted")) == [0.95] * 3 + [1.0]


def test_bad_masks_do_not_stop_good_ones(tmp_path: Path) -> None:
    photos(tmp_path, [f"images/{index}.jpg" for index in range(5)])
    for index in range(5):
        save(tmp_path / f"masks/{index}.png", half())
    (tmp_path / "masks/0.png").write_bytes(b"not an image")
    good = (tmp_path / "masks/1.png").read_bytes()
    (tmp_path / "masks/1.png").write_bytes(good[: len(good) // 2])
    save(tmp_path / "masks/2.png", half(60, 60, 30))
    capture = open_capture(tmp_path)
    assert kept(capture) == [1.0, 1.0, 1.0, 0.5, 0.5]
    text = " | ".join(capture.warnings)
    assert "1 mask is of another shape than their image (of 2)" in text and "no images that can be read (of 0)" in text
    assert "cannot be read (of 1)" in text


def test_masks_whose_names_fit_nothing_are_said(tmp_path: Path) -> None:
    photos(tmp_path, [f"images/{name}.jpg" for name in ("a", "b", "c")])
    for index in range(3):
        save(tmp_path / f"masks/{'xyz'[index]}.png", half())
    capture = open_capture(tmp_path)
    assert kept(capture) == [1.0] * 3 and "the masks in masks/ are not used: their names fit no image" in capture.warnings
    photos(tmp_path, [f"masks/{name}.jpg" for name in ("a", "b", "c")])
    for index in range(3):
        (tmp_path / f"masks/{'xyz'[index]}.png").unlink()
    assert any("neither black and white" in warning for warning in open_capture(tmp_path).warnings)


def test_masks_by_number_and_the_folder_of_the_same_size(tmp_path: Path) -> None:
    photos(tmp_path, [f"images/frame_{index:05d}.jpg" for index in (1, 2, 10)])
    for index in (1, 2, 10):
        save(tmp_path / f"masks/mask_{index:03d}.png", half())
        save(tmp_path / f"masks_2/mask_{index:03d}.png", half(40, 30, 10))
    capture = open_capture(tmp_path)
    assert [frame.mask for frame in capture.frames] == [tmp_path.resolve() / f"masks/mask_{index:03d}.png" for index in (1, 2, 10)]
    assert any("masks_2/ are not used: other masks are" in warning for warning in capture.warnings)


def test_a_linked_folder_of_masks_outside_is_not_read(tmp_path: Path) -> None:
    photos(tmp_path, [f"capture/images/{index}.jpg" for index in range(3)])
    for index in range(3):
        save(tmp_path / f"elsewhere/{index}.png", half())
    (tmp_path / "capture/masks").symlink_to(tmp_path / "elsewhere")
    assert kept(open_capture(tmp_path / "capture")) == [1.0] * 3
    (tmp_path / "capture/masks").unlink()
    save(tmp_path / "capture/masks/1.png", half())
    (tmp_path / "capture/masks/2.png").symlink_to(tmp_path / "elsewhere/2.png")
    assert kept(open_capture(tmp_path / "capture")) == [1.0, 0.5, 1.0]
    save(tmp_path / "capture/masks/1.png", half(left=0))
    assert [frame.name for frame in open_capture(tmp_path / "capture").frames] == ["0", "2"], "nothing of it is to be used"


def test_masks_of_images_that_are_cut_out_are_their_alpha(tmp_path: Path) -> None:
    write_llff(tmp_path)
    for frame in open_capture(tmp_path).frames:
        picture = np.array(Image.open(frame.image).convert("RGB"))
        picture[:, 40:] = 255
        save(frame.image, picture)
        save(tmp_path / f"masks/{frame.image.stem}.png", half(40, 30, 20))
    capture = open_capture(tmp_path)
    assert capture.alpha and any("cut out on white already" in warning for warning in capture.warnings)
    views = prepare_views(capture_from_dict(json.loads(json.dumps(capture_to_dict(capture)))), SAME, CaptureSettings(image_size=80))
    assert views.valid == [None] * len(views) and views.background == (1.0, 1.0, 1.0)
    assert all(alpha is not None and (alpha[:, :38] == 255).all() and (alpha[:, 42:] == 0).all() for alpha in views.alpha)


def test_no_point_is_triangulated_from_what_masks_leave_out(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    bare = open_capture(tmp_path)
    for frame in bare.frames:
        save(tmp_path / f"masks/{frame.image.stem}.png", half(left=8))
    assert len(triangulate(bare).points) > len(triangulate(open_capture(tmp_path)).points)


def test_real_masks() -> None:
    cape = open_capture(shared_data("zoo/gold-cape"))
    assert sum(frame.mask is not None for frame in cape.frames) == 64 and not cape.alpha
    assert 0.4 < np.mean(kept(cape)[::16]) < 0.6
    carton = open_capture(shared_data("zoo/milk-carton"))
    assert carton.alpha and all(frame.mask_is_alpha for frame in carton.frames)
