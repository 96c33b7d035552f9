"""Whatever bytes lie in a capture's own files, a reader gives a capture or an `InputError`, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from fieldfuse.capture import open_capture
from fieldfuse.errors import InputError
from tests.capture.layouts import LAYOUTS

FILES = {
    "transforms": ("transforms.json",),
    "blender": ("transforms_test.json",),
    "colmap bin": ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    "colmap txt": ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"),
    "7scenes": ("frame-000002.pose.txt",),
    "tum": ("rgb.txt", "depth.txt", "groundtruth.txt"),
    "scannet": ("pose/10.txt", "intrinsic/intrinsic_color.txt"),
    "sens": ("scene0000_00.sens",),
    "llff": ("poses_bounds.npy",),
    "dtu": ("cameras.npz",),
    "redwood": ("trajectory.log", "camera_intrinsics.json"),
    "replica": ("traj.txt", "cam_params.json"),
    "polycam": ("keyframes/corrected_cameras/100333.json",),
    "stray": ("odometry.csv", "camera_matrix.csv"),
    "record3d": ("metadata",),
    "scanner3d": ("frame_00002.json",),
    "metashape": ("cameras.xml",),
    "realitycapture": ("registration.csv",),
    "xmp": ("IMG_02.xmp",),
    "opensfm": ("opensfm/reconstruction.json",),
    "meshroom": ("MeshroomCache/StructureFromMotion/0a1b/cameras.sfm",),
    "bundler": ("bundle.out", "list.txt"),
    "scannetpp": ("dslr/nerfstudio/transforms_undistorted.json",),
    "rgbd": ("truth_cam_poses.txt", "TUM3.yaml"),
    "arkitscenes": ("lowres_wide.traj", "lowres_wide_intrinsics/41069021_305.377.pincam"),
}
CASES = [(layout, name) for layout, names in FILES.items() for name in names]


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    out = {}
    for layout in FILES:
        out[layout] = tmp_path_factory.mktemp(layout.replace(" ", "_"))
        LAYOUTS[layout][1](out[layout])
    yield out


def accepts_or_refuses(root: Path, name: str, content: bytes) -> None:
    path = root / name
    whole = path.read_bytes()
    try:
        path.write_bytes(content)
        try:
            open_capture(root)
        except InputError as error:
            assert len(str(error).splitlines()) == 1 and "\x1b" not in str(error)
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize(("layout", "name"), CASES)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=300) | st.text(max_size=60).map(lambda text: text.encode("utf-8", "replace")))
def test_any_bytes(captures: dict[str, Path], layout: str, name: str, content: bytes) -> None:
    accepts_or_refuses(captures[layout], name, content)


@pytest.mark.parametrize(("layout", "name"), CASES)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files(captures: dict[str, Path], layout: str, name: str, data: st.DataObject) -> None:
    whole = bytearray((captures[layout] / name).read_bytes())
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at : at + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=9))
    accepts_or_refuses(captures[layout], name, bytes(whole[: data.draw(st.integers(at, len(whole)))]))


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=6)
    | st.sampled_from(["../x", "/etc", "images", "", "a" * 5000]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=2),
    max_leaves=6,
)
KEYS = ["fl_x", "fl_y", "cx", "w", "h", "k1", "k4", "camera_model", "is_fisheye", "applied_transform", "applied_scale", "ply_file_path",
        "integer_depth_scale", "train_filenames", "frames"]  # fmt: skip
FRAME_KEYS = ["file_path", "transform_matrix", "depth_file_path", "mask_path", "fl_x", "w", "camera_model"]


@example("fl_x", "fl_x", "two\nlines, \x1b[2J and a half \ud800", False)
@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(KEYS), frame_key=st.sampled_from(FRAME_KEYS), value=VALUES, in_frame=st.booleans())
def test_any_value_at_any_key_of_transforms(captures: dict[str, Path], key: str, frame_key: str, value: object, in_frame: bool) -> None:
    root = captures["transforms"]
    data = json.loads((root / "transforms.json").read_text())
    if in_frame:
        data["frames"][1][frame_key] = value
    else:
        data[key] = value
    accepts_or_refuses(root, "transforms.json", json.dumps(data).encode())
