"""Fusion of exact depth: the surface, its colours and its views come out where they must, within the memory that was given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Intrinsics, project
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.export.mesh import to_trimesh
from fieldfuse.progress import Progress
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.tsdf.fuse import estimate_blocks, fuse_frames, fuse_stereo
from fieldfuse.tsdf.mesh import SurfaceCaster
from fieldfuse.tsdf.volume import BYTES_PER_BLOCK, SLACK, DepthFrame, TsdfVolume, default_weight_threshold
from tests.tsdf.scenes import CAMERA, all_round, plane_frame, ring, sphere_colour, sphere_depth, sphere_frame

CENTRE = np.array([0.31, -0.17, 0.08])
RADIUS = 0.5
VOXEL = 0.02


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    return [sphere_frame(pose, CENTRE, RADIUS) for pose in all_round(CENTRE, 1.6, 40)]


@pytest.fixture(scope="module")
def volume(frames: list[DepthFrame]) -> TsdfVolume:
    return fuse_frames(frames, VOXEL, 3.0)


def test_a_sphere_has_its_radius_and_place(volume: TsdfVolume) -> None:
    mesh = volume.mesh().cleaned(min_area_share=0.01)
    offset = mesh.vertices - CENTRE
    radius = np.linalg.norm(offset, axis=1)
    assert abs(np.median(radius) - RADIUS) < 0.5 * VOXEL
    assert np.quantile(np.abs(radius - RADIUS), 0.99) < 0.5 * VOXEL
    # A half-pixel error in the intrinsics would shift or blow up the sphere; nothing of the kind is left.
    assert np.abs(mesh.bounds().mean(axis=0) - CENTRE).max() < 0.15 * VOXEL
    assert np.quantile(np.einsum("ij,ij->i", mesh.normals, offset / radius[:, None]), 0.05) > 0.9
    assert to_trimesh(mesh).is_watertight
    assert to_trimesh(mesh).volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)  # positive: triangles face outwards


def test_colours_are_where_they_belong(volume: TsdfVolume) -> None:
    mesh = volume.mesh().cleaned(min_area_share=0.01)
    far_from_edge = np.abs(mesh.vertices[:, 2] - CENTRE[2]) > 2 * VOXEL
    error = np.abs(mesh.colours[far_from_edge].astype(int) - sphere_colour(mesh.vertices[far_from_edge], CENTRE).astype(int))
    assert np.median(error) <= 3
    assert np.quantile(error, 0.95) <= 12


def test_points_lie_on_the_sphere(volume: TsdfVolume) -> None:
    cloud = volume.points()
    offset = cloud.points - CENTRE
    assert len(cloud.points) > 3000
    assert cloud.points.dtype == np.float64
    assert cloud.colours.dtype == np.uint8
    assert np.quantile(np.abs(np.linalg.norm(offset, axis=1) - RADIUS), 0.97) < 0.5 * VOXEL
    assert np.median(np.einsum("ij,ij->i", cloud.normals, offset) / RADIUS) > 0.95


def test_a_new_view_has_the_true_depth_and_colour(volume: TsdfVolume) -> None:
    pose = ring(CENTRE, 1.3, 7, height=0.4)[3]
    camera = Intrinsics(200, 150, 190.0, 180.0, 97.0, 76.0)
    view = volume.render(camera, pose)
    true = sphere_depth(camera, pose, CENTRE, RADIUS)
    assert view.rgb.shape == (150, 200, 3)
    assert view.rgb.dtype == view.depth.dtype == np.float32
    assert (view.mask == (true > 0)).mean() > 0.985
    both = view.mask & (true > 0)
    assert np.median(np.abs(view.depth - true)[both]) < 0.1 * VOXEL
    assert np.quantile(np.abs(view.depth - true)[both], 0.9) < 0.5 * VOXEL
    assert not view.rgb[~view.mask].any()
    target = sphere_frame(pose, CENTRE, RADIUS, camera)
    assert np.median(np.abs(view.rgb[both] - target.colour[both] / 255.0)) < 0.02


@settings(max_examples=8, deadline=None)
@given(tilt=st.floats(-0.6, 0.6), turn=st.floats(-0.6, 0.6), distance=st.floats(1.0, 2.5), focal=st.floats(120, 300))
def test_a_slanted_plane_is_not_shifted(tilt: float, turn: float, distance: float, focal: float) -> None:
    # One view of a slanted plane: any error of half a pixel is an offset of the whole plane.
    normal = np.array([tilt, turn, -1.0]) / np.linalg.norm([tilt, turn, -1.0])
    camera = Intrinsics(160, 120, focal, focal, 79.0, 61.0)
    offset = float(normal @ [0, 0, distance])
    frame = plane_frame(np.eye(4), normal, offset, camera)
    volume = TsdfVolume(0.02, 6.0)
    volume.integrate(frame)
    points = volume.points().points
    assert len(points) > 200
    pixel = distance / focal
    assert abs(np.median(points @ normal - offset)) < 0.1 * 0.02 + 0.15 * pixel * np.hypot(tilt, turn)


def test_depth_and_colour_cameras_may_differ() -> None:
    colour_camera = Intrinsics(320, 240, 210.0, 205.0, 166.0, 117.0)
    frames = [sphere_frame(pose, CENTRE, RADIUS, CAMERA, colour_camera) for pose in ring(CENTRE, 1.6, 16)]
    mesh = fuse_frames(frames, VOXEL, 3.0).mesh().cleaned(min_area_share=0.01)
    near_equator = np.abs(mesh.vertices[:, 2] - CENTRE[2]) < 0.3
    vertices, colours = mesh.vertices[near_equator], mesh.colours[near_equator]
    clear = np.abs(vertices[:, 2] - CENTRE[2]) > 0.6 * VOXEL
    # Red above, green below: the edge is where it is, to less than a voxel.
    assert ((colours[clear, 0] > colours[clear, 1]) == (vertices[clear, 2] > CENTRE[2])).mean() > 0.985


@pytest.mark.parametrize("carve", [False, True])
def test_the_volume_never_outgrows_its_room_by_seeing_the_same_again(frames: list[DepthFrame], carve: bool) -> None:
    few, voxel = frames[::7], 0.006
    needed = fuse_frames(few, voxel, 3.0).blocks
    assert needed > 2 * SLACK  # with carving a frame passes more keys than there is room for new ones
    volume = TsdfVolume(voxel, 3.0, expected_blocks=needed)
    for _ in range(3):
        for frame in few:
            volume.integrate(frame, carve)
    assert volume.blocks == needed
    assert volume.grid.hashmap().capacity() == needed + SLACK


@pytest.mark.parametrize("carve", [False, True])
def test_growth_changes_nothing(frames: list[DepthFrame], carve: bool) -> None:
    small, large = TsdfVolume(0.01, 3.0, expected_blocks=0), TsdfVolume(0.01, 3.0, expected_blocks=20000)
    start = small.grid.hashmap().capacity()
    for frame in frames[:12]:
        small.integrate(frame, carve)
        large.integrate(frame, carve)
    assert small.grid.hashmap().capacity() > start
    assert large.grid.hashmap().capacity() == 20000 + SLACK
    one, two = small.mesh(), large.mesh()
    assert len(one.triangles) == len(two.triangles) > 1000
    order = [np.lexsort(np.round(mesh.vertices, 6).T) for mesh in (one, two)]
    assert np.allclose(one.vertices[order[0]], two.vertices[order[1]], atol=2e-6)


def test_memory_is_bounded_and_the_advice_works(frames: list[DepthFrame]) -> None:
    allowed = 1500 * BYTES_PER_BLOCK
    volume = TsdfVolume(0.003, 3.0, max_bytes=allowed)
    with pytest.raises(InputError, match=r"a voxel size of 0.003 needs more than .* GB.*tsdf.voxel_size="):
        for frame in frames:
            volume.integrate(frame)
    assert volume.blocks <= 1500
    with pytest.raises(InputError, match=r"tsdf\.voxel_size=") as caught:
        estimate_blocks(frames, TsdfVolume(0.003, 3.0, max_bytes=allowed), len(frames))
    size = float(str(caught.value).split("tsdf.voxel_size=")[1].split()[0])
    assert size < 0.1
    volume = TsdfVolume(size, 3.0, max_bytes=allowed)
    for frame in frames:
        volume.integrate(frame)
    assert volume.blocks <= 1500


def test_the_estimate_covers_what_is_needed(frames: list[DepthFrame]) -> None:
    blocks = fuse_frames(frames, VOXEL, 3.0).blocks
    assert blocks <= estimate_blocks(frames[::8], TsdfVolume(VOXEL, 3.0), len(frames)) <= 4 * blocks


def test_missing_depth_in_every_spelling_is_missing() -> None:
    pose = ring(CENTRE, 1.6, 1)[0]
    good = sphere_frame(pose, CENTRE, RADIUS)
    bad = good.depth.copy()
    hole = np.zeros(bad.shape, bool)
    for number, value in enumerate((np.nan, np.inf, -np.inf, -3.0, 1e30, 7.0)):
        row = 50 + 3 * number
        bad[row : row + 3], hole[row : row + 3] = value, True
    volume, expected = TsdfVolume(VOXEL, 3.0), TsdfVolume(VOXEL, 3.0)
    volume.integrate(replace(good, depth=bad))
    expected.integrate(replace(good, depth=np.where(hole, 0, good.depth)))
    assert volume.blocks == expected.blocks
    assert np.array_equal(np.sort(volume.points().points, axis=0), np.sort(expected.points().points, axis=0))


def test_depth_beyond_the_range_is_not_fused(frames: list[DepthFrame]) -> None:
    # The sphere lies between 1.1 and 1.6 m from each camera.
    volume = TsdfVolume(VOXEL, 1.3)
    for frame in frames[:3]:
        assert volume.integrate(frame)
    volume.min_weight = 0.5
    points = volume.points().points
    depths = np.array([project(CAMERA, frame.world_from_camera, points)[1] for frame in frames[:3]])
    assert len(points) > 1000
    assert depths.min() > 1.0
    assert depths.min(axis=0).max() < 1.3 + 0.5 * VOXEL
    assert not TsdfVolume(VOXEL, 0.9).integrate(frames[0])


def test_no_valid_depth_is_said_so(frames: list[DepthFrame]) -> None:
    empty = replace(frames[0], depth=np.zeros_like(frames[0].depth))
    with pytest.raises(InputError, match="no frame has valid depth"):
        fuse_frames([empty, replace(empty, depth=np.full_like(empty.depth, np.nan))], VOXEL, 3.0)
    volume = fuse_frames([empty, frames[0]], VOXEL, 3.0)
    assert (volume.frames, volume.empty_frames) == (1, 1)
    with pytest.raises(InputError, match="no frame has valid depth"):
        TsdfVolume(VOXEL, 3.0).mesh()
    with pytest.raises(InputError, match="no frame has valid depth"):
        TsdfVolume(VOXEL, 3.0).render(CAMERA, np.eye(4))


@pytest.mark.parametrize("values", [(0.0, 3.0), (-1.0, 3.0), (0.01, float("nan"))])
def test_sizes_that_are_no_sizes_are_refused(values: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="must be a positive number"):
        TsdfVolume(*values)


def test_a_single_frame_gives_a_surface(frames: list[DepthFrame]) -> None:
    volume = fuse_frames(frames[:1], VOXEL, 3.0)
    assert len(volume.mesh().triangles) > 500  # Open3D's own threshold would leave nothing
    volume.min_weight = 3.0
    assert len(volume.mesh().triangles) == len(volume.points().points) == 0


def test_the_threshold_rises_with_sightings() -> None:
    assert default_weight_threshold(1) < 1 <= default_weight_threshold(1000) < 2


def test_carving_removes_what_one_view_put_into_empty_space(frames: list[DepthFrame]) -> None:
    depth = frames[0].depth.copy()
    depth[2:22, 2:22] = 1.0  # a floater in front of everything, seen by one view only
    floating = [replace(frames[0], depth=depth), *frames[2::2]]
    # All others see that the space is free: there is a wall behind it.
    walled = [
        replace(frame, depth=np.where(frame.depth > 0, frame.depth, np.float32(2.9)))  # a far shell at constant z
        for frame in floating[1:]
    ]
    plain, carved = TsdfVolume(VOXEL, 3.0, expected_blocks=40000), TsdfVolume(VOXEL, 3.0, expected_blocks=40000)
    for frame in [floating[0], *walled]:
        carved.reserve(carved.touched(frame))
    for frame in [floating[0], *walled]:
        plain.integrate(frame)
        carved.integrate(frame, carve=True)
    view = floating[0]
    spot = np.zeros(depth.shape, bool)
    spot[4:20, 4:20] = True
    assert (np.abs(depth_of(plain, view)[spot] - 1.0) < VOXEL).mean() > 0.8
    left = depth_of(carved, view)
    assert (np.abs(left[spot] - 1.0) < VOXEL).mean() < 0.05
    ball = view.depth > 0
    ball[2:22, 2:22] = False
    assert np.median(np.abs(left - view.depth)[ball]) < 0.2 * VOXEL


def depth_of(volume: TsdfVolume, frame: DepthFrame) -> np.ndarray:
    """The view of a volume with every voxel that was seen at all."""
    volume.min_weight = 0.5
    return SurfaceCaster(volume.mesh()).render(CAMERA, frame.world_from_camera).depth


class Stopper(Progress):
    """Asks to stop after three updates."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, float]] = []

    def update(self, done: float, total: float, note: str = "") -> None:
        self.seen.append((done, total))

    def stopping(self) -> bool:
        return len(self.seen) >= 3


