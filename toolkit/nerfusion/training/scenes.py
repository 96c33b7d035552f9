"""Training scenes on disk: shards drawn ahead of time, posed captures, and the data sets that the paper trains on, as their sites publish
them (a list of training scenes beside them, where there is one, chooses among them).

A shard is a safetensors file of one scene, from which frames are read one by one: `images` (N, 3, H, W) uint8, `depths` (N, H, W) float32
along z with 0 = nothing, `intrinsics` (N, 4) float32 (fx, fy, cx, cy; pixel centres at +0.5) and `world_from_camera` (N, 4, 4) float64;
kind and order stand in the metadata.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from fieldfuse.camera import Array, Intrinsics, Similarity, invert
from fieldfuse.capture.blender import looks_like_blender, read_blender
from fieldfuse.capture.calibration import from_matrix
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, files_in, images_in, natural_key, read_matrix, read_text, require_folder, same_count
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.prepare import WHITE, prepare_views
from fieldfuse.capture.scannet import looks_exported, packed, read_scannet
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.poses.overlap import guessed_depth

FORMAT = "fieldfuse-shard-1"
CACHED = 48  # decoded frames of a capture
MILLIMETRES = 1 / 200  # a unit of ours is 200 of DTU's
FULL, CROP = (1600, 1200), (80, 44)  # size of DTU's originals; where the 640×512 image begins in the halved original
RECTIFIED = re.compile(r"rect_([0-9]{3})_([0-9])_r5000$")


class CapturedScene:
    """A posed capture as a training scene.

    Args:
        capture: every frame with pose and intrinsics.
        kind: "object" or "room".
        long_side: images are brought to it, never enlarged.
        scale: one unit of the capture in the unit that samples shall have.
        depth_hint: typical depth in the sample's unit; None: from the depth images, or where the optical axes meet.
        background: colour where rays meet nothing, of images that show it without alpha; None: white where the capture has alpha, else
            every ray meets something.

    Raises:
        InputError: a frame without pose or intrinsics.
    """

    def __init__(
        self,
        capture: Capture,
        kind: str,
        long_side: int,
        scale: float = 1.0,
        depth_hint: float | None = None,
        background: tuple[float, float, float] | None = None,
    ) -> None:
        if not capture.posed:
            raise InputError(f"{capture.root}: not every frame has a pose and intrinsics; training needs both")
        self.capture, self.kind, self.ordered, self.name = capture, kind, capture.ordered, capture.root.name
        self._background = WHITE if background is None and capture.alpha else background
        self._scale = Similarity(scale, np.eye(3), np.zeros(3))
        self._settings = CaptureSettings(image_size=long_side, holdout=0)
        poses = np.array([frame.world_from_camera for frame in capture.frames], dtype=np.float64)
        self.world_from_camera = self._scale.poses(poses)
        self.depth_hint: float | None = depth_hint if depth_hint is not None else guessed_depth(self.world_from_camera)
        self._read = lru_cache(maxsize=CACHED)(self._read_one)

    def _read_one(self, index: int) -> tuple[torch.Tensor, Intrinsics, Array | None]:
        views = prepare_views(self.capture.with_frames((self.capture.frames[index],)), self._scale, self._settings)
        return torch.from_numpy(views.images[0]), views.intrinsics[0], views.depths[0] if views.depths else None

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`.

        Raises:
            InputError: a file cannot be read, or the images differ in size.
        """
        images, cameras, depths = zip(*(self._read(int(index)) for index in indices), strict=True)
        if len({image.shape for image in images}) != 1:
            raise InputError(f"the images of {self.capture.root} differ in size; training needs one size a scene")
        return Pictures.of(images, cameras, self.world_from_camera[list(indices)], depths, self._background)


def write_shard(
    path: Path | str, images: Array, depths: Array, intrinsics: Array, world_from_camera: Array, *, kind: str, ordered: bool
) -> None:
    """Write one scene; see the module for shapes.

    Raises:
        OutputError: it cannot be written.
        ValueError: the arrays do not belong together.
    """
    count, _, height, width = images.shape
    if depths.shape != (count, height, width) or intrinsics.shape != (count, 4) or world_from_camera.shape != (count, 4, 4):
        raise ValueError("images, depths, cameras and poses of a shard must have as many entries and one size")
    given: dict[str, tuple[Array, Any]] = {"images": (images, np.uint8), "depths": (depths, np.float32)}
    given |= {"intrinsics": (intrinsics, np.float32), "world_from_camera": (world_from_camera, np.float64)}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values, dtype=dtype)) for name, (values, dtype) in given.items()}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"format": FORMAT, "kind": kind, "ordered": str(int(ordered))})


