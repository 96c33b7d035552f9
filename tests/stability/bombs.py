"""Small files that stand for large things, read with one gigabyte to spare: `python -m tests.stability.bombs FOLDER`, JSON on stdout.

Each must be refused in a sentence, or read, within five seconds; anything else is told.
"""

from __future__ import annotations

import io
import json
import os
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from imagecodecs import lzfse_encode
from safetensors import safe_open
from safetensors.torch import save_file

from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.images import load_depth, load_image
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.video import read_video
from fieldfuse.config import load_settings
from fieldfuse.errors import FieldfuseError
from fieldfuse.files import read_json
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.field import Field
from fieldfuse.volume.store import METADATA_KEY, read_field
from tests.capture.layouts import LAYOUTS, sens_of, write_record3d, zipped
from tests.stability.fuzz.watch import SECONDS, bound_memory
from tests.stability.hard.fields import small_field


def png(width: int, height: int, depth: int, kind: int, data: bytes) -> bytes:
    """A PNG with this header, whatever the data holds."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data, 9)) + chunk(b"IEND", b"")


def exr(side: int) -> bytes:
    """An OpenEXR image of 8 × 8 pixels whose header says `side` × `side`."""
    import OpenEXR

    file = io.BytesIO()
    planes = {name: np.zeros((8, 8), np.float32) for name in "RGB"}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(file)
    return file.getvalue().replace(struct.pack("<4i", 0, 0, 7, 7), struct.pack("<4i", 0, 0, side - 1, side - 1))


def field_of_many_channels(path: Path) -> None:
    """60,000 blocks of 1,024 channels without one stored corner: 4.5 MB that stand for 117 GB."""
    small = path.with_name("small.safetensors")
    small_field(1, 0.2).save(small)
    with safe_open(str(small), "pt") as source:
        about = json.loads(source.metadata()[METADATA_KEY])
    about["config"].update(resolution=512, hidden=16)
    line = torch.arange(40)
    keys = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3)[:60_000].int().contiguous()
    tensors = {f"decoder.{name}": value.contiguous() for name, value in make_decoder("deferred", 1024, 16).state_dict().items()}
    tensors |= {"keys": keys, "occupied": torch.zeros(len(keys), 64, dtype=torch.uint8), "node_index": torch.zeros(0, dtype=torch.int32)}
    tensors |= {"features": torch.zeros(0, 1024, dtype=torch.float16), "density": torch.zeros(0)}
    save_file(tensors, str(path), metadata={METADATA_KEY: json.dumps(about)})


def film(path: Path, announced: int) -> None:
    """Six frames whose headers announce more."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for index in range(6):
        writer.write(np.full((48, 64, 3), 40 * index, np.uint8))
    writer.release()
    data = bytearray(path.read_bytes())
    for name, offset in ((b"avih", 16), (b"strh", 32)):
        at = data.find(name) + 8 + offset
        data[at : at + 4] = struct.pack("<I", announced)
    path.write_bytes(data)


def npy(shape: str) -> bytes:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(64)


