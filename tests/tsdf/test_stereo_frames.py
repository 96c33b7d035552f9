"""The surface that is fused from depth by matching."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.tsdf.stereo_frames import fuse_stereo, stereo_frames
from tests.tsdf.scenes import CAMERA, all_round, sphere_frame

CENTRE, RADIUS = np.array([0.1, -0.2, 0.3]), 0.5


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
    assert not next(iter(stereo_frames(views.subset([3]), depths[3:4]))).depth[40:80, 60:100].any()


def test_no_depth_at_all_is_refused() -> None:
    views, depths = sphere_views()
    nothing = [StereoDepth(np.zeros_like(one.depth), np.zeros_like(one.depth), CAMERA) for one in depths]
    with pytest.raises(InputError, match="--poses sfm"):
        fuse_stereo(views, nothing)
