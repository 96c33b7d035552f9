"""Record3D's recordings: in one file or unpacked, held upright or lying, cut, without poses; and what such a file may hold otherwise."""

from __future__ import annotations

import json
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.images import load_depth, load_image
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from tests.capture.layouts import PHONE, quarter_size, write_polycam, write_record3d, zipped
from tests.capture.made import Pinhole, eyes, pixel_error, render, save_picture

codecs = pytest.importorskip("imagecodecs", reason="imagecodecs is not installed; make test brings it")

UPRIGHT = Pinhole(120, 160, 128.0, 129.0, 59.0, 81.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("made")
    write_record3d(root)
    return root


@pytest.fixture
def recording(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "recording"))


def told(root: Path, **changes: object) -> Path:
    """The recording with other words in its `metadata`; those that are None are missing."""
    data = json.loads((root / "metadata").read_text()) | changes
    (root / "metadata").write_text(json.dumps({key: value for key, value in data.items() if value is not None}))
    return root


def is_true(capture: Capture, camera: Pinhole = PHONE) -> None:
    """Cameras and depth are those of the made-up scene, and what the sensor does not believe is left out."""
    assert pixel_error(capture, eyes(), camera) < 1e-3
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        depth, true = load_depth(frame, capture), render(eye, quarter_size(camera))[1]
        assert (depth[:, :2] == 0).all()
        np.testing.assert_allclose(depth[:, 2:], true[:, 2:], rtol=1e-6)
        assert np.abs(load_image(frame).astype(int) - render(eye, camera)[0]).mean() < 4


# ------------------------------------------------------------------------------------------------ what is read


@pytest.mark.parametrize("folder", ["", "2026-11-28--10-00-00/"])
@pytest.mark.parametrize("name", ["walk.r3d", "WALK.R3D", "walk.zip"])
def test_a_file_is_what_it_unpacks_to(recording: Path, tmp_path: Path, name: str, folder: str) -> None:
    (tmp_path / "files").mkdir()
    path = zipped(recording, tmp_path / "files" / name, folder)
    capture = open_capture(path)
    is_true(capture)
    assert capture.kind == "record3d" and capture.metric and capture.ordered and capture.filmed and capture.up == (0, 1, 0)
    assert capture.extra == {"fps": 60, "width": 160, "height": 120, "seconds": 5 / 60} and not capture.warnings
    is_true(capture_from_dict(json.loads(json.dumps(capture_to_dict(capture)))))
    if path.suffix != ".zip":
        assert capture_to_dict(open_capture(path.parent)) == capture_to_dict(capture), "a folder with one recording is that recording"


@pytest.mark.parametrize("changes", [{}, {"dw": None, "dh": None}, {"dw": 40, "dh": 30}, {"w": None, "h": None}])
def test_recordings_that_were_held_upright(tmp_path: Path, changes: dict) -> None:
    write_record3d(tmp_path, UPRIGHT)
    is_true(open_capture(told(tmp_path, **changes)), UPRIGHT)


def test_pictures_that_were_made_smaller_since(recording: Path) -> None:
    twice = [[2 * value for value in (PHONE.fx, PHONE.fy, PHONE.cx, PHONE.cy)]] * 5
    matrix = [2 * PHONE.fx, 0, 0, 0, 2 * PHONE.fy, 0, 2 * PHONE.cx, 2 * PHONE.cy, 1]
    is_true(open_capture(told(recording, w=320, h=240, K=matrix, perFrameIntrinsicCoeffs=twice)))


def test_each_frame_has_its_own_camera_unless_it_is_that_of_a_turned_picture(recording: Path) -> None:
    own = [[PHONE.fx + at, PHONE.fy, PHONE.cx + at, PHONE.cy] for at in range(4)]
    own[3] = [PHONE.fx, PHONE.fy, PHONE.cy, PHONE.cx]
    capture = open_capture(told(recording, perFrameIntrinsicCoeffs=own))
    assert [frame.intrinsics.fx for frame in capture.frames] == [128, 129, 130, 128, 128]
    assert [frame.intrinsics.cx for frame in capture.frames] == [81, 82, 83, 81, 81]
    assert "the cameras of 1 frame are far from" in capture.warnings[0]
    is_true(open_capture(told(recording, perFrameIntrinsicCoeffs=None)))
    is_true(open_capture(told(recording, K=None, perFrameIntrinsicCoeffs=[[PHONE.fx, PHONE.fy, PHONE.cx, PHONE.cy]] * 5)))


def test_pictures_and_poses_go_together_by_number_where_some_are_missing(recording: Path) -> None:
    (recording / "rgbd" / "1.jpg").unlink()
    (recording / "rgbd" / "2.depth").unlink()
    capture = open_capture(recording)
    assert [frame.image.name for frame in capture.frames] == ["0.jpg", "2.jpg", "3.jpg", "4.jpg"]
    assert pixel_error(capture, [eye for at, eye in enumerate(eyes()) if at != 1], PHONE) < 1e-3
    assert [frame.depth is None for frame in capture.frames] == [False, True, False, False]
    assert capture.warnings == ("the recording has 4 images and 5 poses; 4 are used, which go together by number",)