def test_fusion_tells_how_far_it_is_and_stops_on_request(frames: list[DepthFrame]) -> None:
    progress = Stopper()
    with pytest.raises(Interrupted):
        fuse_frames(frames, VOXEL, 3.0, total=len(frames), progress=progress)
    assert progress.seen == [(1, 40), (2, 40), (3, 40)]


def sphere_views() -> tuple[Views, list[StereoDepth]]:
    poses = all_round(CENTRE, 1.6, 24)
    frames = [sphere_frame(pose, CENTRE, RADIUS) for pose in poses]
    views = Views([f"{i}" for i in range(24)], [frame.colour for frame in frames], [CAMERA] * 24, poses, np.zeros(24, bool))
    depths = [StereoDepth(frame.depth, np.where(frame.depth > 0, 0.8, 0).astype(np.float32), CAMERA) for frame in frames]
    return views, depths


def test_the_surface_of_confident_depth() -> None:
    views, depths = sphere_views()
    doubtful = depths[3].depth.copy()
    doubtful[40:80, 60:100] = 0.7
    low = np.full_like(doubtful, 0.8)
    low[40:80, 60:100] = 0.3
    depths[3] = StereoDepth(doubtful, low, CAMERA)
    mesh = fuse_stereo(views, depths, 0.02).mesh()
    radius = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    assert len(mesh.triangles) > 3000
    assert np.abs(radius - RADIUS).max() < 0.06 and np.quantile(np.abs(radius - RADIUS), 0.95) < 0.01
    assert not (np.linalg.norm(mesh.vertices - views.world_from_camera[3, :3, 3], axis=1) < 0.9).any()


def test_no_depth_at_all_is_refused() -> None:
    views, depths = sphere_views()
    nothing = [StereoDepth(np.zeros_like(one.depth), np.zeros_like(one.depth), CAMERA) for one in depths]
    with pytest.raises(InputError, match="--poses sfm"):
        fuse_stereo(views, nothing)
