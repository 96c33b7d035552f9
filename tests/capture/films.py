"""Small videos for tests, and the rotation that phones write into them."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array

CODECS = {".mp4": "mp4v", ".mov": "mp4v", ".mkv": "mp4v", ".avi": "MJPG", ".webm": "VP80"}


def film(path: Path, pictures: Iterable[Array], fps: float = 10) -> Path:
    """Write (H, W, 3) uint8 RGB pictures as a video, the codec chosen by the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = None
    for picture in pictures:
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*CODECS[path.suffix]), fps, (picture.shape[1], picture.shape[0]))
            assert writer.isOpened()
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    assert writer is not None
    writer.release()
    return path


def film_at(path: Path, pictures: Iterable[Array], times: Iterable[int], pixel: Fraction | None = None) -> Path:
    """The same with each picture at its own time (milliseconds), in a file that tells thirty a second; `pixel`: width to height of one."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        stream.codec_context.time_base = Fraction(1, 1000)
        if pixel is not None:
            stream.codec_context.sample_aspect_ratio = pixel
        shown = list(pictures)
        stream.height, stream.width = shown[0].shape[:2]
        for picture, time in zip(shown, times, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def quarters(count: int = 8, height: int = 48, width: int = 64) -> list[Array]:
    """Pictures with a red, green, blue and black quarter (reading order); the black one brightens with the frame number."""
    pictures = []
    for index in range(count):
        picture = np.zeros((height, width, 3), np.uint8)
        picture[: height // 2, : width // 2, 0] = 255
        picture[: height // 2, width // 2 :, 1] = 255
        picture[height // 2 :, : width // 2, 2] = 255
        picture[height // 2 :, width // 2 :] = 8 * index
        pictures.append(picture)
    return pictures


def names(picture: Array) -> str:
    """The colours of the four quarters in reading order: r, g, b, or k for the dark one."""
    height, width = picture.shape[:2]
    centres = [picture[y, x] for y in (height // 4, 3 * height // 4) for x in (width // 4, 3 * width // 4)]
    return "".join("rgb"[int(np.argmax(colour))] if colour.max() > 150 else "k" for colour in centres)


def turn(path: Path, degrees: int) -> Path:
    """Write a clockwise display rotation into the track header of an mp4 or mov (ISO/IEC 14496-12, 8.3.2)."""
    data = bytearray(path.read_bytes())
    place = data.find(b"tkhd")
    assert place > 0 and data.find(b"tkhd", place + 4) < 0
    place += 4
    place += 4 + (32 if data[place] == 1 else 20) + 16  # version and flags; times, track, duration; reserved, layer, group, volume
    cosine, sine = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    data[place : place + 36] = struct.pack(">9i", cosine << 16, sine << 16, 0, -sine << 16, cosine << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(bytes(data))
    return path


def hide_first(path: Path) -> Path:
    """Let the edit list of an mp4 (ISO/IEC 14496-12, 8.6.6) begin with the second frame, as where the first is stamped before zero."""
    data = bytearray(path.read_bytes())
    (step,) = struct.unpack_from(">I", data, data.find(b"stts") + 16)  # behind version and flags, number of entries, number of frames
    place = data.find(b"elst")
    assert place > 0 and struct.unpack_from(">IIIi", data, place + 4)[::3] == (0, 0)  # version 0, and from the very beginning
    struct.pack_into(">i", data, place + 16, step)
    path.write_bytes(bytes(data))
    return path
