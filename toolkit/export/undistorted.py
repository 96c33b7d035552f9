"""A folder of pinhole images with cameras, from which nerfstudio, COLMAP and programs for Gaussian splats start as it is."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.headers import image_header, orientation_of
from fieldfuse.capture.prepare import undistorted
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.export.cameras import POINTS, transforms, write_colmap, write_colmap_binary
from fieldfuse.export.ply import write_points
from fieldfuse.files import atomic_path, remove, write_json
from fieldfuse.progress import SILENT, Progress

QUALITY = 97  # of JPEG
LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
IMAGES, MASKS, MODEL = "images", "masks", "sparse/0"
SAME = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]  # nerfstudio's `applied_transform`: none


def write_undistorted(
    folder: Path, posed: Capture, points: Array, colours: Array, test: Array | None = None, progress: Progress = SILENT
) -> list[Path]:
    """Write `folder/images`, `transforms.json` with `points3D.ply` (nerfstudio), and `sparse/0` as text and binary (COLMAP, 3DGS).

    Images are as large as they were taken, upright and without their lens, under names without folders and spaces: JPEG, or PNG where
    they have alpha or were stored without loss. An image that has no lens is copied. Where pixels are masked out, or show nothing since
    the lens bends them out of the image, `masks/NAME.png` is 0 there and 255 elsewhere; then there is one for each image.

    Args:
        posed: frames with intrinsics and poses.
        points, colours: (P, 3) to start from, in the frame of the poses, and their colours as uint8.
        test: (N,) bool, frames that nerfstudio holds out; None: it chooses.

    Returns:
        all files.

    Raises:
        InputError: an image cannot be read.
        OutputError: a file cannot be written.
        Interrupted: the user asked to stop.
    """
    with atomic_path(folder) as temporary:  # half of it is nothing to start from
        _write(temporary, posed, (points, colours), test, progress)
        remove(folder)
    return [path for path in sorted(folder.rglob("*")) if path.is_file()]


def _write(folder: Path, posed: Capture, sparse: tuple[Array, Array], test: Array | None, progress: Progress) -> None:
    names, cameras, masks, partial = file_names(posed), [], [], False
    for index, (camera, image, usable) in enumerate(undistorted(posed)):
        progress.check()
        progress.update(index, len(names), "undistorted images")
        _write_image(folder / IMAGES / names[index], posed.frames[index], camera, image)
        cameras.append(camera)
        # As PNG in memory, since it shows only at the end whether there are to be masks.
        masks.append(cv2.imencode(".png", usable.astype(np.uint8) * 255)[1])
        partial = partial or not usable.all()
    poses = np.array([frame.world_from_camera for frame in posed.frames], dtype=np.float64)
    files = [f"{IMAGES}/{name}" for name in names]
    data = {**transforms(files, cameras, poses), "applied_transform": SAME, "ply_file_path": POINTS}
    for mask, name, frame in zip(masks if partial else (), names, data["frames"], strict=False):
        frame["mask_path"] = f"{MASKS}/{name}.png"
        with atomic_path(folder / MASKS / f"{name}.png") as temporary:
            temporary.write_bytes(mask.tobytes())
    if test is not None and test.any() and not test.all():
        held = [file for file, one in zip(files, test, strict=True) if one]
        data |= {"train_filenames": [file for file in files if file not in set(held)], "val_filenames": held, "test_filenames": held}
    write_points(folder / POINTS, *sparse)
    write_colmap(folder / MODEL, names, cameras, poses, *sparse)
    write_colmap_binary(folder / MODEL, names, cameras, poses, *sparse)
    write_json(folder / "transforms.json", data)


def file_names(posed: Capture) -> list[str]:
    """A file's name for each frame, without folders, spaces and dots in it: programs cut names at any of these."""
    names: dict[str, str] = {}  # lower case → as written
    for frame in posed.frames:
        stem = re.sub(r"[^\w-]+", "_", frame.name).strip("_") or "image"
        end = ".png" if posed.alpha or frame.image.suffix.lower() in LOSSLESS else ".jpg"
        name, count = stem + end, 1
        while name.lower() in names:
            name, count = f"{stem}_{count}{end}", count + 1
        names[name.lower()] = name
    return list(names.values())


def _write_image(path: Path, frame: Frame, camera: Intrinsics, image: Array) -> None:
    with atomic_path(path) as temporary:
        if path.suffix == ".jpg" and _is_as_wanted(frame, camera):
            shutil.copyfile(frame.image, temporary)
            return
        order = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if path.suffix == ".jpg" else []
        temporary.write_bytes(cv2.imencode(path.suffix, cv2.cvtColor(image, order), options)[1].tobytes())


def _is_as_wanted(frame: Frame, camera: Intrinsics) -> bool:
    """Whether a frame's file is the image that `camera` takes: a JPEG in usual colours, without a lens, upright."""
    if frame.video_index is not None or frame.intrinsics is None or frame.intrinsics.distorted:
        return False
    header = image_header(frame.image)
    plain = header.format == "JPEG" and header.profile is None and orientation_of(frame.image) == 1
    return plain and header.size == (camera.width, camera.height)
