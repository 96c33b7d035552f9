"""From depth to a fused volume: frames of a capture or of matching, voxel size, range and memory from their depth, and the loop."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, Similarity, undistort_maps
from fieldfuse.capture.images import load_depth, load_image, usable_pixels
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import TsdfSettings
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.maps import LEAST_CONFIDENCE
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.tone import Tone
from fieldfuse.tsdf.volume import DepthFrame, TsdfVolume, too_fine

log = logging.getLogger(__name__)

# A voxel this share of the median depth is 1 cm at 2 m (rooms) and 2.5 mm at half a metre (objects).
VOXELS_PER_MEDIAN_DEPTH = 200.0
# Finer than this many pixels on the surface, voxels only store noise and holes.
PIXELS_PER_VOXEL = 1.5
SAMPLE_FRAMES = 12  # frames looked at before fusion, for voxel size, range and memory
FINEST = 0.3  # smallest voxel in pixels: Open3D looks at every fourth pixel for the blocks of 8 voxels to fill
COARSER = 1.4  # from one try of a voxel size to the next
HOPELESS = 16  # how many times too many blocks are counted before counting stops
CONFIRMED = 1.5  # surface that a single view shows is excluded ...
MANY_VIEWS = 10  # ... from so many views on
FUSION = 0.1  # of the time that making the frames takes, for the progress


def capture_depth_frames(
    capture: Capture, working_from_input: Similarity, indices: Iterable[int] | None = None, tones: Mapping[str, Tone] | None = None
) -> Iterator[DepthFrame]:
    """The frames `indices` of a capture (None: all) that have depth, one at a time, at their stored size, undistorted when a lens bends.

    Depth is scaled to working units. Pixels under the frame's mask, or that are see-through, lose their depth. What `tones` has for a
    frame's name is taken out of its colours.

    Raises:
        InputError: a frame without pose or intrinsics, or a file that cannot be read.
    """
    for index in range(len(capture.frames)) if indices is None else indices:
        frame = capture.frames[int(index)]
        if frame.depth is None:
            continue
        if frame.world_from_camera is None or frame.intrinsics is None:
            raise InputError(f"the frame {frame.name} has no pose or no intrinsics; find poses before fusing depth")
        image, depth = load_image(frame), load_depth(frame, capture)
        colour_camera = frame.intrinsics.scaled(image.shape[1], image.shape[0])
        depth_camera = (frame.depth_intrinsics or frame.intrinsics).scaled(depth.shape[1], depth.shape[0])
        usable = usable_pixels(frame, image)
        if usable is not None:
            depth = np.where(_seen_from(usable, colour_camera, depth_camera), depth, np.float32(0))
        colour = np.ascontiguousarray(image[:, :, :3])
        if depth_camera.distorted:
            # Depth is never averaged: a mean across an edge is a point in empty space.
            depth_camera, map_x, map_y, valid = undistort_maps(depth_camera, depth_camera.width, depth_camera.height)
            depth = np.where(valid, cv2.remap(depth, map_x, map_y, cv2.INTER_NEAREST), np.float32(0))
        if colour_camera.distorted:
            # Beyond the image its edge is repeated: black there would bleed into the surface.
            colour_camera, map_x, map_y, _ = undistort_maps(colour_camera, colour_camera.width, colour_camera.height)
            colour = cv2.remap(colour, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if tones and (tone := tones.get(frame.name)) is not None:
            colour = tone.undone(colour, colour_camera)[0]
        depth = np.ascontiguousarray(depth, dtype=np.float32) * np.float32(working_from_input.scale)
        pose = working_from_input.poses(frame.world_from_camera)
        colour, colour_camera = cover(colour, colour_camera, depth_camera)
        yield DepthFrame(depth, colour, depth_camera, colour_camera, pose)


def cover(colour: Array, colour_camera: Intrinsics, depth_camera: Intrinsics) -> tuple[Array, Intrinsics]:
    """Repeat the image's edge until it covers the field of view of the depth camera.

    Open3D adds weight but no colour to voxels that project outside the image, so their colour would darken for good.
    """
    size, middle = np.array([colour_camera.width, colour_camera.height]), np.array([colour_camera.cx, colour_camera.cy])
    scale = np.array([colour_camera.fx / depth_camera.fx, colour_camera.fy / depth_camera.fy])
    away = np.array([depth_camera.cx, depth_camera.cy])
    low, high = middle - scale * away, middle + scale * (np.array([depth_camera.width, depth_camera.height]) - away)
    (left, top), (right, bottom) = (np.ceil(np.maximum(by - 1, 0)).astype(int) for by in (-low, high - size))
    if left + top + right + bottom == 0:
        return colour, colour_camera
    padded = np.pad(colour, ((top, bottom), (left, right), (0, 0)), mode="edge")
    height, width = padded.shape[:2]
    return padded, replace(colour_camera, width=width, height=height, cx=colour_camera.cx + left, cy=colour_camera.cy + top)


def automatic_voxel_size(depths: Sequence[Array], focal: float | None = None) -> float:
    """A voxel size (units of the depths) from some depth maps: 1/200 of the median depth, not under 1.5 pixels of a camera with `focal`.

    A room seen at 2 to 4 m gets 1 to 2 cm, an object on a desk a few millimetres. Rounded to two digits.

    Raises:
        InputError: no depth map holds a valid value.
    """
    median = float(np.median(_valid(depths)))
    size = max(median / VOXELS_PER_MEDIAN_DEPTH, PIXELS_PER_VOXEL * median / focal if focal else 0.0)
    return float(f"{size:.1e}")


def automatic_depth_max(depths: Sequence[Array]) -> float:
    """The depth beyond which nothing is fused: the 99th percentile, not over five times the median (a depth sensor's far values are noise).

    Raises:
        InputError: no depth map holds a valid value.
    """
    values = _valid(depths)
    return float(min(1.02 * np.percentile(values, 99), 5 * np.median(values)))


def _valid(depths: Sequence[Array]) -> Array:
    values = [depth[np.isfinite(depth) & (depth > 0)][::7] for depth in depths]
    joined = np.concatenate(values) if values else np.zeros(0)
    if len(joined) == 0:
        raise InputError("no frame holds a valid depth value (all are zero, negative or not finite); check the depth maps")
    return joined


def _seen_from(mask: Array, colour_camera: Intrinsics, depth_camera: Intrinsics) -> Array:
    """A (h, w) mask on the colour camera's pixels → the same on the depth camera's pixels (same centre; lenses taken as equal)."""
    height, width = mask.shape
    camera = colour_camera.scaled(width, height)
    u = ((np.arange(depth_camera.width) + 0.5 - depth_camera.cx) / depth_camera.fx) * camera.fx + camera.cx
    v = ((np.arange(depth_camera.height) + 0.5 - depth_camera.cy) / depth_camera.fy) * camera.fy + camera.cy
    columns = np.clip(np.floor(u), 0, width - 1).astype(int)
    rows = np.clip(np.floor(v), 0, height - 1).astype(int)
    return np.asarray(mask[rows[:, None], columns[None, :]])


def estimate_blocks(sample: Sequence[DepthFrame], volume: TsdfVolume, total: int) -> int:
    """Blocks that `total` frames will need, from an evenly spread sample of them: the blocks it touches, and as much again for what
    lies between when the sample's frames overlap little.

    Raises:
        InputError: the sample alone needs more than the volume may hold, or a voxel is so small that pixels would miss most blocks.
    """
    pixel = float(np.median([np.median(f.depth[f.depth > 0]) / f.depth_intrinsics.fx for f in sample if (f.depth > 0).any()] or [0.0]))
    if volume.voxel_size < FINEST * pixel:
        raise InputError(
            f"a voxel size of {volume.voxel_size:g} is finer than the pixels of the depth maps ({pixel:.2g} on the surface), which would"
            f" leave holes; use tsdf.voxel_size={FINEST * pixel * 1.05:.2g} or larger"
        )
    union = np.zeros(0, np.int64)
    passed = largest = 0
    for frame in sample:
        # A key's three numbers in one, 21 bits each: much faster to compare than rows.
        keys = (volume.touched(frame).astype(np.int64) + (1 << 20)) @ np.array([1, 1 << 21, 1 << 42])
        passed, largest = passed + len(keys), max(largest, len(keys))
        union = np.union1d(union, keys)
        if len(union) > HOPELESS * volume.max_blocks:
            break
    if len(union) > volume.max_blocks:
        raise too_fine(volume.voxel_size, len(union), volume.max_blocks)
    unseen = len(union) * (len(union) / max(passed, 1)) if total > len(sample) else 0.0
    return int(1.2 * (len(union) + unseen)) + largest


def with_room(
    sample: Sequence[DepthFrame], voxel_size: float | None, depth_max: float, total: int, focal: float | None = None
) -> tuple[float, int]:
    """Voxel size and blocks for `total` frames; an automatic size is made coarser until the blocks fit into memory.

    Args:
        focal: of the camera whose pixels decide that size; None: the depth maps'.

    Raises:
        InputError: the given size is too fine for the memory, or for the pixels.
    """
    focal = focal or min(frame.depth_intrinsics.fx for frame in sample)
    size = voxel_size or automatic_voxel_size([frame.depth for frame in sample], focal)
    while True:
        try:
            return size, estimate_blocks(sample, TsdfVolume(size, depth_max, expected_blocks=64), total)
        except InputError:
            if voxel_size is not None or size > depth_max:
                raise
            size *= COARSER


def fuse_frames(
    frames: Iterable[DepthFrame],
    voxel_size: float,
    depth_max: float,
    total: int = 0,
    expected_blocks: int = 4000,
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Fuse all `frames` (`total` of them, for the progress).

    Raises:
        InputError: none holds depth within range, or the voxel size is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    volume = TsdfVolume(voxel_size, depth_max, expected_blocks=expected_blocks)
    for number, frame in enumerate(frames, 1):
        progress.check()
        volume.integrate(frame)
        progress.update(number, max(total, number), f"{volume.blocks} blocks")
    volume.require_frames()
    if volume.empty_frames:
        seen = volume.frames + volume.empty_frames
        log.warning("%d of %d frames hold no depth within %g and were not fused into the TSDF", volume.empty_frames, seen, depth_max)
    return volume


def fuse_capture(
    capture: Capture,
    working_from_input: Similarity,
    indices: Iterable[int] | None = None,
    settings: TsdfSettings | None = None,
    progress: Progress = SILENT,
    tones: Mapping[str, Tone] | None = None,
) -> TsdfVolume:
    """Fuse the frames `indices` (None: all) of a capture; voxel size and range from its depth unless `settings` name them. What `tones`
    has for a frame's name is taken out of its colours.

    Raises:
        InputError: no frame has depth, poses are missing, or the voxel size is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    settings = settings or TsdfSettings()
    chosen = range(len(capture.frames)) if indices is None else [int(i) for i in indices]
    wanted = [i for i in chosen if capture.frames[i].depth is not None]
    if not wanted:
        raise InputError(f"{capture.root} holds no depth maps, which the TSDF needs; set tsdf.enabled=off")
    spread = np.unique(np.linspace(0, len(wanted) - 1, SAMPLE_FRAMES).round().astype(int))
    sample = list(capture_depth_frames(capture, working_from_input, [wanted[i] for i in spread]))
    depths = [frame.depth for frame in sample]
    depth_max = settings.depth_max or automatic_depth_max(depths)
    voxel_size, expected = with_room(sample, settings.voxel_size, depth_max, len(wanted))
    del sample, depths
    frames = capture_depth_frames(capture, working_from_input, wanted, tones)
    return fuse_frames(frames, voxel_size, depth_max, len(wanted), expected, progress)


def fuse_held(
    frames: Sequence[DepthFrame],
    voxel_size: float | None = None,
    depth_max: float | None = None,
    *,
    focal: float | None = None,
    carve: bool = True,
    nothing: str = "no view shows a surface",
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Fuse those of the frames, all in memory, that show depth: room is made once, and empty space carved by every view.

    Args:
        voxel_size, depth_max: working units; None: from the frames' depth, the voxel size made coarser until it fits into memory.
        focal: of the camera whose pixels decide an automatic voxel size; None: the depth maps'.
        carve: trust no frame alone: each empties what others put in front of its surface, and what a single one shows is excluded.
        nothing: the refusal when no frame shows depth.

    Raises:
        InputError: no frame shows depth, or the given voxel size is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    shown = [frame for frame in frames if (frame.depth > 0).any()]
    if not shown:
        raise InputError(nothing)
    depth_max = depth_max or automatic_depth_max([frame.depth for frame in shown])
    size, expected = with_room(shown, voxel_size, depth_max, len(shown), focal)
    volume = TsdfVolume(size, depth_max, expected_blocks=2 * expected)
    if carve:
        volume.min_weight = CONFIRMED if len(shown) >= MANY_VIEWS else None
        for frame in shown:
            volume.reserve(volume.touched(frame))
    for number, frame in enumerate(shown, 1):
        progress.check()
        volume.integrate(frame, carve)
        progress.update(len(frames) * (1 + FUSION * number / len(shown)), (1 + FUSION) * len(frames), "views fused")
    if volume.frames == 0:
        raise InputError(f"no view shows a surface nearer than {volume.depth_max:g}; raise the largest depth")
    return volume


def fuse_stereo(
    views: Views,
    depths: Sequence[StereoDepth],
    voxel_size: float | None = None,
    depth_max: float | None = None,
    carve: bool = True,
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Fuse the depth of `stereo_depths(views, …)`; arguments and errors as `fuse_held`."""
    nothing = (
        "no depth could be found by matching the images: they show too little texture, or their poses do not fit them; find the poses"
        " again with --poses sfm, or set tsdf.enabled=off"
    )
    frames = []
    for image, lens, pose, found in zip(views.images, views.intrinsics, views.world_from_camera, depths, strict=True):
        depth = np.where(found.confidence >= LEAST_CONFIDENCE, found.depth, np.float32(0))
        colour, camera = cover(image, lens.pinhole(), found.intrinsics)  # in full size
        frames.append(DepthFrame(depth, np.ascontiguousarray(colour), found.intrinsics, camera, np.asarray(pose, dtype=np.float64)))
    return fuse_held(frames, voxel_size, depth_max, carve=carve, nothing=nothing, progress=progress)