def test_a_cut_recording_whose_pictures_go_on_counting(recording: Path) -> None:
    for path in sorted((recording / "rgbd").iterdir()):
        path.rename(path.with_name(f"{int(path.stem) + 40}{path.suffix}"))
    is_true(open_capture(recording))


@pytest.mark.parametrize("poses", [None, [], [[0, 0, 0, 1, 0, 0, 0]] * 5])
def test_recordings_of_the_front_camera_have_no_poses(recording: Path, poses: list | None) -> None:
    capture = open_capture(told(recording, poses=poses))
    assert not capture.posed and capture.has_depth and len(capture.frames) == 5 and "has no poses" in capture.warnings[0]


def test_up_is_not_told_where_the_first_pose_is_zero(recording: Path) -> None:
    poses = json.loads((recording / "metadata").read_text())["poses"]
    poses[0][:4] = [0, 0, 0, 1]
    assert open_capture(told(recording, poses=poses)).up is None


# ------------------------------------------------------------------------------------------------ what is chosen


@pytest.mark.parametrize("packed", [True, False])
def test_chosen_frames_are_the_files_of_the_recording(recording: Path, tmp_path: Path, packed: bool) -> None:
    (recording / "rgbd" / "2.jpg").write_bytes(b"not an image")  # as the app leaves some behind
    (recording / "rgbd" / "3.depth").write_bytes(b"not a map")
    capture = open_capture(zipped(recording, tmp_path / "a.r3d") if packed else recording)
    assert check_capture(capture) is capture
    chosen = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=10))
    assert chosen.posed and not chosen.filmed and chosen.kind == "record3d" and chosen.extra["selected_from"] == 5
    numbers = [int(frame.name.removeprefix("frame_")) for frame in chosen.frames]
    assert numbers == [0, 1, 3, 4] and chosen.warnings == ("the depth of 1 chosen frame is damaged and left out", *chosen.warnings[1:])
    for number, frame in zip(numbers, chosen.frames, strict=True):
        before = capture.frames[number]
        assert frame.image.read_bytes() == (recording / "rgbd" / f"{number}.jpg").read_bytes()
        assert (frame.intrinsics, frame.confidence) == (before.intrinsics, None)
        assert frame.image.parent == (tmp_path / "run" / "frames").resolve() and (frame.depth is None) == (number == 3)
        if frame.depth is not None:
            np.testing.assert_array_equal(load_depth(frame, chosen), load_depth(before, capture))
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "run" / "frames").rglob("*.*")}
    again = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=10))
    assert capture_to_dict(again) == capture_to_dict(chosen)
    assert times == {path: path.stat().st_mtime_ns for path in (tmp_path / "run" / "frames").rglob("*.*")}
    fewer = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=2))
    left = sorted(path.stem for path in (tmp_path / "run" / "frames").rglob("frame_*"))
    assert left == sorted([frame.name for frame in fewer.frames] + [frame.name for frame in fewer.frames if frame.depth is not None])


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_what_is_exported_as_exr_and_rgb(made: Path, tmp_path: Path, suffix: str) -> None:
    from tests.capture.test_exr import write_exr  # skips where OpenEXR is not installed

    root = tmp_path / "scan/EXR_RGBD"
    (root / "depth").mkdir(parents=True)
    for number, eye in enumerate(eyes()):
        save_picture(root / f"rgb/{number}.{suffix}", render(eye, PHONE)[0])
        depth = render(eye, quarter_size(PHONE))[1].astype(np.float32)
        write_exr(root / f"depth/{number}.exr", {"R": np.where(depth > 0, depth, np.nan)})
    shutil.copy(made / "metadata", root / "metadata.json")
    capture = open_capture(tmp_path / "scan")
    assert (capture.kind, capture.film, capture.metric) == ("record3d", True, True)
    assert pixel_error(capture, eyes(), PHONE) < 1e-3
    chosen = select_frames(capture, tmp_path / "run", CaptureSettings(max_frames=10))
    for frame, eye in zip(chosen.frames, eyes(), strict=True):
        assert frame.image.read_bytes().startswith(b"\xff\xd8"), "JPEG, whatever it was"
        np.testing.assert_allclose(load_depth(frame, chosen), render(eye, quarter_size(PHONE))[1], rtol=1e-6)
    (root / "rgb/0.jpg").unlink(missing_ok=True)
    for file in (root / "rgb").iterdir():
        file.rename(file.with_name(f"a{file.name}"))
    with pytest.raises(InputError, match="whose names are numbers"):
        open_capture(root)


