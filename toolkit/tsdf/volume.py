"""Classic TSDF fusion (Curless and Levoy 1996) of depth frames on Open3D's `VoxelBlockGrid` with blocks of 8³ voxels.

What Open3D 0.20 does and this file takes care of:
- `integrate` reads the depth pixel by cutting the decimals off, so it needs the matrix with pixel centres at +0.5, while
  `compute_unique_block_coordinates` unprojects whole pixel numbers and needs centres at whole numbers; with one matrix for
  both the surface moves by half a pixel.
- 16-bit depth with 8-bit colour is its fastest pair of types (others convert each image); depth is stored in 1/60000 of the range.
- A frame without valid depth raises; the weight threshold is exclusive, so 3 needs four observations.
- `VoxelBlockGrid.ray_cast` can hang on the CPU, leaves tiles empty, and its depth is off by up to a voxel: views are rendered by ray
  casting the extracted mesh.
- Its threads, which do not ask OMP_NUM_THREADS, number points and triangles as they come to them: both are put into order.
- The table grows when the keys passed would not fit, present or not, and growth copies everything: room is made beforehand, and keys are
  passed in pieces that fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
import open3d.core as o3c

from fieldfuse import memory
from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.errors import InputError
from fieldfuse.tsdf.mesh import Mesh, MeshView, SurfaceCaster, as_bytes, places

BLOCK = 8
TRUNCATION = 4.0  # half width of the band around the surface, in voxels
DEPTH_STEPS = 60000  # 16-bit depth: this value is depth_max, what saturates above it is out of range
BYTES_PER_BLOCK = BLOCK**3 * (1 + 1 + 3) * 4
MAX_BYTES = 4 * 2**30
SMALLEST, LARGEST = 1e-9, 1e9  # of lengths: Open3D computes in float32, where products of two must stay finite and above zero
SLACK = 1024  # blocks of room beyond those in use
DEVICE = o3c.Device("CPU:0")


@dataclass(frozen=True)
class DepthFrame:
    """One RGB-D image ready for fusion. Both cameras are pinholes at the same place; their sizes and focal lengths may differ."""

    depth: Array  # (H, W) float32 along z, working units, 0 = missing
    colour: Array  # (h, w, 3) uint8 RGB
    depth_intrinsics: Intrinsics
    colour_intrinsics: Intrinsics
    world_from_camera: Array  # (4, 4) float64


@dataclass(frozen=True)
class Points:
    """Coloured surface points with normals."""

    points: Array  # (P, 3) float64
    colours: Array  # (P, 3) uint8
    normals: Array  # (P, 3) float64 unit length, out of the surface


def default_weight_threshold(sightings: float) -> float:
    """Voxels seen this often or less are excluded: none that were seen while blocks were seen by up to 50 frames on average, then those
    seen once.

    Open3D's own 3 (at least four sightings) is far stricter: already 2.5 costs 1 to 6% of the surface and 0.7 to 5 dB in whole rendered
    images where places are seen 8 to 50 times, and what is left is hardly more accurate.
    """
    return 0.5 if sightings <= 50 else 1.5


class TsdfVolume:
    """A truncated signed distance volume with colour.

    Args:
        voxel_size, depth_max: working units; depth beyond depth_max is not fused.
        expected_blocks: room made beforehand (see `estimate_blocks`); it grows when that was too little.
        max_bytes: bound of the voxels' memory; None: `MAX_BYTES`, or half of what is free when that is less (growing copies everything).
    """

    def __init__(self, voxel_size: float, depth_max: float, expected_blocks: int = 4000, max_bytes: int | None = None) -> None:
        for name, value in (("voxel size", voxel_size), ("largest depth", depth_max)):
            if not SMALLEST <= value <= LARGEST:
                raise InputError(f"the {name} of the TSDF is {value:g}; it must be a positive number between {SMALLEST:g} and {LARGEST:g}")
        self.voxel_size, self.depth_max = float(voxel_size), float(depth_max)
        self.max_blocks = max(1, (memory.bounded(MAX_BYTES) if max_bytes is None else max_bytes) // BYTES_PER_BLOCK)
        self.frames = 0
        self.empty_frames = 0
        self.touches = 0  # blocks written to, summed over frames
        self.min_weight: float | None = None  # replaces the default threshold
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (o3c.float32, o3c.float32, o3c.float32),
            (o3c.SizeVector([1]), o3c.SizeVector([1]), o3c.SizeVector([3])),
            self.voxel_size,
            BLOCK,
            min(max(int(expected_blocks), 0), self.max_blocks) + SLACK,
            DEVICE,
        )
        self._scale = DEPTH_STEPS / self.depth_max
        # Read back larger by a millionth: a plane exactly on voxels would have distance 0 there, no change of sign, and vanish.
        self._read_scale = self._scale * (1 - 1e-6)
        self._caster: tuple[int, SurfaceCaster] | None = None

    @property
    def blocks(self) -> int:
        return int(self.grid.hashmap().size())

    def _threshold(self) -> float:
        """Voxels seen as often or less do not count in what is extracted: `min_weight`, else by sightings."""
        self.require_frames()
        return default_weight_threshold(self.touches / max(self.blocks, 1)) if self.min_weight is None else self.min_weight

    @property
    def bytes(self) -> int:
        """Memory of the voxels that are in use."""
        return self.blocks * BYTES_PER_BLOCK

    def reserve(self, keys: Array) -> None:
        """Make the blocks (B, 3) int32 part of the volume before anything is fused, for `integrate(frame, carve=True)`.

        Raises:
            InputError: the volume would outgrow its memory.
        """
        if len(keys):
            wanted = o3c.Tensor.from_numpy(np.ascontiguousarray(keys, dtype=np.int32))
            self._make_room(wanted)
            self._activate(wanted)

    def integrate(self, frame: DepthFrame, carve: bool = False) -> bool:
        """Fuse one frame; False when it holds no depth within range.

        A frame writes to the blocks around its own surface. With `carve` it also writes to all blocks of the volume that it sees, so that
        it marks as empty what another frame put in front of its surface (several times slower).

        Raises:
            InputError: the volume would outgrow its memory.
        """
        depth = self._quantised(frame.depth)
        extrinsic = o3c.Tensor(invert(frame.world_from_camera))
        keys = self._touched(depth, frame.depth_intrinsics, extrinsic)
        if keys is None:
            self.empty_frames += 1
            return False
        self._make_room(keys)
        self.touches += len(keys)
        if carve:
            self._activate(keys)
            keys = self._keys_in_view(frame)
        colour = o3d.t.geometry.Image(np.ascontiguousarray(frame.colour))
        matrix, colour_matrix = frame.depth_intrinsics.matrix(), frame.colour_intrinsics.matrix_integer_centres()
        # Open3D projects the depth pixel's corner and rounds: half a depth pixel on, half a colour pixel off.
        colour_matrix[:2, 2] += 0.5 * np.diag(colour_matrix)[:2] / np.diag(matrix)[:2]
        lenses = o3c.Tensor(matrix), o3c.Tensor(colour_matrix)
        for piece in self._pieces(keys):
            self.grid.integrate(piece, depth, colour, *lenses, extrinsic, self._read_scale, self.depth_max, TRUNCATION)
        self.frames += 1
        return True

    def touched(self, frame: DepthFrame) -> Array:
        """(B, 3) int32 keys of the blocks that a frame would write to; nothing is allocated."""
        keys = self._touched(self._quantised(frame.depth), frame.depth_intrinsics, o3c.Tensor(invert(frame.world_from_camera)))
        return np.zeros((0, 3), np.int32) if keys is None else keys.numpy()

    def mesh(self) -> Mesh:
        """The surface, uncleaned, in the working frame.

        Raises:
            InputError: no frame with valid depth was fused.
        """
        mesh = self.grid.extract_triangle_mesh(self._threshold())
        if "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
            return Mesh.empty()
        vertex = mesh.vertex
        return Mesh.create(
            vertex.positions.numpy(), mesh.triangle.indices.numpy(), as_bytes(vertex.colors.numpy()), _unit(vertex.normals.numpy())
        ).ordered()

    def points(self) -> Points:
        """Surface points where the distance changes sign along a lattice edge, in the working frame, by x, y, z.

        Raises:
            InputError: no frame with valid depth was fused.
        """
        cloud = self.grid.extract_point_cloud(self._threshold())
        if "positions" not in cloud.point or len(cloud.point.positions) == 0:
            return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3)))
        point = cloud.point
        points, colours = point.positions.numpy().astype(np.float64), as_bytes(point.colors.numpy())
        normals = _unit(point.normals.numpy())
        order = places(points, colours, normals)
        return Points(points[order], colours[order], normals[order])

    def render(self, intrinsics: Intrinsics, world_from_camera: Array) -> MeshView:
        """Colour, depth and mask as a camera sees the surface. The surface is extracted once and again after new frames.

        Raises:
            InputError: no frame with valid depth was fused.
        """
        if self._caster is None or self._caster[0] != self.frames:
            self._caster = (self.frames, SurfaceCaster(self.mesh()))
        return self._caster[1].render(intrinsics, world_from_camera)

    def _quantised(self, depth: Array) -> o3d.t.geometry.Image:
        # One pass: scaled, rounded and saturated; NaN, infinite and negative become 0. Then what is out of range becomes 0 too.
        steps = cv2.multiply(np.ascontiguousarray(depth, dtype=np.float32), self._scale, dtype=cv2.CV_16U)  # type: ignore[call-overload]
        _, steps = cv2.threshold(steps, DEPTH_STEPS, 0, cv2.THRESH_TOZERO_INV)
        return o3d.t.geometry.Image(steps)

    def _touched(self, depth: o3d.t.geometry.Image, intrinsics: Intrinsics, extrinsic: o3c.Tensor) -> o3c.Tensor | None:
        matrix = o3c.Tensor(intrinsics.matrix_integer_centres())
        try:
            return self.grid.compute_unique_block_coordinates(depth, matrix, extrinsic, self._scale, self.depth_max, TRUNCATION)
        except RuntimeError as error:  # Open3D's error where no pixel that it looked at has depth
            if "No block is touched" not in str(error):
                raise
            return None

    def _activate(self, keys: o3c.Tensor) -> None:
        for piece in self._pieces(keys):
            self.grid.hashmap().activate(piece)

    def _keys_in_view(self, frame: DepthFrame) -> o3c.Tensor:
        """Keys of the volume's blocks whose bounding sphere reaches into the frame's field of view and range."""
        table = self.grid.hashmap()
        keys = table.key_tensor().numpy()[table.active_buf_indices().numpy()]
        camera, side = frame.depth_intrinsics, BLOCK * self.voxel_size
        pose = invert(frame.world_from_camera)
        centre = ((keys + 0.5) * side) @ pose[:3, :3].T + pose[:3, 3]
        radius = side * 3**0.5 / 2
        inside = (centre[:, 2] > -radius) & (centre[:, 2] < self.depth_max + radius)
        for axis, focal, middle, size in ((0, camera.fx, camera.cx, camera.width), (1, camera.fy, camera.cy, camera.height)):
            # The view's four side planes go through the camera; distance = (normal · centre) with normals pointing inwards.
            low, high = (0 - middle) / focal, (size - middle) / focal
            inside &= (centre[:, axis] - low * centre[:, 2]) / np.hypot(1, low) > -radius
            inside &= (high * centre[:, 2] - centre[:, axis]) / np.hypot(1, high) > -radius
        return o3c.Tensor.from_numpy(np.ascontiguousarray(keys[inside]))

    def _make_room(self, keys: o3c.Tensor) -> None:
        """Room for the keys that are new, and SLACK more, so that Open3D itself never grows the table."""
        table = self.grid.hashmap()
        if table.size() + len(keys) + SLACK <= table.capacity():
            return
        _, present = table.find(keys)
        needed = table.size() + int((~present.numpy()).sum())
        if needed > self.max_blocks:
            raise too_fine(self.voxel_size, needed, self.max_blocks)
        if needed + SLACK > table.capacity():
            table.reserve(max(needed, min(2 * table.capacity(), self.max_blocks)) + SLACK)

    def _pieces(self, keys: o3c.Tensor) -> Iterator[o3c.Tensor]:
        """The keys in pieces that Open3D, which counts present ones again, does not grow the table for (nearly always one)."""
        table = self.grid.hashmap()
        done = 0
        while done < len(keys):
            size = table.capacity() - table.size()
            yield keys[done : done + size]
            done += size

    def require_frames(self) -> None:
        if self.frames == 0:
            raise InputError(f"no frame has valid depth between 0 and {self.depth_max:g} to fuse; check the depth maps and tsdf.depth_max")


def too_fine(voxel_size: float, blocks: int, max_blocks: int) -> InputError:
    """The refusal of a voxel size whose surface does not fit into memory; blocks on a surface fall with the square of the voxel size."""
    fits = float(f"{voxel_size * (1.2 * blocks / max_blocks) ** 0.5:.1e}")
    return InputError(
        f"a voxel size of {voxel_size:g} needs more than {blocks * BYTES_PER_BLOCK / 2**30:.1f} GB for the TSDF, and"
        f" {max_blocks * BYTES_PER_BLOCK / 2**30:.1f} GB are allowed; use tsdf.voxel_size={max(fits, 1.1 * voxel_size):.2g} or larger"
    )


def _unit(vectors: Array) -> Array:
    vectors = vectors.astype(np.float64)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
