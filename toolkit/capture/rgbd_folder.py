"""RGB-D frames in folders of no published layout: a folder of colour images, one of depth maps, a list of poses, a file with the camera.

Poses are camera-to-world in OpenCV axes: a 4×4 or 3×4 matrix in each row (16 or 12 numbers), 4×4 blocks, one matrix a file, or TUM's
`time tx ty tz qx qy qz qw` with or without the time. They belong to images by name, by time, by number, or row by row. The camera is a
3×3 or 4×4 matrix, `fx fy cx cy`, ORB-SLAM's or OpenCV's yaml, or json. Depth is divided by `DepthMapFactor` (or `depth_scale`) where
the camera's file has it; floating-point depth is in the poses' unit; else the unit is the one that fits the poses.

Without a list of poses, but with a camera and depth that is no picture of depth (16 bits, or floating-point), poses are found from the
images.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldfuse.camera import OPENCV, Array, Intrinsics
from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.calibration import fitted, from_matrix, posed_frame, sensor, usable_size
from fieldfuse.capture.depth_checks import Sample, unit_factor
from fieldfuse.capture.headers import image_size, read_header
from fieldfuse.capture.images import load_depth, spread
from fieldfuse.capture.listing import (
    IMAGES,
    assemble,
    counted,
    files_in,
    images_in,
    natural_key,
    read_text,
    require_folder,
    unique_names,
    words_of,
)
from fieldfuse.capture.masks import is_mask_folder
from fieldfuse.capture.poses import rigid
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

DEPTH_WORDS, COLOUR_WORDS = {"depth", "depths"}, {"rgb", "color", "colors", "colour", "colours", "image", "images", "img", "imgs", "frames"}
NO_COLOUR = {*DEPTH_WORDS, "normal", "normals", "confidence", "conf", "semantic", "label", "labels", "instance", "vis"}
POSE_WORDS = {"pose", "poses", "traj", "trajectory", "groundtruth", "gt", "extrinsics", "extrinsic", "odometry", "camera", "cam", "cameras"}
CAMERA_WORDS = {"intrinsic", "intrinsics", "camera", "cam", "calib", "calibration", "k"}
DEPTH_FILES = (*IMAGES, ".npy", ".pfm", ".pgm")
POSE_FILES = ("*.txt", "*.log", "*.csv", "*.tum")
CAMERA_FILES = ("*.yaml", "*.yml", "*.json", "*.txt", "*.cfg")
NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
WORD = re.compile(rf"{NUMBER.pattern}|[-+]?(?:nan|inf|infinity)", re.IGNORECASE)  # of a pose
MOST_CAMERA = 2**18  # bytes of a file that holds a camera
NEAR = 0.03  # seconds between an image and its pose or depth
MILLIMETRES = 1000.0
LOOKED_AT = 12  # depth maps that the unit is found by
MOST_FOLDERS = 200
DEPTH_FACTORS = ("depthmapfactor", "depth_scale", "depth_factor", "png_depth_scale")
LENS = ("fx", "fy", "cx", "cy")
VALUE = re.compile(r"""\b([A-Za-z_][\w.]{0,60})["']?[ \t]{0,20}[:=]\s{0,99}(\[[^\]]{0,2000}\]|[-+.0-9eE]{1,40})""")


@dataclass(frozen=True)
class _Poses:
    file: Path
    matrices: Array  # (N, 4, 4) float64
    keys: list[str]  # what stands before each: a time, a number or a name; empty: nothing


@dataclass(frozen=True)
class _Layout:
    colour: Path
    depth: Path
    poses: _Poses | None  # None: a camera is there


def looks_like_rgbd(path: Path) -> bool:
    try:
        return _layout(path) is not None
    except InputError:
        return False