# ------------------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"K": None, "perFrameIntrinsicCoeffs": None}, "has no camera"),
        ({"K": [1, 2, 3]}, "must hold 9 numbers"),
        ({"K": [1e400] * 9}, "not finite"),
        ({"K": "wide"}, "numbers only"),
        ({"K": [128, 0, 81, 0, 128, 59, 0, 0, 1]}, "corner"),  # row by row
        ({"perFrameIntrinsicCoeffs": [[1, 2]]}, "intrinsics 0 must hold"),
        ({"perFrameIntrinsicCoeffs": [[-1, 1, 80, 60]]}, "focal length"),
        ({"w": 2**60}, "'w' is 1.15292e"),
        ({"w": 160.5}, "'w' is 160.5"),
        ({"w": "wide"}, "finite number"),
        ({"dw": 2**40, "dh": 2**40}, "'dw'"),
        ({"dw": 400_000, "dh": 300_000}, "400000×300000 cannot be"),
        ({"dw": 40, "dh": 40}, "another shape"),
        ({"dw": 80, "dh": 60}, "does not hold the 80×60 values"),
        ({"poses": [[0, 0, 0, 1, float("nan"), 0, 0]] * 5}, "not finite"),
        ({"poses": [[0, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 2, 0, 0]]}, "pose 0: .* not a rotation"),
        ({"poses": [[0, 0, 0, 1, 1, 0]] * 5}, "seven numbers"),
        ({"poses": [[0, 0, 0, 1, 1, 0, 0], [1]]}, "numbers only"),
        ({"poses": 2**60}, "list of numbers"),
        ({"fps": "fast"}, "'fps'"),
    ],
)
@pytest.mark.parametrize("packed", [True, False])
def test_metadata_that_says_something_else(recording: Path, tmp_path: Path, changes: dict, said: str, packed: bool) -> None:
    told(recording, **changes)
    with pytest.raises(InputError, match=said) as caught:
        capture = open_capture(zipped(recording, tmp_path / "a.r3d") if packed else recording)
        load_depth(capture.frames[0], capture)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff\xfe", b"[" * 100_000])
def test_metadata_that_is_no_object(recording: Path, tmp_path: Path, content: bytes) -> None:
    (recording / "metadata").write_bytes(content)
    for source in (recording, zipped(recording, tmp_path / "a.r3d")):
        with pytest.raises(InputError, match="metadata"):
            open_capture(source)


def test_files_that_are_no_recording(tmp_path: Path) -> None:
    (tmp_path / "a.r3d").write_bytes(b"no zip")
    with pytest.raises(InputError, match=r"a\.r3d is no zip file"):
        open_capture(tmp_path / "a.r3d")
    write_polycam(tmp_path / "scan")
    with pytest.raises(InputError, match=r"scan\.zip is a zip file; unpack it"):
        open_capture(zipped(tmp_path / "scan", tmp_path / "scan.zip"))
    with pytest.raises(InputError, match="holds no recording of Record3D"):
        open_capture(zipped(tmp_path / "scan", tmp_path / "b.r3d"))


def test_a_file_that_is_cut_short(recording: Path, tmp_path: Path) -> None:
    whole = zipped(recording, tmp_path / "a.r3d").read_bytes()
    for size in (len(whole) - 1, len(whole) // 2, 10, 0):
        (tmp_path / "a.r3d").write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"a\.r3d is no zip file, or one that is cut short"):
            open_capture(tmp_path / "a.r3d")


def test_members_whose_names_lead_elsewhere_are_not_read(recording: Path, tmp_path: Path) -> None:
    path = zipped(recording, tmp_path / "a.r3d", "../")
    with pytest.raises(InputError, match="holds no recording"):
        open_capture(path)
    with zipfile.ZipFile(zipped(recording, path), "a") as file:
        for name in ("../rgbd/7.jpg", "/rgbd/8.jpg", "rgbd/../9.jpg", "rgbd/10.JPG"):
            file.writestr(name, b"elsewhere")
    is_true(open_capture(path))


def test_all_pictures_damaged(recording: Path) -> None:
    for path in (recording / "rgbd").glob("*.jpg"):
        path.write_bytes(b"x")
    with pytest.raises(InputError, match=r"0\.jpg is not an image"):
        open_capture(recording)


def test_without_the_package_that_reads_depth(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(InputError, match=r"needs the package imagecodecs; install it \(pip install imagecodecs\)"):
        open_capture(recording)
    for path in (recording / "rgbd").glob("*.depth"):
        path.unlink()
    capture = open_capture(recording)
    assert capture.posed and not capture.has_depth


@pytest.mark.parametrize("data", [b"", bytes(5000), codecs.lzfse_encode(bytes(40 * 30 * 4 + 4)), codecs.lzfse_encode(bytes(7))])
def test_depth_that_is_none(recording: Path, data: bytes) -> None:
    (recording / "rgbd" / "0.depth").write_bytes(data)
    capture = open_capture(recording)
    with pytest.raises(InputError, match=r"0\.depth"):
        load_depth(capture.frames[0], capture)
    with pytest.raises(InputError, match=r"0\.depth|the size of the depth"):
        open_capture(told(recording, dw=None, dh=None))
