"""`transforms.json`: cameras in all their spellings, frames, depth, masks, points, and what must be refused."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fieldfuse.camera import FISHEYE, OPENCV, PINHOLE
from fieldfuse.capture import open_capture
from fieldfuse.capture.transforms import read_transforms
from fieldfuse.errors import InputError
from tests.capture.layouts import OFF_CENTRE, half_size, write_transforms
from tests.capture.made import Pinhole, eyes, pixel_error, render, save_depth, save_picture
from tests.conftest import shared_data


def edit(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path = root / "transforms.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_transforms(tmp_path)
    return tmp_path


def test_frames_depth_and_defaults(root: Path) -> None:
    capture = read_transforms(root)
    assert capture.depth_scale == pytest.approx(1000)
    assert all(frame.depth is not None and frame.depth_intrinsics is None for frame in capture.frames)
    assert capture.extra == {"listed": 5, "missing": 0}
    assert capture.warnings == ()
    assert capture.frames[0].intrinsics.lens == PINHOLE


def test_per_frame_cameras_go_before_the_shared_one(root: Path) -> None:
    def change(data: dict) -> None:
        for index, frame in enumerate(data["frames"]):
            frame.update(fl_x=60.0 + index, fl_y=61.0 + index, cx=40.0, cy=31.0, w=80, h=60)

    edit(root, change)
    assert [frame.intrinsics.fx for frame in read_transforms(root).frames] == [60.0, 61.0, 62.0, 63.0, 64.0]


def test_a_camera_angle_alone_gives_the_focal_length(root: Path) -> None:
    def change(data: dict) -> None:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del data[key]
        data["camera_angle_x"] = 2 * np.arctan(40 / 71.0)

    edit(root, change)
    intrinsics = read_transforms(root).frames[0].intrinsics
    assert (intrinsics.fx, intrinsics.fy) == pytest.approx((71.0, 71.0))
    assert (intrinsics.cx, intrinsics.cy, intrinsics.width, intrinsics.height) == (40, 30, 80, 60)
    edit(root, lambda data: data.update(camera_angle_y=2 * np.arctan(30 / 73.0)))
    assert read_transforms(root).frames[0].intrinsics.fy == pytest.approx(73.0)


@pytest.mark.parametrize(
    ("fields", "lens", "distortion"),
    [
        ({"k1": 0.1, "k2": -0.02, "p1": 1e-3, "p2": 2e-3}, OPENCV, (0.1, -0.02, 1e-3, 2e-3)),
        ({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.3, "p2": 2e-3}, OPENCV, (0.1, 0.0, 0.0, 2e-3, 0.3)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}, FISHEYE, (0.1, 0.2, 0.3, 0.4)),
        ({"is_fisheye": True, "k1": 0.1}, FISHEYE, (0.1, 0.0, 0.0, 0.0)),
        ({"camera_model": "PINHOLE", "k1": 0.1}, OPENCV, (0.1, 0.0, 0.0, 0.0)),
        ({"camera_model": "PINHOLE", "k1": 0.0, "k4": 0}, PINHOLE, ()),
        ({"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0}, PINHOLE, ()),
    ],
)
def test_lenses(root: Path, fields: dict[str, Any], lens: str, distortion: tuple[float, ...]) -> None:
    edit(root, lambda data: data.update(fields))
    intrinsics = read_transforms(root).frames[0].intrinsics
    assert (intrinsics.lens, intrinsics.distortion) == (lens, distortion)


def test_a_pinhole_with_lens_coefficients_is_told(root: Path) -> None:
    edit(root, lambda data: data.update(camera_model="SIMPLE_PINHOLE", k1=0.1))
    assert read_transforms(root).warnings == (
        "5 images with a PINHOLE camera and lens coefficients (k1, …), which are applied as in nerfstudio; "
        "remove them from the json if the images are undistorted already",
    )
    edit(root, lambda data: data.update(camera_model="OPENCV"))
    assert read_transforms(root).warnings == ()


def test_listed_files_that_do_not_exist_are_counted(root: Path) -> None:
    for name in ("images/0001.png", "images/0003.png", "depth/0004.png"):
        (root / name).unlink()
    capture = read_transforms(root)
    assert len(capture.frames) == 3
    assert capture.extra == {"listed": 5, "missing": 2}
    assert capture.warnings == ("2 of the 5 listed images do not exist; the other 3 are used", "1 listed depth image not found")
    for path in (root / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="none of the 5 images"):
        read_transforms(root)


def test_intrinsics_for_larger_pictures_need_their_size(root: Path) -> None:
    larger = {"fl_x": 2 * 71.0, "fl_y": 2 * 73.0, "cx": 2 * 42.25, "cy": 2 * 27.5}
    edit(root, lambda data: data.update(larger, w=160, h=120))
    assert pixel_error(read_transforms(root), eyes(), OFF_CENTRE) < 1e-3
    edit(root, lambda data: (data.pop("w"), data.pop("h")))
    with pytest.raises(InputError, match="2 times as large"):
        read_transforms(root)
    edit(root, lambda data: data.update(fl_x=71.0, fl_y=73.0, cx=70.0, cy=27.5))  # far from the centre, and no size explains it
    assert read_transforms(root).frames[0].intrinsics.cx == 70


def test_smaller_pictures_scale_the_camera_and_say_so(root: Path) -> None:
    for index, eye in enumerate(eyes()):
        save_picture(root / f"images/{index:04d}.png", render(eye, half_size(OFF_CENTRE))[0])
    capture = read_transforms(root)
    assert pixel_error(capture, eyes(), half_size(OFF_CENTRE)) < 1e-3
    assert capture.warnings == ("5 images of another size than in the json; intrinsics were scaled to fit",)
    assert capture.frames[0].depth_intrinsics.width == 80


def test_the_frame_of_the_json_is_kept(root: Path) -> None:
    before = read_transforms(root)
    applied = [[1.0, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]
    edit(root, lambda data: data.update(applied_transform=applied, applied_scale=0.5))
    capture = read_transforms(root)
    for one, two in zip(before.frames, capture.frames, strict=True):
        np.testing.assert_array_equal(one.world_from_camera, two.world_from_camera)
    assert capture.extra["applied_transform"] == [*applied, [0, 0, 0, 1]]
    assert capture.extra["applied_scale"] == 0.5
    assert capture.depth_scale == pytest.approx(2000), "stored millimetres of the earlier frame are half as long here"


def test_units_of_depth(root: Path) -> None:
    edit(root, lambda data: data.update(depth_unit_scale_factor=2e-4))
    assert read_transforms(root).depth_scale == pytest.approx(5000)
    edit(root, lambda data: data.update(integer_depth_scale=1 / 4000, applied_scale=7.0))
    assert read_transforms(root).depth_scale == pytest.approx(4000), "instant-ngp's factor is for the json's own unit"


def test_masks_splits_and_points(root: Path) -> None:
    save_depth(root / "masks/0000.png", np.ones((60, 80)), 255)

    def change(data: dict) -> None:
        data["frames"][0]["mask_path"] = "masks/0000.png"
        data["frames"][1]["mask_path"] = "masks/0001.png"
        names = [frame["file_path"] for frame in data["frames"]]
        data.update(train_filenames=names[:2], val_filenames=names[2:3], test_filenames=names[3:], ply_file_path="points.ply")

    edit(root, change)
    columns = "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar red\n"
    header = "ply\nformat {}\ncomment made\nelement vertex 2\n" + columns + "end_header\n"
    (root / "points.ply").write_text(header.format("ascii 1.0") + "1 2 3 255\n4 5 6 0\n")
    capture = read_transforms(root)
    assert capture.frames[0].mask == root / "masks/0000.png"
    assert capture.frames[1].mask is None
    assert "1 listed mask not found" in capture.warnings
    assert [(frame.name, frame.split) for frame in capture.frames] == [
        ("0000", "train"),
        ("0001", "train"),
        ("0003", "test"),
        ("0004", "test"),
    ]
    np.testing.assert_array_equal(capture.points, [[1, 2, 3], [4, 5, 6]])
    rows = np.array([(1, 2, np.nan, 9), (4, 5, 6, 9)], dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1")])
    (root / "points.ply").write_bytes(header.format("binary_little_endian 1.0").encode() + rows.tobytes())
    np.testing.assert_array_equal(read_transforms(root).points, [[4, 5, 6]])
    (root / "points.ply").write_bytes(header.format("binary_little_endian 1.0").encode() + rows.tobytes()[:-1])
    with pytest.raises(InputError, match="fewer vertices"):
        read_transforms(root)


@pytest.mark.parametrize("spelling", ["images/{}", "./images/{}", "images\\{}", "images//../images/{}"])
def test_splits_in_other_spellings(root: Path, spelling: str) -> None:
    def change(data: dict) -> None:
        names = [spelling.format(f"{index:04d}.png") for index in range(5)]
        data.update(train_filenames=names[:3], test_filenames=names[3:], val_filenames=[])

    edit(root, change)
    capture = read_transforms(root)
    assert [frame.split for frame in capture.frames] == ["train"] * 3 + ["test"] * 2
    assert capture.warnings == ()


def test_a_split_that_names_no_frame_is_told(root: Path) -> None:
    edit(root, lambda data: data.update(train_filenames=["a.png"], test_filenames=["b.png"], val_filenames=["images/0001.png"]))
    capture = read_transforms(root)
    assert [frame.split for frame in capture.frames] == [None, "test", None, None, None], "validation stands in for a missing test"
    assert capture.warnings == tuple(
        f"'{split}_filenames' of transforms.json names none of its frames and is ignored" for split in ("train", "test")
    )


def test_pictures_with_alpha(root: Path) -> None:
    assert not read_transforms(root).alpha
    cv2.imwrite(str(root / "images/0002.png"), np.zeros((60, 80, 4), np.uint8))
    assert read_transforms(root).alpha


def first(data: dict) -> dict:
    return data["frames"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: [frame.update(file_path=f"../../out/{i}.png") for i, frame in enumerate(d["frames"])], "outside the capture folder"),
        (lambda d: first(d).update(file_path="a\0b"), "not usable"),
        (lambda d: first(d).update(file_path=3), "frame 0 has no 'file_path'"),
        (lambda d: d.update(frames=[]), "lists no frames"),
        (lambda d: d.pop("frames"), "lists no frames"),
        (lambda d: d.update(frames={"a": 1}), "lists no frames"),
        (lambda d: d["frames"].append({**d["frames"][1], "file_path": d["frames"][0]["file_path"]}), "listed twice, with different poses"),
        (lambda d: first(d).pop("transform_matrix"), "no 'transform_matrix'"),
        (lambda d: first(d)["transform_matrix"][0].pop(), "not a 4×4 matrix"),
        (lambda d: first(d).update(transform_matrix=[[1, 0], [0, 1]]), "shape"),
        (lambda d: first(d)["transform_matrix"][0].__setitem__(3, 1e200), r"frame 0 .*translation is 1e\+200"),
        (lambda d: first(d).update(transform_matrix=[["a"] * 4] * 4), "not a 4×4 matrix"),
        (lambda d: [f.update(transform_matrix=np.diag([2.0, 2, 1, 1]).tolist()) for f in d["frames"][:2]], r"frame 0 .*not rigid"),
        (lambda d: first(d).update(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), r"frame 0 .*mirrors"),
        (lambda d: d.update(fl_x=-500), "must be positive"),
        (lambda d: d.update(fl_x=0), "must be positive"),
        (lambda d: (d.pop("fl_x"), d.pop("fl_y")), "no focal length"),
        (lambda d: (d.pop("fl_x"), d.pop("fl_y"), d.update(camera_angle_x=4.0)), "between 0 and π"),
        (lambda d: d.update(fl_x="wide"), "'fl_x' must be a finite number"),
        (lambda d: d.update(cx=float("inf")), "'cx' must be a finite number"),
        (lambda d: d.update(k1=True), "'k1' must be a finite number"),
        (lambda d: d.update(cx=169.0, cy=110.0), r"principal point \(169, 110\) lies outside the 80×60 picture"),
        (lambda d: d.update(cy=-1.0), "outside the 80×60 picture"),
        (lambda d: d.update(cx=0.51, cy=0.49), "shares of the picture's size"),
        (lambda d: (d.pop("w"), d.pop("h"), d.update(cx=2 * 42.25, cy=2 * 27.5)), "2 times as large as the 80×60 one at hand; add 'w'"),
        (lambda d: (d.pop("w"), d.pop("h"), d.update(cx=4 * 42.25, cy=4 * 27.5)), "an image 4 times as large"),
        (lambda d: d.update(w=1e30), "image size"),
        (lambda d: d.update(w=-80), "image size"),
        (lambda d: d.update(w=60, h=80), "another shape"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "a 360° panorama is twice as wide as high"),
        (lambda d: d.update(camera_model="MIRROR_BALL"), "not supported"),
        (lambda d: d.update(camera_model="OPENCV", k4=0.1), "k4"),
        (lambda d: d.update(applied_scale=0), "'applied_scale'"),
        (lambda d: d.update(applied_transform=[1, 2]), "'applied_transform'"),
        (lambda d: d.update(train_filenames="all"), "'train_filenames'"),
    ],
)
def test_what_is_refused(root: Path, change: Callable[[dict], Any], message: str) -> None:
    edit(root, change)
    with pytest.raises(InputError, match=message) as caught:
        open_capture(root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["file_path", "depth_file_path", "mask_path", "ply_file_path"])
def test_nothing_is_read_outside_the_folder(root: Path, tmp_path_factory: pytest.TempPathFactory, key: str) -> None:
    outside = tmp_path_factory.mktemp("outside") / "other.png"
    save_picture(outside, render(eyes()[0], OFF_CENTRE)[0])
    for listed in (str(outside), f"../{outside.parent.name}/{outside.name}"):
        edit(root, lambda data, to=listed: (data if key == "ply_file_path" else first(data)).update({key: to}))
        capture = read_transforms(root)
        assert all(path is None or path.is_relative_to(root) for f in capture.frames for path in (f.image, f.depth, f.mask))
        assert capture.points is None
        assert len(capture.warnings) == 1
        assert re.search("do not exist|not found", capture.warnings[0])


def test_an_image_listed_twice_with_one_pose_counts_once(root: Path) -> None:
    edit(root, lambda data: data["frames"].append({**first(data), "file_path": "./" + first(data)["file_path"]}))
    capture = read_transforms(root)
    assert len(capture.frames) == 5
    assert capture.warnings == ("1 image listed once more with the same pose, used once",)


def test_other_names_of_intrinsics(root: Path) -> None:
    def change(data: dict) -> None:
        camera = {new: data.pop(old) for new, old in (("f1_x", "fl_x"), ("f1_y", "fl_y"), ("c1_x", "cx"), ("c1_y", "cy"))}
        for frame in data["frames"]:
            frame.update(camera, camera_angle_x=1.0, camera_angle_y=0.8)

    edit(root, change)
    capture = read_transforms(root)
    assert pixel_error(capture, eyes(), OFF_CENTRE) < 1e-3
    assert capture.warnings == ("the intrinsics of 5 images were read from other keys than 'fl_x', 'fl_y', 'cx', 'cy'",)
    edit(root, lambda data: [frame.update(f1_x=0.9, f1_y=0.9) for frame in data["frames"]])  # shares, or of something else
    assert read_transforms(root).frames[0].intrinsics.fx == pytest.approx(40 / np.tan(0.5))


def test_exchanged_camera_angles(root: Path) -> None:
    def change(data: dict) -> None:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del data[key]
        data.update(camera_angle_x=2 * np.arctan(30 / 73.0), camera_angle_y=2 * np.arctan(40 / 71.0), cx=0, cy=0)

    edit(root, change)
    capture = read_transforms(root)
    assert (capture.frames[0].intrinsics.fx, capture.frames[0].intrinsics.fy) == pytest.approx((71.0, 73.0))
    assert (capture.frames[0].intrinsics.cx, capture.frames[0].intrinsics.cy) == (40, 30)
    assert [any(word in warning for warning in capture.warnings) for word in ("exchanged", "(0, 0)")] == [True, True]


@pytest.mark.parametrize(
    ("turn", "said"), [(np.diag([-1.0, -1, -1, 1]), "all camera axes"), (np.diag([1.0, -1, 1, 1]), "y axis"), (None, "world's z axis")]
)
def test_poses_that_all_mirror_space(tmp_path: Path, turn: np.ndarray | None, said: str) -> None:
    """Which axes are wrong is seen on matches: of a scene with details, which the others here have none of."""
    noise = np.random.default_rng(5).integers(0, 255, (120, 120, 3)).astype(np.uint8)
    noise = cv2.resize(noise, (960, 960), interpolation=cv2.INTER_CUBIC)
    camera = Pinhole(320, 240, 300.0, 300.0, 160.0, 120.0)
    frames = []
    for index, eye in enumerate(eyes()):
        _, depth = render(eye, camera)
        v, u = np.mgrid[0:240, 0:320] + 0.5
        rays = eye.forward + ((u - 160) / 300)[..., None] * eye.right + ((v - 120) / 300)[..., None] * eye.down
        points = (eye.centre + rays * depth[..., None]) * 240 + 480
        maps = points[..., :2].astype(np.float32)
        image = cv2.remap(noise, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        save_picture(tmp_path / f"images/{index}.png", image)
        pose = np.diag([1.0, 1, -1, 1]) @ eye.opengl() if turn is None else eye.opengl() @ turn
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 320, "h": 240, "fl_x": 300, "fl_y": 300, "frames": frames}))
    capture = read_transforms(tmp_path)
    assert said in capture.warnings[0]
    assert pixel_error(capture, eyes(), camera) < 1e-3


def test_links_out_of_the_folder_are_refused(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    outside = tmp_path_factory.mktemp("outside") / "secret.png"
    (root / "images/0000.png").rename(outside)
    (root / "images/0000.png").symlink_to(outside)
    with pytest.raises(InputError, match="outside the capture folder"):
        read_transforms(root)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 60_000_000,
        '{"frames":' + '[{"a":' * 5_000_000,
        '{"frames": [{"file_path": "images/0000.png", "transform_matrix": ' + "[" * 900 + "]" * 900 + "}]}",
        "[" * (100 * 2**20),
        '{"w": ' + "9" * 10_000 + "}",
        "[1, 2]",
        "",
        '{"frames": [}',
    ],
    ids=["deep", "deep objects", "deep matrix", "100 MB", "huge number", "no object", "empty", "broken"],
)
def test_hostile_json_is_refused_in_seconds(root: Path, text: str) -> None:
    (root / "transforms.json").write_text(text)
    started = time.process_time()
    with pytest.raises(InputError):
        open_capture(root)
    assert time.process_time() - started < 60  # it takes one where it was measured


def test_fox_as_it_is_published() -> None:
    capture = open_capture(shared_data("fox_540x960"))
    assert (capture.kind, len(capture.frames), capture.extra) == ("transforms", 50, {"listed": 67, "missing": 17})
    assert capture.frames[0].intrinsics.distortion == (0.0578421, -0.0805099, -0.000980296, 0.00015575)
    assert capture.warnings == ("17 of the 67 listed images do not exist; the other 50 are used",)