def read_rgbd(path: Path | str) -> Capture:
    """Frames that have a pose (all without a list of poses); depth where there is some of an image's name, number or time.

    Raises:
        InputError: no such folders, no camera, or names and numbers of poses that do not fit the images.
    """
    root = require_folder(path)
    layout = _layout(root)
    if layout is None:
        raise InputError(f"{root} must hold a folder of colour images, one of depth maps (depth/) and a list of poses")
    images = images_in(layout.colour)
    depths = _depths_of(images, images_in(layout.depth, DEPTH_FILES), root)
    camera, scale, source = _camera(root, layout, image_size(images[0], images))
    if layout.poses is None:
        return _unposed(root, layout, images, depths, (camera, scale, source))
    poses = _poses_of(images, layout.poses, root)
    frames = []
    for index, (image, name) in enumerate(zip(images, unique_names(images), strict=True)):
        if index in poses and np.isfinite(poses[index]).all():
            where = f"{layout.poses.file}, the pose of {image.name}"
            frames.append(posed_frame(name, image, camera, poses[index], where, depths.get(index)))
    places = f"{layout.colour.relative_to(root)}/, {layout.depth.relative_to(root)}/, {layout.poses.file.relative_to(root)} and {source}"
    warnings = [f"read as RGB-D from {places}; poses are taken as camera-to-world"]
    if len(frames) < len(images):
        warnings.append(f"{len(images) - len(frames)} of {counted(len(images), 'image')} have no (finite) pose and are not used")
    capture = assemble("rgbd", root, frames, warnings, ordered=True, metric=scale is not None, depth_scale=scale or 1.0, alpha=False)
    return capture if scale is not None else _in_own_unit(capture)


def _unposed(
    root: Path, layout: _Layout, images: Sequence[Path], depths: Mapping[int, Path], found: tuple[Intrinsics, float | None, str]
) -> Capture:
    """The capture of a folder without a list of poses; `found`: camera, stored depth values for each metre, and the file that has them."""
    camera, scale, source = found
    frames = []
    for index, (image, name) in enumerate(zip(images, unique_names(images), strict=True)):
        posed = posed_frame(name, image, camera, np.eye(4), str(image), depths.get(index))
        frames.append(replace(posed, world_from_camera=None, focal_prior=camera.fx))
    places = f"{layout.colour.relative_to(root)}/, {layout.depth.relative_to(root)}/ and {source}"
    remarks = [f"read as RGB-D from {places}; there is no list of poses, and they are found from the images"]
    capture = assemble("rgbd", root, frames, remarks, metric=True, depth_scale=scale or 1.0, alpha=False)
    return capture if scale is not None else _in_own_unit(capture)


def unused_depth(root: Path) -> list[str]:
    """A sentence on depth maps of a folder that is read as photos since it has no camera, and on what would make them of use."""
    try:
        colour, depth, _ = next(_pairs_of_folders(root), (None, None, None))
    except OSError:
        return []
    if colour is None or depth is None or not _holds_depth(depth):
        return []
    width, height = image_size(images_in(colour)[0])
    file = "intrinsics.json"
    example = f'{{"width": {width}, "height": {height}, "fx": …, "fy": …, "cx": …, "cy": …}}'
    return [
        f"depth maps in {depth.relative_to(root).as_posix()}/ are not used, since no file has the camera's intrinsics (fx, fy, cx, cy in "
        f'pixels of the images); write them to {file} ({example}, and "depth_scale": stored values for each metre, if not 1000)'
    ]


# ------------------------------------------------------------------------------------------------ what lies where


def _folders(root: Path) -> list[Path]:
    """Folders at most two down, those higher up first; links are not followed."""
    out = [root]
    for base in out:
        if len(base.relative_to(root).parts) < 2 and len(out) < MOST_FOLDERS:
            children = [child for child in base.iterdir() if child.is_dir() and not child.is_symlink() and not child.name.startswith(".")]
            out += sorted(children, key=lambda child: natural_key(child.name))
    return out[1:MOST_FOLDERS]


def _pairs_of_folders(root: Path) -> Iterator[tuple[Path, Path, list[Path]]]:
    """Folders of colour images and of depth maps that lie side by side, and all folders there."""
    everything = _folders(root)
    folders = [folder for folder in everything if not is_mask_folder(folder.name)]
    for depth in folders:
        if not words_of(depth.name) & DEPTH_WORDS or len(images_in(depth, DEPTH_FILES)) < 2:
            continue
        beside = [folder for folder in everything if folder.parent == depth.parent and not words_of(folder.name) & NO_COLOUR]
        ranked = sorted(
            (folder for folder in beside if folder in folders and len(images_in(folder)) > 1),
            key=lambda folder: (not words_of(folder.name) & COLOUR_WORDS, -len(images_in(folder))),
        )
        if ranked:
            yield ranked[0], depth, beside


def _layout(root: Path) -> _Layout | None:
    pairs = list(_pairs_of_folders(root))
    for colour, depth, beside in pairs:
        poses = _find_poses([depth.parent, root], beside)
        if poses is not None:
            return _Layout(colour, depth, poses)
    named = [_Layout(colour, depth, None) for colour, depth, _ in pairs if words_of(colour.name) & COLOUR_WORDS]
    return next((one for one in named if _holds_depth(one.depth) and any(map(_values, _camera_files(root, one)))), None)


