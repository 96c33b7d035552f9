"""A field's surface: a stand-in field that renders exactly, with the faults that real ones have."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.export.mesh import mesh_facts
from fieldfuse.export.surface import Refinement, field_volume, reliable_depth
from fieldfuse.poses.region import Region
from fieldfuse.render.image import Rendered
from tests.tsdf.scenes import CAMERA, all_round, sphere_colour, sphere_depth, sphere_frame

CENTRE = np.array([0.2, 0.1, -0.1])
RADIUS = 0.5
POSES = all_round(CENTRE, 1.6, 32)
CAMERAS = [CAMERA] * len(POSES)


def exact(camera: Intrinsics, pose: Array) -> Rendered:
    frame = sphere_frame(pose, CENTRE, RADIUS, camera)
    return Rendered(frame.colour.astype(np.float32) / 255, frame.depth, (frame.depth > 0).astype(np.float32))


def faulty(camera: Intrinsics, pose: Array) -> Rendered:
    """Silhouettes smeared to depths behind the surface, a faint fog before the sphere, a floater that a single view shows."""
    found = exact(camera, pose)
    depth, opacity = found.depth, found.opacity
    shifted = np.roll(depth, 1, axis=1)
    smear = (depth == 0) & (shifted > 0)
    depth = np.where(smear, shifted + 0.4, depth)
    fog = depth == 0
    depth, opacity = np.where(fog, 0.8, depth).astype(np.float32), np.where(fog, 0.3, np.maximum(opacity, smear)).astype(np.float32)
    if np.allclose(pose, POSES[3]):
        depth[5:25, 5:25], opacity[5:25, 5:25] = 0.9, 1.0
    return Rendered(found.rgb, depth, opacity)


@pytest.mark.parametrize("render", [exact, faulty])
def test_the_mesh_is_the_sphere_and_nothing_else(render: Callable[..., Rendered]) -> None:
    mesh = field_volume(render, POSES, CAMERAS, 0.02).mesh().cleaned(min_area_share=2e-3)
    offset = mesh.vertices - CENTRE
    radius = np.linalg.norm(offset, axis=1)
    assert np.quantile(np.abs(radius - RADIUS), 0.98) < 0.01
    assert np.abs(radius - RADIUS).max() < 0.06
    facts = mesh_facts(mesh)
    assert facts["watertight"]
    assert facts["components"] == 1
    clear = np.abs(offset[:, 2]) > 0.04
    assert np.median(np.abs(mesh.colours[clear].astype(int) - sphere_colour(mesh.vertices[clear], CENTRE))) <= 4


def test_points() -> None:
    cloud = field_volume(exact, POSES, CAMERAS, 0.02).points()
    offset = cloud.points - CENTRE
    assert len(cloud.points) > 3000
    assert np.quantile(np.abs(np.linalg.norm(offset, axis=1) - RADIUS), 0.97) < 0.01
    assert np.median(np.einsum("ij,ij->i", cloud.normals, offset) / RADIUS) > 0.95


def test_sizes_are_chosen_and_one_camera_a_pose_is_fine() -> None:
    small = Intrinsics(120, 90, 112.0, 112.0, 60.0, 45.0)
    volume = field_volume(exact, POSES, [CAMERA, small] * 16)
    assert 0.004 < volume.voxel_size < 0.03
    assert 1.2 < volume.depth_max < 1.7


def test_what_is_rendered_may_be_smaller_than_its_depth_map() -> None:
    """Half as wide; nobody polishes, so a voxel's error is that of a coarser picture, and colours are where they belong."""

    def half(camera: Intrinsics, pose: Array) -> Rendered:
        return exact(camera.scaled(camera.width // 2, camera.height // 2), pose)

    mesh = field_volume(half, POSES, CAMERAS, 0.02).mesh().cleaned(min_area_share=2e-3)
    offset = mesh.vertices - CENTRE
    assert np.quantile(np.abs(np.linalg.norm(offset, axis=1) - RADIUS), 0.95) < 0.012
    clear = np.abs(offset[:, 2]) > 0.04
    assert np.median(np.abs(mesh.colours[clear].astype(int) - sphere_colour(mesh.vertices[clear], CENTRE))) <= 6


def test_the_region_is_kept_and_the_rest_is_not() -> None:
    region = Region.box(CENTRE - 1.0, CENTRE + np.array([1, 1, 0]))  # the lower half
    mesh = field_volume(exact, POSES, CAMERAS, 0.02, region=region).mesh()
    assert mesh.vertices[:, 2].max() < CENTRE[2] + 0.03
    assert mesh.vertices[:, 2].min() < CENTRE[2] - RADIUS + 0.03


def test_what_is_made_of_all_maps_together_is_what_is_fused() -> None:
    """It is given what is reliable, and all that is opaque, edges too."""
    asked: list[tuple[int, int]] = []

    def settle(reliable: list[Array], opaque: list[Array], told: list[Array]) -> list[Array]:
        assert all(where.all() for where in told)  # nobody polished, so nobody says otherwise
        asked.extend(((depth > 0).sum(), (all_of_it > 0).sum()) for depth, all_of_it in zip(reliable, opaque, strict=True))
        return [np.where(np.arange(depth.shape[1]) < depth.shape[1] // 2, depth, 0).astype(np.float32) for depth in reliable]

    half = field_volume(faulty, POSES[:1], [CAMERA], 0.02, refinement=Refinement(settle=settle)).mesh()
    assert len(asked) == 1 and 0 < asked[0][0] < asked[0][1]
    there = (half.vertices - POSES[0][:3, 3]) @ POSES[0][:3, :3]
    assert (there[:, 0] < 0.03).all() and len(half.vertices) > 100


def test_thinned_when_asked() -> None:
    mesh = field_volume(exact, POSES, CAMERAS, 0.02).mesh().cleaned().decimated(1500)
    assert 1000 < len(mesh.triangles) <= 1500
    assert np.quantile(np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS), 0.9) < 0.02


def test_edges_and_faint_pixels_are_dropped_and_slopes_are_not() -> None:
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:] = 3.0
    depth[4, 4] = np.nan
    opacity = np.ones_like(depth)
    opacity[10:, :5] = 0.6
    kept = reliable_depth(depth, opacity, 100.0)
    assert not kept[:, 14:16].any()
    assert (kept[:10, 6:13] == 2).all()
    assert (kept[:, 17:] == 3).all()
    assert not kept[10:, :5].any()
    assert kept[4, 4] == 0
    assert kept[4, 5] == 2  # a missing neighbour is no edge
    # A plane seen at 70°: its depth changes by 2.7 pixel widths a pixel, everywhere.
    u = (np.arange(30) + 0.5 - 15) / 100.0
    slope = np.broadcast_to(1 / (1 - np.tan(np.deg2rad(70)) * u), (20, 30)).astype(np.float32)
    assert (reliable_depth(slope, np.ones_like(slope), 100.0)[:, :22] > 0).all()


def test_what_has_no_surface_is_refused() -> None:
    def nothing(camera: Intrinsics, pose: Array) -> Rendered:
        found = exact(camera, pose)
        return Rendered(found.rgb, found.depth, np.zeros_like(found.depth))

    with pytest.raises(InputError, match="no rendered view shows a surface"):
        field_volume(nothing, POSES[:3], CAMERAS[:3], 0.02)
    with pytest.raises(InputError, match="2 cameras and 3 poses"):
        field_volume(exact, POSES[:3], [CAMERA] * 2, 0.02)
    with pytest.raises(InputError, match="finer than the pixels"):
        field_volume(exact, POSES, CAMERAS, 1e-4)


def test_depth_of_the_scene_is_what_the_renderer_says() -> None:
    assert exact(CAMERA, POSES[0]).depth == pytest.approx(sphere_depth(CAMERA, POSES[0], CENTRE, RADIUS))
