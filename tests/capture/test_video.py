"""Videos: containers, rotation applied once, damaged files, nothing on stderr."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.capture.images import load_image
from fieldfuse.capture.video import iterate_video, read_video
from fieldfuse.errors import InputError
from tests.capture.films import film, film_at, names, quarters, turn
from tests.conftest import shared_data


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".avi", ".mkv", ".webm"])
def test_containers(tmp_path: Path, suffix: str) -> None:
    path = film(tmp_path / f"clip{suffix}", quarters(8))
    capture = read_video(path)
    assert capture.kind == "video" and capture.ordered and not capture.posed and capture.root == tmp_path
    assert [frame.video_index for frame in capture.frames] == list(range(8))
    assert len({frame.name for frame in capture.frames}) == 8 and {frame.image for frame in capture.frames} == {path}
    assert capture.extra == {"fps": 10.0, "rotation": 0, "width": 64, "height": 48, "seconds": 0.8}
    pictures = dict(iterate_video(path))
    assert sorted(pictures) == list(range(8))
    for index, picture in pictures.items():
        assert picture.shape == (48, 64, 3) and picture.dtype == np.uint8 and names(picture) == "rgbk"  # RGB, not BGR
        assert abs(float(picture[30:42, 38:58].mean()) - 8 * index) < 6


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_pixels_that_are_not_square_are_told(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("av", reason="PyAV is not installed; make test brings it")
    times = [33 * at for at in range(8)]
    (said,) = read_video(film_at(tmp_path / f"a.{suffix}", quarters(8), times, Fraction(4, 3))).warnings
    assert "not square (4:3)" in said and f"ffmpeg -i a.{suffix} -vf scale=iw*sar:ih,setsar=1" in said
    for pixel in (None, Fraction(1)):
        assert read_video(film_at(tmp_path / f"b.{suffix}", quarters(8), times, pixel)).warnings == ()


@pytest.mark.parametrize(
    ("degrees", "upright", "size"), [(0, "rgbk", (64, 48)), (90, "brkg", (48, 64)), (180, "kbgr", (64, 48)), (270, "gkrb", (48, 64))]
)
def test_rotation_is_applied_exactly_once(tmp_path: Path, degrees: int, upright: str, size: tuple[int, int]) -> None:
    path = turn(film(tmp_path / "clip.mp4", quarters()), degrees)
    capture = read_video(path)
    assert capture.extra["rotation"] == degrees
    assert (capture.extra["width"], capture.extra["height"]) == size
    for _, picture in iterate_video(path, {0, 5}):
        assert picture.shape == (size[1], size[0], 3)
        assert names(picture) == upright
    assert names(load_image(capture.frames[3])) == upright


def test_only_wanted_frames_are_yielded(tmp_path: Path) -> None:
    path = film(tmp_path / "clip.avi", quarters(8))
    everything = dict(iterate_video(path))
    some = dict(iterate_video(path, [6, 1, 40]))
    assert sorted(some) == [1, 6]
    for index, picture in some.items():
        np.testing.assert_array_equal(picture, everything[index])
    assert list(iterate_video(path, [])) == []


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".avi", ".mkv", ".webm"])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_truncated_video_is_refused(tmp_path: Path, suffix: str, share: float) -> None:
    path = film(tmp_path / f"clip{suffix}", quarters(8))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match="cut short"):
        read_video(path)


def test_zero_readable_frames(tmp_path: Path) -> None:
    path = film(tmp_path / "clip.avi", quarters(4))
    data = bytearray(path.read_bytes())
    start = data.find(b"movi") + 4
    end = data.find(b"idx1")
    data[start:end] = bytes(end - start)
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"clip\.avi"):
        read_video(path)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "empty"),
        (b"hello, this is not a film" * 40, "not a video"),
        (b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n/etc/hostname\n#EXT-X-ENDLIST\n", "playlist"),
        (b"ffconcat version 1.0\nfile /etc/hostname\n", "playlist"),
        (b"\x00\x00\x00\x18ftypmp42" + bytes(12), "not a video"),
    ],
)
def test_not_a_video(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=text):
        read_video(path)


def test_nothing_is_said_on_stderr(tmp_path: Path) -> None:
    """In a process of its own: decoders write to the file descriptor, and their level is set when the first video is opened."""
    good = film(tmp_path / "good.mp4", quarters(8))
    data = bytearray(good.read_bytes())
    middle = data.find(b"mdat") + 400
    data[middle : middle + 300] = b"\xa5" * 300
    (tmp_path / "bad.mp4").write_bytes(bytes(data))
    (tmp_path / "text.mp4").write_text("no film" * 100)
    (tmp_path / "cut.mp4").write_bytes(good.read_bytes()[:-200])
    code = (
        "import sys, pathlib\n"
        "from fieldfuse.capture.video import read_video, iterate_video\n"
        "from fieldfuse.errors import InputError\n"
        "for name in ('bad', 'text', 'cut'):\n"
        "    path = pathlib.Path(sys.argv[1]) / f'{name}.mp4'\n"
        "    try:\n"
        "        read_video(path)\n"
        "        print(name, len(list(iterate_video(path))))\n"
        "    except InputError:\n"
        "        print(name, 'refused')\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=root, capture_output=True, text=True, check=True, timeout=600)
    assert done.stderr == ""
    assert "text refused" in done.stdout and "cut refused" in done.stdout and "bad" in done.stdout


@pytest.mark.parametrize(
    ("name", "frames", "size"), [("beer_video/Beer.mp4", 706, (720, 1280)), ("bedroom_video/room.mp4", 1091, (848, 364))]
)
def test_real_videos(name: str, frames: int, size: tuple[int, int]) -> None:
    capture = read_video(shared_data(name))
    assert len(capture.frames) == frames
    assert (capture.extra["width"], capture.extra["height"]) == size