def _holds_depth(folder: Path) -> bool:
    """Whether maps are depth, and not pictures of it."""
    first = images_in(folder, DEPTH_FILES)[0]
    try:
        return first.suffix.lower() in (".npy", ".pfm", ".exr") or read_header(read_bytes(first), first).deep
    except InputError:
        return False


def _find_poses(places: Sequence[Path], folders: Sequence[Path]) -> _Poses | None:
    """The first list of poses among files named so, or the folder of one matrix a file."""
    for place in dict.fromkeys(places):
        named = {file for pattern in POSE_FILES for file in files_in(place, pattern) if words_of(file.stem) & POSE_WORDS}
        for file in sorted(named, key=lambda file: (not words_of(file.stem) & {"pose", "poses"}, natural_key(file.name))):
            matrices, keys = _parse(file)
            if len(matrices) > 1:
                return _Poses(file, matrices, keys)
    for folder in folders:
        files = sorted(files_in(folder, "*.txt"), key=lambda file: natural_key(file.name))
        if words_of(folder.name) & POSE_WORDS and len(files) > 1:
            one = [_parse(file)[0] for file in files]
            if all(len(matrices) == 1 for matrices in one):
                return _Poses(folder, np.concatenate(one), [file.stem for file in files])
    return None


def _parse(file: Path) -> tuple[Array, list[str]]:
    """Poses of a text file as (N, 4, 4), and what stands before each; none where it holds something else."""
    none: tuple[Array, list[str]] = np.zeros((0, 4, 4)), []
    try:
        text = read_text(file)
    except InputError:
        return none
    rows: list[tuple[list[str], list[float]]] = []
    for line in text.splitlines():
        words = re.sub(r"[,;\[\]]", " ", line.split("#")[0]).split()
        if words:
            count = next((at for at, word in enumerate(reversed(words)) if not WORD.fullmatch(word)), len(words))
            rows.append((words[: len(words) - count], [float(word) for word in words[len(words) - count :]]))
    rows = rows[1:] if rows and not rows[0][1] else rows  # a table's heading
    if not rows or len({len(numbers) for _, numbers in rows}) != 1 or any(len(before) > 1 for before, _ in rows):
        return none
    table = np.array([numbers for _, numbers in rows], dtype=np.float64)
    width = table.shape[1]
    keys = [before[0] for before, _ in rows] if all(before for before, _ in rows) else []
    if width == 4 and not keys and len(table) % 4 == 0:
        return _by_rows(table.reshape(-1, 4, 4)), []
    if width in (8, 13, 17) and not keys:
        keys, table, width = [repr(float(value)) for value in table[:, 0]], table[:, 1:], width - 1
    if width == 16:
        return _by_rows(table.reshape(-1, 4, 4)), keys
    out = np.full((len(table), 4, 4), np.nan)
    if width == 12:
        out[:, :3], out[:, 3] = table.reshape(-1, 3, 4), (0, 0, 0, 1)
        return out, keys
    if width == 7:
        for at in np.flatnonzero(np.isfinite(table).all(axis=1) & (np.abs(table[:, 3:]).max(axis=1) > 0)):
            out[at] = rigid(table[at, [6, 3, 4, 5]], table[at, :3], f"{file}, row {at + 1}")
        return out, keys
    return none


