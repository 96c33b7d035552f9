"""Pictures as an mp4 video: H.264 through PyAV, which plays everywhere; without that package what OpenCV's writer can."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.video import OPENING
from fieldfuse.errors import InputError, OutputError
from fieldfuse.files import atomic_path
from fieldfuse.tsdf.mesh import as_bytes

QUALITY = "18"  # constant rate factor of H.264: hardly different from what was rendered
SMPTE_170M, BT_709, LIMITED = 6, 1, 1  # ITU-T H.273: the matrix that both writers use, what is nearest to sRGB, 16 … 235
PROBE = 2**16  # bytes


class H264:
    """Takes (H, W, 3) uint8 RGB pictures with even sides, through PyAV, whose wheels bring x264."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        import av

        self._frame = av.VideoFrame.from_ndarray
        # What a player must know first comes first, so that a browser need not have it all before it begins.
        self._file = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        self._stream = self._file.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001), options={"crf": QUALITY})
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.colorspace, context.color_range = SMPTE_170M, LIMITED
        context.color_primaries, context.color_trc = BT_709, BT_709

    def write(self, picture: Array) -> None:
        self._file.mux(self._stream.encode(self._frame(np.ascontiguousarray(picture), format="rgb24")))

    def close(self) -> None:
        try:
            self._file.mux(self._stream.encode())
        finally:
            self._file.close()


class OpenCV:
    """The same through OpenCV, whose pip wheels carry no H.264 encoder."""

    def __init__(self, path: Path, size: tuple[int, int], fps: float, codec: str) -> None:
        self._writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, size)
        if not self._writer.isOpened():
            self._writer.release()
            raise ValueError(f"this OpenCV does not write {codec}")

    def write(self, picture: Array) -> None:
        self._writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        self._writer.release()


# In order of preference. H.264 takes hundredths of a second a picture. VP9 in mp4 is what browsers play, at some tenths of a second a
# picture; MPEG-4 part 2 is everywhere, a hundred times as fast, and plays in desktop players only.
CODECS = ("avc1", "vp09", "mp4v")


def write_video(path: Path | str, frames: Iterable[Array], fps: float = 30.0, codec: str = "auto") -> str:
    """Write (H, W, 3) RGB pictures (uint8, or floating point 0 to 1) of one size; an odd side is made even by repeating its last pixel.

    Returns:
        the codec used, the first of `CODECS` that is there: "avc1" (H.264), "vp09" (browsers play it) or "mp4v".

    Raises:
        InputError: no pictures, sizes that differ, or not an .mp4 name.
        OutputError: no codec works, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"a video is written as .mp4, not {path.suffix or 'without a suffix'}; rename {path.name}")
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise InputError(f"there are no pictures to write to {path}")
    shape = np.asarray(first).shape
    with atomic_path(path) as temporary:
        temporary.touch()  # OpenCV's writer cannot say why a file cannot be made; this can
        writer, used = _open(temporary, shape, fps, CODECS if codec == "auto" else (codec,))
        try:
            writer.write(_even(first, shape, path))
            count = 1
            for picture in pictures:
                writer.write(_even(picture, shape, path))
                count += 1
        finally:
            writer.close()
        # OpenCV drops pictures without a word when the disk is full; a video that does not hold them all is not kept.
        if frame_count(temporary) != count:
            raise OutputError(f"the video {path} could not be written whole; free space or choose another folder")
    return used


def frame_count(path: Path) -> int:
    """Frames that a video's header promises, 0 when it cannot be opened."""
    with OPENING:
        reader = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()


def _open(path: Path, shape: tuple[int, ...], fps: float, codecs: Iterable[str]) -> tuple[H264 | OpenCV, str]:
    size = (shape[1] + shape[1] % 2, shape[0] + shape[0] % 2)
    for codec in codecs:
        try:
            return H264(path, size, fps) if codec == "avc1" else OpenCV(path, size, fps, codec), codec
        except (ImportError, ValueError):  # not there
            continue
    path.write_bytes(bytes(PROBE))  # a full disk is no fault of the codec, and this says what it is
    raise OutputError("this OpenCV writes no mp4 videos; `pip install --force-reinstall opencv-contrib-python-headless` helps")


def _even(picture: Array, shape: tuple[int, ...], path: Path) -> Array:
    """The picture as bytes, with even sides."""
    picture = as_bytes(picture)
    if picture.shape != shape or picture.ndim != 3 or shape[2] != 3:
        raise InputError(f"the pictures for {path.name} have the shapes {shape} and {picture.shape}; all must be alike, (H, W, 3)")
    height, width = shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") if height % 2 or width % 2 else picture
