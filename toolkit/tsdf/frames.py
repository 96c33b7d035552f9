"""Depth frames for fusion: what one holds, how a capture yields them, and which voxel size and range fit their depth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, Similarity, undistort_maps
from fieldfuse.capture.images import load_depth, load_image, usable_pixels
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.tone import Tone

# A voxel this share of the median depth is 1 cm at 2 m (rooms) and 2.5 mm at half a metre (objects).
VOXELS_PER_MEDIAN_DEPTH = 200.0
# Finer than this many pixels on the surface, voxels only store noise and holes.
PIXELS_PER_VOXEL = 1.5


@dataclass(frozen=True)
class DepthFrame:
    """One RGB-D picture ready for fusion. Both cameras are pinholes at the same place; their sizes and focal lengths may differ."""

    depth: Array  # (H, W) float32 along z, working units, 0 = missing
    colour: Array  # (h, w, 3) uint8 RGB
    depth_intrinsics: Intrinsics
    colour_intrinsics: Intrinsics
    world_from_camera: Array  # (4, 4) float64


def capture_depth_frames(
    capture: Capture, working_from_input: Similarity, indices: Iterable[int] | None = None, tones: Mapping[str, Tone] | None = None
) -> Iterator[DepthFrame]:
    """The frames `indices` of a capture (None: all) that have depth, one at a time, at their stored size, undistorted when a lens bends.

    Depth is scaled to working units. Pixels under the frame's mask, or where alpha says that nothing is there, lose their depth. What
    `tones` has for a frame's name is taken out of its colours.

    Raises:
        InputError: a frame without pose or intrinsics, or a file that cannot be read.
    """
    for index in range(len(capture.frames)) if indices is None else indices:
        frame = capture.frames[int(index)]
        if frame.depth is not None:
            yield load_depth_frame(frame, capture, working_from_input, (tones or {}).get(frame.name))


def load_depth_frame(frame: Frame, capture: Capture, working_from_input: Similarity, tone: Tone | None = None) -> DepthFrame:
    """Decode one frame; see `capture_depth_frames`."""
    if frame.world_from_camera is None or frame.intrinsics is None:
        raise InputError(f"the frame {frame.name} has no pose or no intrinsics; find poses before fusing depth")
    picture = load_image(frame)
    depth = load_depth(frame, capture)
    colour_camera = _at_size(frame.intrinsics, picture)
    depth_camera = _at_size(frame.depth_intrinsics or frame.intrinsics, depth)
    usable = usable_pixels(frame, picture)
    if usable is not None:
        depth = np.where(_seen_from(usable, colour_camera, depth_camera), depth, np.float32(0))
    colour = np.ascontiguousarray(picture[:, :, :3])
    if depth_camera.distorted:
        # Depth is never averaged: a mean across an edge is a point in empty space.
        depth_camera, map_x, map_y, valid = undistort_maps(depth_camera, depth_camera.width, depth_camera.height)
        depth = np.where(valid, cv2.remap(depth, map_x, map_y, cv2.INTER_NEAREST), np.float32(0))
    if colour_camera.distorted:
        # Beyond the picture its edge is repeated: black there would bleed into the surface.
        colour_camera, map_x, map_y, _ = undistort_maps(colour_camera, colour_camera.width, colour_camera.height)
        colour = cv2.remap(colour, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if tone is not None:
        colour = tone.undone(colour, colour_camera)[0]
    depth = np.ascontiguousarray(depth, dtype=np.float32) * np.float32(working_from_input.scale)
    pose = working_from_input.poses(frame.world_from_camera)
    colour, colour_camera = cover(colour, colour_camera, depth_camera)
    return DepthFrame(depth, colour, depth_camera, colour_camera, pose)


def cover(colour: Array, colour_camera: Intrinsics, depth_camera: Intrinsics) -> tuple[Array, Intrinsics]:
    """Repeat the picture's edge until it covers the field of view of the depth camera.

    Open3D adds weight but no colour to voxels that project outside the picture, so their colour would darken for good.
    """
    left, top = (0 - depth_camera.cx) / depth_camera.fx, (0 - depth_camera.cy) / depth_camera.fy
    right, bottom = (depth_camera.width - depth_camera.cx) / depth_camera.fx, (depth_camera.height - depth_camera.cy) / depth_camera.fy
    pad_left = int(np.ceil(max(0.0, -(left * colour_camera.fx + colour_camera.cx) - 1)))
    pad_top = int(np.ceil(max(0.0, -(top * colour_camera.fy + colour_camera.cy) - 1)))
    pad_right = int(np.ceil(max(0.0, right * colour_camera.fx + colour_camera.cx - colour_camera.width - 1)))
    pad_bottom = int(np.ceil(max(0.0, bottom * colour_camera.fy + colour_camera.cy - colour_camera.height - 1)))
    if pad_left + pad_top + pad_right + pad_bottom == 0:
        return colour, colour_camera
    padded = np.pad(colour, ((pad_top, pad_bottom), (pad_left, pad_right), (0, 0)), mode="edge")
    camera = replace(
        colour_camera,
        width=padded.shape[1],
        height=padded.shape[0],
        cx=colour_camera.cx + pad_left,
        cy=colour_camera.cy + pad_top,
    )
    return padded, camera


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


def _at_size(intrinsics: Intrinsics, picture: Array) -> Intrinsics:
    height, width = picture.shape[:2]
    return intrinsics if (intrinsics.width, intrinsics.height) == (width, height) else intrinsics.scaled(width, height)


def _seen_from(mask: Array, colour_camera: Intrinsics, depth_camera: Intrinsics) -> Array:
    """A (h, w) mask on the colour camera's pixels → the same on the depth camera's pixels (same centre; lenses taken as equal)."""
    height, width = mask.shape
    camera = colour_camera.scaled(width, height)
    u = ((np.arange(depth_camera.width) + 0.5 - depth_camera.cx) / depth_camera.fx) * camera.fx + camera.cx
    v = ((np.arange(depth_camera.height) + 0.5 - depth_camera.cy) / depth_camera.fy) * camera.fy + camera.cy
    columns = np.clip(np.floor(u), 0, width - 1).astype(int)
    rows = np.clip(np.floor(v), 0, height - 1).astype(int)
    return np.asarray(mask[rows[:, None], columns[None, :]])