def _by_rows(matrices: Array) -> Array:
    """The matrices, of those written column by column transposed; none where they are no poses."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    for some in (matrices, matrices.transpose(0, 2, 1)):
        if finite.any() and np.allclose(some[finite, 3], [0, 0, 0, 1], atol=1e-6):
            return some
    return matrices[:0]


# ------------------------------------------------------------------------------------------------ what belongs together


def _numbers(paths: Sequence[Path]) -> list[tuple[int, ...]] | None:
    """The numbers in each name that are not the same in all; None where they do not distinguish the files."""
    found = [tuple(int(number) for number in re.findall(r"[0-9]{1,18}", path.stem)) for path in paths]
    if len({len(numbers) for numbers in found}) != 1:
        return None
    differ = [at for at in range(len(found[0])) if len({numbers[at] for numbers in found}) > 1]
    out = [tuple(numbers[at] for at in differ) for numbers in found]
    return out if differ and len(set(out)) == len(out) else None


def _times(names: Sequence[str]) -> Array | None:
    try:
        out = np.array([float(name) for name in names])
    except ValueError:
        return None
    return out if np.isfinite(out).all() else None


def _nearest(wanted: Array, times: Array) -> dict[int, int]:
    """Index of a wanted time → that of the nearest time, where it is near enough."""
    order = np.argsort(times)
    between = (times[order][1:] + times[order][:-1]) / 2
    near = order[np.searchsorted(between, wanted)]
    return {index: int(at) for index, at in enumerate(near) if abs(times[at] - wanted[index]) <= NEAR}


def _pairs(images: Sequence[Path], others: Sequence[Path]) -> dict[int, int]:
    """Index of an image → that of the other file of its name, its number, or (names that are times) the nearest time; else empty."""
    stems = {other.stem: at for at, other in enumerate(others)}
    out = {index: stems[image.stem] for index, image in enumerate(images) if image.stem in stems}
    if out:
        return out
    mine, theirs = _times([image.stem for image in images]), _times([other.stem for other in others])
    if mine is not None and theirs is not None and ((mine % 1 != 0).any() or (theirs % 1 != 0).any()):
        return _nearest(mine, theirs)
    keys, other_keys = _numbers(images), _numbers(others)
    if keys is None or other_keys is None:
        return {}
    place = {key: at for at, key in enumerate(other_keys)}
    return {index: place[key] for index, key in enumerate(keys) if key in place}


def _depths_of(images: Sequence[Path], depths: Sequence[Path], root: Path) -> dict[int, Path]:
    pairs = _pairs(images, depths)
    if not pairs and len(images) == len(depths):
        pairs = {index: index for index in range(len(images))}
    if not pairs:
        raise InputError(
            f"{root}: the names of {counted(len(images), 'image')} ({images[0].name}, …) and {counted(len(depths), 'depth map')} "
            f"({depths[0].name}, …) do not fit each other; number both in the same way"
        )
    return {index: depths[at] for index, at in pairs.items()}


def _poses_of(images: Sequence[Path], poses: _Poses, root: Path) -> dict[int, Array]:
    """Index of an image → its pose: by name, by time or number, by row."""
    pairs: dict[int, int] = {}
    numbers = _numbers(images)
    single = [one[0] for one in numbers] if numbers is not None and len(numbers[0]) == 1 else None
    if poses.keys:
        mine, theirs = _times([image.stem for image in images]), _times(poses.keys)
        if theirs is None:
            pairs = _pairs(images, [Path(key.replace("\\", "/")) for key in poses.keys])
        elif mine is not None and (theirs % 1 != 0).any():
            pairs = _nearest(mine, theirs)
        elif single is not None and (theirs % 1 == 0).all():
            place = {int(key): at for at, key in enumerate(theirs)}
            pairs = {index: place[number] for index, number in enumerate(single) if number in place}
    if not pairs and len(images) == len(poses.matrices):
        pairs = {index: index for index in range(len(images))}
    if not pairs and not poses.keys and single is not None and max(single) < len(poses.matrices):
        pairs = dict(enumerate(single))  # every n-th frame of a longer list
    if not pairs:
        raise InputError(
            f"{root} holds {counted(len(images), 'image')} but {poses.file.name} {counted(len(poses.matrices), 'pose')}, and neither times "
            "nor numbers in the names show which belong together; give one pose for each image, in the images' order"
        )
    return {index: poses.matrices[at] for index, at in pairs.items()}


# ------------------------------------------------------------------------------------------------ camera and unit


def _camera(root: Path, layout: _Layout, size: tuple[int, int]) -> tuple[Intrinsics, float | None, str]:
    """The colour camera, stored depth values for each unit (None: not given), and the file that has them."""
    for file in _camera_files(root, layout):
        values = _values(file)
        if values:
            camera = _intrinsics(values, size, str(file))
            factor = next((values[key][0] for key in DEPTH_FACTORS if key in values), None)
            if factor is not None and not 0 < factor < 1e9:
                raise InputError(f"{file}: the depth factor is {factor:g}, it must be positive; correct it")
            return camera, factor, file.relative_to(root).as_posix()
    lists = "" if layout.poses is None else f" ({layout.poses.file.name})"
    raise InputError(
        f"{root} holds colour, depth and poses{lists} but no camera; "
        "add intrinsics.txt with fx fy cx cy (pixels), or a 3×3 matrix"
    )


def _camera_files(root: Path, layout: _Layout) -> list[Path]:
    """Files that may hold the colour camera, the likeliest first."""
    places = dict.fromkeys((layout.depth.parent, root, layout.colour))
    candidates = [file for place in places for pattern in CAMERA_FILES for file in files_in(place, pattern)]
    if layout.poses is not None:
        candidates = [file for file in candidates if file != layout.poses.file]
    named = [file for file in candidates if words_of(file.stem) & CAMERA_WORDS or file.suffix in (".yaml", ".yml")]
    return sorted(named, key=lambda file: (bool(words_of(file.stem) & DEPTH_WORDS), natural_key(file.name)))


def _values(file: Path) -> dict[str, list[float]]:
    """`fx: 535.4`, `"cx": 320`, `data: [ … ]` and the like by their last name in lower case; a text of numbers alone is a matrix or four
    values. Empty where there is no camera."""
    try:
        text = re.sub(r"#[^\n]*", "", read_text(file, MOST_CAMERA))
    except InputError:
        return {}
    words = re.sub(r"[,;\[\]]", " ", text).split()
    if words and all(NUMBER.fullmatch(word) for word in words):
        numbers = [float(word) for word in words]
        if len(numbers) in (9, 12, 16):
            return {"matrix": np.reshape(numbers, {9: (3, 3), 12: (3, 4), 16: (4, 4)}[len(numbers)])[:3, :3].ravel().tolist()}
        return {name: [value] for name, value in zip(LENS, numbers, strict=True)} if len(numbers) == 4 else {}
    out: dict[str, list[float]] = {}
    for name, value in VALUE.findall(_without_nesting(text)):
        numbers = [float(number) for number in NUMBER.findall(value)]
        if numbers:
            out.setdefault(name.split(".")[-1].lower(), numbers)
    for key in ("intrinsic_matrix", "camera_matrix", "k", "matrix"):
        if len(out.get(key, ())) == 9:
            matrix = np.array(out[key]).reshape(3, 3)
            out["matrix"] = (matrix.T if abs(matrix[2, 0]) > 1 else matrix).ravel().tolist()  # Open3D's is column by column
    if len(out.get("intrinsics", ())) == 4:
        out |= {name: [value] for name, value in zip(LENS, out["intrinsics"], strict=True)}
    return out if "matrix" in out or all(name in out for name in LENS) else {}


def _without_nesting(text: str) -> str:
    """Lists of lists as one list; a matrix's `data` (OpenCV's yaml) under the matrix's own name."""
    flat = re.sub(r"\]\s{0,99},\s{0,99}\[", ", ", re.sub(r"\[\s{0,99}\[", "[", re.sub(r"\]\s{0,99}\]", "]", text)))
    line = r"\n[ \t]{1,20}(?:rows|cols|dt)[ \t]{0,20}:[^\n]{0,80}"
    return re.sub(rf"\b(\w{{1,60}})[ \t]{{0,20}}:[^\n]{{0,80}}(?:{line}){{1,3}}\n[ \t]{{1,20}}data[ \t]{{0,20}}:", r"\1:", flat)


