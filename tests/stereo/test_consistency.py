"""Views that confirm each other's depth, and depth maps in their file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from fieldfuse.camera import Array
from fieldfuse.errors import InputError
from fieldfuse.stereo.consistency import DepthMaps, confirmed
from fieldfuse.stereo.maps import load_stereo, save_stereo
from fieldfuse.stereo.match import StereoDepth
from tests.tsdf.scenes import CAMERA, plane_frame, ring, sphere_frame

CENTRE, RADIUS = np.array([0.1, -0.2, 0.3]), 0.5
POSES = ring(CENTRE, 1.6, 12)
EXACT = [sphere_frame(pose, CENTRE, RADIUS).depth for pose in POSES]


def check(index: int, others: list[int], depths: list[Array], **options: float) -> tuple[Array, Array]:
    return confirmed(index, others, DepthMaps(depths, [CAMERA] * len(depths), POSES[: len(depths)]), **options)  # type: ignore[arg-type]


def test_exact_depth_is_confirmed_and_stays() -> None:
    depth, confidence = check(0, [1, 2, 10, 11], EXACT)
    known = EXACT[0] > 0
    assert (depth > 0)[known].mean() > 0.9
    assert not depth[~known].any() and not confidence[~known].any()
    assert np.quantile(np.abs(depth - EXACT[0])[depth > 0] / EXACT[0][depth > 0], 0.95) < 0.005
    assert confidence[60, 80] == pytest.approx(4 / 5)


def test_noise_becomes_smaller_by_averaging() -> None:
    rng = np.random.default_rng(0)
    noisy = [np.where(depth > 0, depth * (1 + 0.005 * rng.standard_normal(depth.shape)), 0).astype(np.float32) for depth in EXACT]
    depth, _ = check(0, [1, 2, 3, 9, 10, 11], noisy)
    kept = depth > 0
    before, after = (np.std((one - EXACT[0])[kept] / EXACT[0][kept]) for one in (noisy[0], depth))
    assert kept.mean() > 0.8 * (EXACT[0] > 0).mean()
    assert after < 0.75 * before


def test_what_others_do_not_see_is_dropped() -> None:
    floating = EXACT[0].copy()
    floating[50:70, 70:90] = 0.6  # in front of the sphere: others see through it
    floating[5:15, 5:15] = 1.4  # beside it: others see nothing there
    depth, _ = check(0, [1, 2, 10, 11], [floating, *EXACT[1:]])
    assert not depth[50:70, 70:90].any() and not depth[5:15, 5:15].any()
    assert depth[40, 80] > 0


def test_as_many_as_needed_have_to_agree() -> None:
    wrong = [np.where(depth > 0, depth * 0.9, 0).astype(np.float32) for depth in EXACT]
    one_right = [EXACT[0], EXACT[1], *wrong[2:]]
    assert (check(0, [1], one_right, needed=1)[0] > 0).mean() > 0.1
    assert not check(0, [1], one_right, needed=2)[0].any()
    # A second view that sees the surface elsewhere outvotes nothing, a third and fourth that see through it do.
    through = [EXACT[0], EXACT[1], *(depth * 1.1 for depth in EXACT[2:])]
    assert not check(0, [1, 2, 10, 11], through, needed=1)[0][50:70, 70:90].any()


def test_specks_are_dropped_and_large_patches_are_not() -> None:
    speck = [np.zeros_like(depth) for depth in EXACT]
    patch = [np.zeros_like(depth) for depth in EXACT]
    for index in (0, 1, 11):
        speck[index][59:61, 79:81] = EXACT[index][59:61, 79:81]
        patch[index][40:80, 60:100] = EXACT[index][40:80, 60:100]
    assert not check(0, [1, 11], speck, needed=1)[0].any()
    assert (check(0, [1, 11], patch, needed=1)[0] > 0).sum() > 400


def test_a_plane_far_from_zero_is_confirmed_too() -> None:
    """Speckle removal works in shares of depth, whatever the unit."""
    pose = np.eye(4)
    shifted = [pose.copy() for _ in range(3)]
    for index, one in enumerate(shifted):
        one[0, 3] = 40.0 * index
    depths = [plane_frame(one, np.array([0.0, 0, 1]), 99.0).depth * 1.0 for one in shifted]
    kept, _ = confirmed(0, [1, 2], DepthMaps(depths, [CAMERA] * 3, np.array(shifted)), needed=1)
    assert (kept > 0).mean() > 0.5 and kept.max() == pytest.approx(99, rel=1e-4)


def test_depth_maps_come_back_from_their_file(tmp_path: Path) -> None:
    depths = [StereoDepth(depth, np.where(depth > 0, 0.8, 0).astype(np.float32), CAMERA, 0.01 * k) for k, depth in enumerate(EXACT[:2])]
    path = tmp_path / "depths.safetensors"
    save_stereo(path, ["a", "b"], depths)
    names, back = load_stereo(path)
    assert names == ["a", "b"]
    for one, other in zip(depths, back, strict=True):
        assert np.array_equal(one.depth, other.depth) and np.allclose(one.confidence, other.confidence, atol=0.002)
        assert one.intrinsics == other.intrinsics and one.noise == other.noise
    damaged = path.read_bytes()[:-500]
    path.write_bytes(damaged)
    for bad in (path, tmp_path / "none.safetensors"):
        with pytest.raises(InputError, match="cannot be read"):
            load_stereo(bad)
    other_shape = StereoDepth(depths[0].depth[:50], depths[0].confidence[:50], CAMERA)
    save_stereo(path, ["a"], [other_shape])
    with pytest.raises(InputError, match="does not fit its camera"):
        load_stereo(path)


def far_wall(noise: float) -> tuple[list[Array], Array]:
    """Maps of a wall at a depth of 10 and, in their left half, one at 1, by four cameras side by side; inverse depths are off by `noise`
    on average. And the poses."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(4)
    depths = []
    for pose in poses:
        depth = plane_frame(pose, np.array([0.0, 0, 1]), 10.0).depth.astype(np.float64)
        depth[:, : depth.shape[1] // 2] /= 10
        depths.append((1 / (1 / depth + noise * rng.standard_normal(depth.shape))).astype(np.float32))
    return depths, poses


def test_what_is_far_need_not_agree_to_a_share_of_its_depth() -> None:
    """Inverse depths that are off by 0.004: 4% of the depth of the far wall, 0.4% of the near one's."""
    depths, poses = far_wall(0.004)
    maps, middle = DepthMaps(depths, [CAMERA] * 4, poses), depths[0].shape[1] // 2
    near, far = np.s_[:, 4 : middle - 12], np.s_[:, middle + 12 : -12]
    strict = confirmed(0, [1, 2, 3], maps, needed=2)[0]
    lenient = confirmed(0, [1, 2, 3], maps, needed=2, noise=0.015)[0]
    assert (strict[near] > 0).mean() > 0.95 and (strict[far] > 0).mean() < 0.5
    assert (lenient[near] > 0).mean() > 0.95 and (lenient[far] > 0).mean() > 0.95
    off, was = (np.abs(one[far] - 10)[lenient[far] > 0].mean() for one in (lenient, depths[0]))
    assert off < 0.65 * was  # the mean with those that agree is better than each of them
    np.testing.assert_allclose(lenient[near], strict[near], rtol=0.02)


def test_noise_lets_no_floater_stay() -> None:
    depths, poses = far_wall(0.001)
    depths[0][40:60, 100:130] = 3.0  # well before the far wall: inverse depth off by 0.23
    kept, _ = confirmed(0, [1, 2, 3], DepthMaps(depths, [CAMERA] * 4, poses), needed=2, noise=0.015)
    assert not kept[40:60, 100:130].any() and (kept[:30, 100:130] > 0).all()


def test_files_without_noise_are_read_and_noise_that_cannot_be_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "depths.safetensors"
    about = {"names": ["a"], "cameras": [CAMERA.to_dict()]}
    tensors = {"depth.0": EXACT[0], "confidence.0": np.zeros(EXACT[0].shape, np.uint8)}
    save_file(tensors, path, metadata={"stereo": json.dumps(about)})
    assert load_stereo(path)[1][0].noise == 0
    for bad in ([0.0, 0.0], [], [-1.0], [float("nan")], ["much"], None):
        save_file(tensors, path, metadata={"stereo": json.dumps({**about, "noise": bad})})
        with pytest.raises(InputError, match="cannot be read"):
            load_stereo(path)