def shard_files(root: Path | str) -> list[Path]:
    """All shards in a folder.

    Raises:
        InputError: there is none.
    """
    found = sorted(Path(root).glob("*.safetensors"))
    if not found:
        raise InputError(f"{root} holds no shards (*.safetensors); make them with python -m benchmarks.make_shards, see docs/training.md")
    return found


class ShardScene:
    """One shard as a training scene; images are averaged down to `long_side`, never enlarged.

    Raises:
        InputError: not a shard.
    """

    depth_hint: float | None = None

    def __init__(self, path: Path, long_side: int) -> None:
        self.path, self.name, self._long_side = path, path.stem, long_side
        try:
            with safe_open(path, "pt") as file:
                meta = file.metadata() or {}
                if meta.get("format") != FORMAT:
                    raise ValueError(f"its format is {meta.get('format')!r}")
                self.kind, self.ordered = meta["kind"], meta["ordered"] == "1"
                self._intrinsics = file.get_tensor("intrinsics")
                poses = file.get_tensor("world_from_camera").numpy()
                images, depths = file.get_slice("images"), file.get_slice("depths")
                shape, kinds = images.get_shape(), (images.get_dtype(), depths.get_dtype())
                if len(shape) != 4 or shape[1] != 3 or depths.get_shape() != [shape[0], *shape[2:]]:
                    raise ValueError("its arrays do not belong together")
            if kinds != ("U8", "F32"):
                raise ValueError(f"its images and depths have the types {kinds}")
            if self._intrinsics.shape != (shape[0], 4) or len(poses) != shape[0] or not bool(torch.isfinite(self._intrinsics).all()):
                raise ValueError("its cameras are not usable")
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            raise InputError(f"{path} is not a shard of training images ({first_line(error)}); make it again") from error
        self.world_from_camera = np.stack([checked_pose(pose, f"pose {i} of {path}") for i, pose in enumerate(poses)])

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`."""
        with safe_open(self.path, "pt") as file:
            stored, depth = file.get_slice("images"), file.get_slice("depths")
            images = torch.cat([stored[i : i + 1] for i in indices]).float() / 255
            depths = torch.cat([depth[i : i + 1] for i in indices])
        intrinsics = self._intrinsics[list(indices)]
        height, width = images.shape[2:]
        factor = min(1.0, self._long_side / max(height, width))
        if factor < 1:
            size = max(8, round(height * factor)), max(8, round(width * factor))
            images = F.interpolate(images, size, mode="area")
            depths = F.interpolate(depths[:, None], size, mode="nearest-exact")[:, 0]
            x, y = size[1] / width, size[0] / height
            intrinsics = intrinsics * torch.tensor([x, y, x, y])
        return Pictures(images, intrinsics, torch.from_numpy(self.world_from_camera[list(indices)].astype(np.float32)), depths)


# Published data sets ---------------------------------------------------------------------------------------------------------------------


def _scene_folders(root: Path | str, is_scene: Callable[[Path], bool], what: str, inside: tuple[str, ...] = ()) -> list[Path]:
    """Folders of scenes directly in `root`, or in the first of its subfolders `inside` that has any; `root` itself when it is one."""
    root = require_folder(root)
    if is_scene(root):
        return [root]
    for place in (root, *(root / name for name in inside)):
        if place.is_dir():
            found = sorted((path for path in place.iterdir() if path.is_dir() and is_scene(path)), key=lambda path: natural_key(path.name))
            if found:
                return found
    raise InputError(f"{root} holds no scene of {what}; give the folder that holds the scenes, see docs/training.md")


def _listed(root: Path, *names: str) -> set[str] | None:
    """The words of the first list file of `names` that `root` has; None when it has none."""
    return next((set(read_text(root / name).split()) for name in names if (root / name).is_file()), None)


def synthetic_folders(root: Path | str) -> list[Path]:
    """NeRF-synthetic: `<scene>/transforms_train.json` and images with alpha. The scenes under `root`.

    Raises:
        InputError: there is none; of the finders below, too.
    """
    return _scene_folders(root, looks_like_blender, "NeRF-synthetic", inside=("nerf_synthetic",))


def synthetic_scene(folder: Path, long_side: int) -> CapturedScene:
    """The training split of one scene, objects with white behind them; its test images are never read.

    Raises:
        InputError: it cannot be read; of the readers below, too.
    """
    capture = read_blender(folder)
    return CapturedScene(capture.with_frames([frame for frame in capture.frames if frame.split != "test"]), "object", long_side)


def scannet_folders(root: Path | str) -> list[Path]:
    """ScanNet: `scans/scene0000_00/scene0000_00.sens` as the site publishes it, or `{color,depth,pose,intrinsic}` as its exporter writes
    them. The scenes under `root`, of `scannetv2_train.txt` where that is there."""
    folders = _scene_folders(root, lambda path: looks_exported(path) or bool(packed(path)), "ScanNet", inside=("scans", "scans_train"))
    wanted = _listed(Path(root), "scannetv2_train.txt", "train.txt")
    chosen = folders if wanted is None else [path for path in folders if path.name in wanted]
    if not chosen:
        raise InputError(f"none of the scenes that the list in {root} names is there; export them or remove the list")
    return chosen


def scannet_scene(folder: Path, long_side: int) -> CapturedScene:
    """One scan: video of a room with depth, metres."""
    return CapturedScene(read_scannet(folder), "room", long_side)


def scanned_object_folders(root: Path | str) -> list[Path]:
    """Google Scanned Objects as rendered by IBRNet: `<object>/{rgb,pose,intrinsics}/NNN.{png,txt}`. The objects under `root`."""

    def is_scene(path: Path) -> bool:
        return all((path / name).is_dir() for name in ("rgb", "pose", "intrinsics"))

    return _scene_folders(root, is_scene, "Google Scanned Objects as IBRNet renders them", inside=("google_scanned_objects",))


def scanned_object_scene(folder: Path, long_side: int) -> CapturedScene:
    """One object before white. Poses are world_from_camera in OpenCV axes, cameras 4×4 matrices, one text file an image. Images are opaque;
    all look at the origin, where the object is, so the distance from there is the depth."""
    root = require_folder(folder)
    pictures = images_in(root / "rgb")
    same_count(len(pictures), len(files_in(root / "pose", "*.txt")), root)
    frames, alpha, distances = [], 0, []
    for picture in pictures:
        pose, camera = root / "pose" / f"{picture.stem}.txt", root / "intrinsics" / f"{picture.stem}.txt"
        for file in (pose, camera):
            if not file.is_file():
                raise InputError(f"{picture} has no {file}; add it or remove the picture")
        header = image_header(picture)
        alpha += header.alpha
        intrinsics = from_matrix(read_matrix(camera, (4, 4), (3, 3))[:3, :3], *header.size, str(camera))
        world_from_camera = checked_pose(read_matrix(pose, (4, 4)), str(pose))
        distances.append(float(np.linalg.norm(world_from_camera[:3, 3])))
        frames.append(Frame(name=picture.stem, image=picture, intrinsics=intrinsics, world_from_camera=world_from_camera))
    capture = assemble("scanned_objects", root, frames, alpha=0 < alpha == len(frames))
    return CapturedScene(capture, "object", long_side, depth_hint=float(np.median(distances)), background=WHITE)


@dataclass(frozen=True)
class DtuScene:
    """One scan of DTU under one of seven lights, as MVSNet rectified it for training: `Cameras/train/NNNNNNNN_cam.txt`,
    `Rectified/scanS_train/rect_VVV_L_r5000.png`, `Depths/…`, in millimetres.

    Camera files hold the world-to-camera matrix and K for the image at a quarter of its 640×512; view numbers count from 1 in image names
    and from 0 in camera and depth names; L is the light. Depth maps come at 160×128 (MVSNet's archive) or as the 1600×1200 originals, of
    which the images are the halved middle.
    """

    root: Path
    scan: str
    light: int

    def places(self, part: str) -> tuple[Path, Path]:
        """Folders that `part` of the archive may hold for the scan."""
        return self.root / part / f"{self.scan}_train", self.root / part / self.scan


def dtu_scenes(root: Path | str) -> list[DtuScene]:
    """Every scan and light under `root` (or its `dtu/`, `mvs_training/dtu/`), of `train.txt` there where there is one."""
    given = require_folder(root)
    places = (given, given / "dtu", given / "mvs_training" / "dtu")
    place = next((path for path in places if (path / "Rectified").is_dir() and (path / "Cameras").is_dir()), None)
    if place is None:
        raise InputError(f"{given} holds no Rectified/ and Cameras/ folders of DTU; give the folder that holds both, see docs/training.md")
    wanted = _listed(place, "train.txt", "dtu_train_all.txt")
    found = []
    for folder in sorted((place / "Rectified").iterdir(), key=lambda path: natural_key(path.name)):
        scan = folder.name.removesuffix("_train")
        if folder.is_dir() and (wanted is None or scan in wanted):
            lights = sorted({int(match[2]) for path in folder.glob("rect_*.png") if (match := RECTIFIED.match(path.stem))})
            found += [DtuScene(place, scan, light) for light in lights]
    if not found:
        raise InputError(f"{place / 'Rectified'} holds no images rect_001_0_r5000.png of a wanted scan; check how it was unpacked")
    return found


def dtu_scene(scene: DtuScene, long_side: int) -> CapturedScene:
    """One scan under one light, in units of 200 mm."""
    folder = next(path for path in scene.places("Rectified") if path.is_dir())
    cameras = next(path for path in (scene.root / "Cameras" / "train", scene.root / "Cameras") if path.is_dir())
    frames = []
    for picture in folder.glob("rect_*.png"):
        match = RECTIFIED.match(picture.stem)
        if match is None or int(match[2]) != scene.light:
            continue
        view = int(match[1]) - 1
        pose, intrinsics = _dtu_camera(cameras / f"{view:08d}_cam.txt", image_header(picture).size)
        depth = next((path for base in scene.places("Depths") if (path := base / f"depth_map_{view:04d}.pfm").is_file()), None)
        of_depth = None if depth is None else _dtu_depth_camera(intrinsics, depth)
        frames.append(Frame(f"{view:04d}", picture, intrinsics, pose, depth=depth, depth_intrinsics=of_depth))
    return CapturedScene(assemble("dtu", folder, frames, depth_scale=1.0), "object", long_side, scale=MILLIMETRES)


def _dtu_camera(path: Path, size: tuple[int, int]) -> tuple[Array, Intrinsics]:
    """Pose and camera of an image of `size` from MVSNet's file, whose K is for a quarter of the image or for the image itself, as its
    principal point shows. K is that of the 1600×1200 originals, whose pixel centres are whole numbers, halved and cropped: half a pixel
    there is a quarter of one here."""
    words = read_text(path).split()
    try:
        start, middle = words.index("extrinsic"), words.index("intrinsic")
        camera_from_world = np.array([float(word) for word in words[start + 1 : start + 17]]).reshape(4, 4)
        matrix = np.array([float(word) for word in words[middle + 1 : middle + 10]]).reshape(3, 3)
    except ValueError as error:
        raise InputError(f"{path} is not a camera file of MVSNet ({first_line(error)}); unpack it again") from error
    pose = invert(checked_pose(camera_from_world, str(path)))
    quarter = abs(2 * 4 * matrix[0, 2] / size[0] - 1) < abs(2 * matrix[0, 2] / size[0] - 1)
    scaled = matrix * np.array([[4.0], [4.0], [1.0]]) if quarter else matrix
    return pose, from_matrix(scaled, *size, str(path), shift=0.25 if quarter else 0.5)


def _dtu_depth_camera(image: Intrinsics, path: Path) -> Intrinsics:
    size = image_header(path).size
    if size == FULL:
        return Intrinsics(*FULL, 2 * image.fx, 2 * image.fy, 2 * (image.cx + CROP[0]), 2 * (image.cy + CROP[1]))
    if size[0] * image.height != size[1] * image.width:
        raise InputError(f"{path} is {size[0]}×{size[1]}, neither 1600×1200 nor of the image's shape; unpack it again")
    return image.scaled(*size)