def _intrinsics(values: dict[str, list[float]], size: tuple[int, int], where: str) -> Intrinsics:
    """The camera for images of `size`: as given, or scaled from the size that the file gives. Pixel centres are at whole numbers."""
    width, height = (
        next((values[key][0] for key in keys if key in values), default)
        for keys, default in zip((("width", "image_width", "w"), ("height", "image_height", "h")), size, strict=True)
    )
    given = usable_size(width, height, where)
    if "matrix" in values:
        camera = from_matrix(np.array(values["matrix"]).reshape(3, 3), *given, where)
    else:
        camera = sensor(*given, *(values[name][0] for name in LENS)).checked(where)
    lens = [values.get(name, [0.0])[0] for name in ("k1", "k2", "p1", "p2", "k3")]
    if any(lens):
        camera = replace(camera, lens=OPENCV, distortion=tuple(lens)).checked(where)
    return fitted(camera.centred(where), size, where)


def _in_own_unit(capture: Capture) -> Capture:
    """With the unit of depth that nothing gives: of floating-point maps the poses' own, else millimetres if not another fits the poses."""
    chosen = spread([frame for frame in capture.frames if frame.depth is not None], LOOKED_AT)
    raw = [(frame, load_depth(frame, capture)) for frame in chosen]
    unit = MILLIMETRES if all(np.array_equal(depth, np.round(depth)) for _, depth in raw) else 1.0
    samples = [Sample.of(depth / np.float32(unit), frame) for frame, depth in raw]
    factor = unit_factor([sample for sample in samples if sample is not None])
    scale = unit / factor
    how = "which fits the poses" if factor != 1 else "as is usual"
    remark = f"no file gives the unit of depth; {scale:g} for each unit of the poses is taken, {how}"
    return replace(capture, depth_scale=scale, warnings=(*capture.warnings, remark))