def archive(root: Path) -> Path:
    """A DTU capture whose cameras are a zip of 300 MB of zeros, and one whose array promises 80 GB."""
    LAYOUTS["dtu"][1](root)
    with zipfile.ZipFile(root / "cameras.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("world_mat_0.npy", npy("(37500000,)") + bytes(300_000_000))
    return root


def promising_archive(root: Path) -> Path:
    LAYOUTS["dtu"][1](root)
    with zipfile.ZipFile(root / "cameras.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("world_mat_0.npy", npy("(100000, 100000)"))
    return root


def recording(root: Path, name: str, content: bytes) -> Path:
    """A recording in one file whose member `name` is `content`."""
    write_record3d(root)
    (root / name).write_bytes(content)
    return zipped(root, root.with_suffix(".r3d"))


def depth_in(path: Path) -> object:
    capture = open_capture(path)
    return load_depth(capture.frames[0], capture)


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def depth_of(path: Path, content: bytes) -> Frame:
    path.write_bytes(content)
    return Frame("a", path, depth=path)


def plain(root: Path) -> Capture:
    return Capture("transforms", root, ())


def picture_folder(root: Path) -> Path:
    root.mkdir()
    for index in range(3):
        (root / f"{index}.png").write_bytes(png(13_000, 13_000, 8, 0, b""))
    return root


def bombs(place: Path) -> dict[str, Callable[[], Any]]:
    """By name: what is made beforehand is made here, what is measured is in the function."""
    field_of_many_channels(place / "field.safetensors")
    film(place / "film.avi", 90_000_000)
    film(place / "long.avi", 2**31 - 1)
    (place / "huge.png").write_bytes(png(14_000, 14_000, 16, 6, bytes(1000)))
    (place / "flat.png").write_bytes(png(14_000, 14_000, 16, 6, bytes(40_000_000)))
    (place / "side.png").write_bytes(png(2**31 - 1, 1, 8, 0, b""))
    (place / "huge.exr").write_bytes(exr(50_000))
    (place / "sparse.json").open("wb").truncate(2**36)
    (place / "deep.json").write_text("[" * 10_000_000)
    LAYOUTS["tum"][1](place / "lists")
    (place / "lists" / "rgb.txt").open("ab").truncate(2**36)
    for name, count in (("many.sens", 2**60), ("empty.sens", 50_000)):
        (place / name).write_bytes(sens_of([], count=count)[:-136])  # without what stands behind the frames
        (place / name).open("ab").truncate(2**36)
    lines = "\n".join([f"a{i}: &a{i} [{', '.join(f'*a{i - 1}' for _ in range(9))}]" if i else "a0: &a0 [x]" for i in range(12)])
    packed, promising, folder = archive(place / "zip"), promising_archive(place / "promise"), picture_folder(place / "pictures")
    zeros = lzfse_encode(bytes(2**20))
    zeros = zeros[:-4] * 1024 + zeros[-4:]  # a stream is blocks, and a mark of four bytes
    deep, wide = recording(place / "inflates", "rgbd/0.depth", zeros), recording(place / "wide", "rgbd/0.depth", zeros)
    (place / "wide" / "metadata").write_text((place / "wide" / "metadata").read_text().replace('"dw"', '"a"'))
    zipped(place / "wide", wide)
    heavy = recording(place / "heavy", "rgbd/2.jpg", bytes(2**28))
    long = recording(place / "long", "metadata", b" " * 2**27)
    (place / "loop").mkdir()
    (place / "loop" / "loop").symlink_to(place / "loop")
    LAYOUTS["transforms"][1](place / "links")
    (place / "secret.png").write_bytes((place / "links" / "images" / "0001.png").read_bytes())
    (place / "links" / "images" / "0001.png").unlink()
    (place / "links" / "images" / "0001.png").symlink_to(place / "secret.png")
    return {
        "a field of 117 GB in 4.5 MB": lambda: read_field(place / "field.safetensors"),
        "the same through the loader": lambda: Field.load(place / "field.safetensors"),
        "six frames announced as 90 million": lambda: len(read_video(place / "film.avi").frames),
        "six frames announced as two thousand million": lambda: len(read_video(place / "long.avi").frames),
        "a picture of 1.6 GB in a kilobyte": lambda: load_image(Frame("a", place / "huge.png")),
        "a picture of 1.6 GB that holds 40 MB": lambda: load_image(Frame("a", place / "flat.png")),
        "a picture two thousand million pixels wide": lambda: load_image(Frame("a", place / "side.png")),
        "a folder of three pictures of 169 megapixels in nothing": lambda: check_capture(open_capture(folder)),
        "an OpenEXR picture of 30 GB in a kilobyte": lambda: load_image(Frame("a", place / "huge.exr")),
        "64 GB of JSON in a sparse file": lambda: read_json(place / "sparse.json"),
        "64 GB of zeros in a list of images": lambda: open_capture(place / "lists"),
        "ten million brackets": lambda: read_json(place / "deep.json"),
        "YAML whose aliases multiply to 9¹¹": lambda: load_settings(file=text(place / "laugh.yaml", lines)),
        "YAML nested 100,000 deep": lambda: load_settings(file=text(place / "deep.yaml", "{a: " * 100_000)),
        "a zip of 300 MB of zeros": lambda: open_capture(packed),
        "an array in a zip that promises 80 GB": lambda: open_capture(promising),
        "a depth map that promises 80 GB": lambda: load_depth(depth_of(place / "a.npy", npy("(100000, 100000)")), plain(place)),
        "a depth map of objects": lambda: load_depth(depth_of(place / "b.npy", npy("(2, 2)").replace(b"<f8", b"|O ")), plain(place)),
        "a .sens file of 2⁶⁰ frames": lambda: open_capture(place / "many.sens"),
        "a .sens file of 50,000 frames in a sparse file": lambda: open_capture(place / "empty.sens"),
        "a recording's depth of 1 GB in less than one MB": lambda: depth_in(deep),
        "the same without a word of its size": lambda: depth_in(wide),
        "a recording with a picture of 256 MB in a kilobyte": lambda: load_image(open_capture(heavy).frames[2]),
        "a recording whose metadata are 128 MB of blanks": lambda: open_capture(long),
        "a folder that links to itself": lambda: open_capture(place / "loop"),
        "a picture that is a link out of the capture": lambda: open_capture(place / "links"),
    }


def main() -> None:
    place = Path(sys.argv[1])
    torch.set_num_threads(1)
    every = bombs(place)
    bound_memory()
    result = {}
    for name, act in every.items():
        began = time.process_time()
        try:
            answer = act()
            outcome = f"read: {answer if isinstance(answer, int) else type(answer).__name__}"
        except FieldfuseError as error:
            outcome = "refused" if "\n" not in str(error) else f"says {error}"
        except BaseException as error:  # everything else is what this looks for
            outcome = f"raises {type(error).__name__}: {str(error)[:200]}"
        took = time.process_time() - began
        result[name] = outcome if took < SECONDS else f"took {took:.1f} s of computing"
    sys.stdout.write(json.dumps(result) + "\n")
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
