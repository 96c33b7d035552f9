"""Videos: a header that other programs understand, all frames in order, nothing left behind on failure."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.errors import InputError, Interrupted, OutputError
from fieldfuse.export.video import write_video


def fading(count: int, height: int = 96, width: int = 128) -> Iterator[Array]:
    """Red grows, blue falls, a white bar moves from left to right."""
    for i in range(count):
        picture = np.zeros((height, width, 3), np.uint8)
        picture[..., 0], picture[..., 2] = 20 + 200 * i // count, 220 - 200 * i // count
        picture[:, width * i // count : width * i // count + width // 8] = 255
        yield picture


def boxes(data: bytes, start: int = 0, end: int | None = None) -> Iterator[tuple[str, int, int]]:
    """(kind, start of contents, end) of the boxes of an ISO 14496-12 file, those inside containers too."""
    end = len(data) if end is None else end
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", data, start + 8), 16
        size = size or end - start
        name = kind.decode("latin-1")
        yield name, start + head, start + size
        if name in ("moov", "trak", "mdia", "minf", "stbl"):
            yield from boxes(data, start + head, start + size)
        start += size


@pytest.mark.parametrize("codec", ["avc1", "vp09", "mp4v"])
def test_header_and_frames(tmp_path: Path, codec: str) -> None:
    if codec == "avc1":
        pytest.importorskip("av", reason="PyAV is not installed; make test brings it")
    path = tmp_path / "orbit.mp4"
    assert write_video(path, fading(15), fps=12.5, codec=codec) == codec
    assert [item.name for item in tmp_path.iterdir()] == ["orbit.mp4"]
    # The header by hand: brand, codec, picture size, number of frames, duration.
    data = path.read_bytes()
    found = {kind: (start, end) for kind, start, end in boxes(data)}
    assert {"ftyp", "moov", "mdat", "stsd", "stsz", "mdhd", "mvhd"} <= set(found)
    entry = found["stsd"][0] + 8
    assert data[entry + 4 : entry + 8].decode() == codec
    assert struct.unpack_from(">HH", data, entry + 8 + 24) == (128, 96)
    assert struct.unpack_from(">I", data, found["stsz"][0] + 8)[0] == 15
    # Of H.264 the track is longer by what its pictures wait for later ones; the movie's own list of edits takes that off again.
    for box in ("mvhd",) if codec == "avc1" else ("mvhd", "mdhd"):
        scale, duration = struct.unpack_from(">II", data, found[box][0] + 12)
        assert duration / scale == pytest.approx(15 / 12.5, rel=0.01), box
    # The frames, in order and in RGB.
    reader = cv2.VideoCapture(str(path))
    for picture in fading(15):
        done, read = reader.read()
        assert done
        assert np.abs(read[..., ::-1].astype(int) - picture).mean() < 12
    assert not reader.read()[0]
    reader.release()


def test_h264_is_preferred_and_what_must_be_known_first_comes_first(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed; make test brings it")
    path = tmp_path / "a.mp4"
    assert write_video(path, fading(3)) == "avc1"
    kinds = [kind for kind, _, _ in boxes(path.read_bytes())]
    assert kinds.index("moov") < kinds.index("mdat")


def test_without_pyav_it_is_one_that_opencv_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    assert write_video(tmp_path / "a.mp4", fading(3)) in ("vp09", "mp4v")


def test_colours_are_what_players_take_them_for(tmp_path: Path) -> None:
    """Pure colours come back from a reader that goes by the file's own words on its colours."""
    av = pytest.importorskip("av", reason="PyAV is not installed; make test brings it")
    colours = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (230, 230, 230), (10, 10, 10)]
    path = tmp_path / "a.mp4"
    write_video(path, [np.full((64, 96, 3), colour, np.uint8) for colour in colours])
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.colorspace, stream.codec_context.color_range) == (6, 1)
        read = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
    assert len(read) == len(colours)
    for picture, colour in zip(read, colours, strict=True):
        assert np.abs(picture.reshape(-1, 3).mean(0) - colour).max() < 5  # 8 bits twice; another matrix would be off by 10 to 30


@pytest.mark.parametrize("codec", ["auto", "mp4v"])
def test_odd_sizes_and_floating_point_pictures(tmp_path: Path, codec: str) -> None:
    path = tmp_path / "odd.mp4"
    write_video(path, (picture / np.float32(255) for picture in fading(4, 95, 127)), codec=codec)
    reader = cv2.VideoCapture(str(path))
    frames = [reader.read()[1] for _ in range(4)]
    reader.release()
    assert frames[0].shape == (96, 128, 3)
    for read, picture in zip(frames, fading(4, 95, 127), strict=True):
        assert np.abs(read[:95, :127, ::-1].astype(int) - picture).mean() < 12


def test_bad_pictures_leave_no_file_and_keep_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "orbit.mp4"
    with pytest.raises(InputError, match="no pictures"):
        write_video(path, [])
    assert not path.exists()
    path.write_bytes(b"the old one")
    with pytest.raises(InputError, match="must be alike"):
        write_video(path, [np.zeros((32, 32, 3), np.uint8), np.zeros((32, 34, 3), np.uint8)], codec="mp4v")
    with pytest.raises(InputError, match=r"\.mp4"):
        write_video(tmp_path / "orbit.webm", fading(2))

    def interrupted() -> Iterator[Array]:
        yield from fading(2)
        raise Interrupted("stopped")

    with pytest.raises(Interrupted):
        write_video(path, interrupted(), codec="mp4v")
    assert path.read_bytes() == b"the old one"
    assert [item.name for item in tmp_path.iterdir()] == ["orbit.mp4"]


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot write"):
        write_video(tmp_path / "file" / "orbit.mp4", fading(2))
