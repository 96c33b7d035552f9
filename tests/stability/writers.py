"""Every writer of the program under a full disk, in a folder that may not be written, and in one that is a file: JSON on stdout.

`python -m tests.stability.writers FOLDER`. A process of its own, because limits and rights are those of a whole process.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.capture.views_file import save_views
from fieldfuse.errors import OutputError
from fieldfuse.evaluation.report import write_report
from fieldfuse.export.cameras import write_cameras
from fieldfuse.export.mesh import write_mesh
from fieldfuse.export.ply import write_points
from fieldfuse.export.video import write_video
from fieldfuse.files import write_json
from fieldfuse.pipelines.rendered import Picture, Pictures, save_pictures, write_png, write_pngs
from fieldfuse.tsdf.volume import DepthFrame, TsdfVolume
from tests.stability.hard.captures import poses, texture
from tests.stability.hard.fields import small_field
from tests.stability.hard.places import ball
from tests.stability.writers_more import more_writers

Write = Callable[[Path], object]
LIMITS = (0, 1, 700)  # bytes a file may have


def writers() -> dict[str, Write]:
    """What is written, by name; each takes a folder."""
    torch.manual_seed(0)
    camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    pixels, depth = texture(0, 48, 64), np.ones((48, 64), np.float32)
    field, mesh = small_field(1), ball()
    views = Views(
        [str(i) for i in range(4)], [pixels] * 4, [camera] * 4, poses(4), np.array([True, False, False, False]), depths=[depth] * 4
    )
    pictures = Pictures(["a"], [Picture(pixels, depth)], [0.1])
    volume = TsdfVolume(0.1, 5.0, expected_blocks=64)
    volume.integrate(DepthFrame(depth, pixels, camera, camera, poses(1)[0]))
    out: dict[str, Write] = {
        "write_json": lambda folder: write_json(folder / "a.json", {"x": list(range(1000))}),
        "Field.save": lambda folder: field.save(folder / "field.safetensors"),
        "save_views": lambda folder: save_views(folder / "views.safetensors", views),
        "save_pictures": lambda folder: save_pictures(folder / "pictures.safetensors", pictures),
        "write_pngs": lambda folder: write_pngs(folder, "a", pictures, 1.0),
        "write_png": lambda folder: write_png(folder / "a.png", pixels),
        "write_points": lambda folder: write_points(folder / "points.ply", mesh.vertices, mesh.colours),
        "write_cameras": lambda folder: write_cameras(
            folder, list("abcd"), [camera] * 4, poses(4), mesh.vertices, None, Similarity.identity()
        ),
        "write_video": lambda folder: write_video(folder / "a.mp4", [texture(i, 48, 64) for i in range(6)]),
        "write_video vp09": lambda folder: write_video(folder / "c.mp4", [texture(i, 48, 64) for i in range(6)], codec="vp09"),
        "write_video mp4v": lambda folder: write_video(folder / "b.mp4", [texture(i, 48, 64) for i in range(6)], codec="mp4v"),
        "write_report": lambda folder: write_report(
            folder, {"command": "fieldfuse run", "timeline": [{"seconds": 1.0, "psnr": 20.0}] * 20}
        ),
    }
    for suffix in ("ply", "obj", "glb"):
        out[f"write_mesh {suffix}"] = lambda folder, suffix=suffix: write_mesh(folder / f"mesh.{suffix}", mesh)
    return out


def attempt(write: Write, folder: Path) -> str:
    """`ok` when it says so in one sentence and leaves what was there; else what is wrong."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} if folder.is_dir() else {}
    try:
        write(folder)
    except OutputError as error:
        if "\n" in str(error) or ("cannot write" not in str(error) and "could not be written" not in str(error)):
            return f"says {error}"
    except BaseException as error:
        return f"raises {type(error).__name__}: {str(error)[:200]}"
    else:
        return "says nothing"
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} if folder.is_dir() else {}
    if after != before:
        gone = [path.name for path in before if path not in after]
        new = [path.name for path in after if path not in before]
        changed = [path.name for path in before if path in after and before[path] != after[path]]
        # Of several files some may be finished before the disk is full; none may be half.
        if gone or changed or any(".tmp" in name for name in new):
            return f"left new {new}, removed {gone}, changed {changed}"
    return "ok"


def drop_rights() -> None:
    """Give up every capability, so that rights of files count for the superuser too."""

    class Header(ctypes.Structure):
        _fields_ = (("version", ctypes.c_uint32), ("process", ctypes.c_int))

    class Data(ctypes.Structure):
        _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32), ("inheritable", ctypes.c_uint32))

    library = ctypes.CDLL(None, use_errno=True)
    if library.capset(ctypes.byref(Header(0x20080522, 0)), ctypes.byref((Data * 2)())) != 0:
        raise OSError(ctypes.get_errno(), "capset")


def main() -> int:
    place = Path(sys.argv[1])
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    result: dict[str, Any] = {}
    every = writers() | more_writers(place)
    for name, write in every.items():
        folder = place / name.replace(" ", "_")
        folder.mkdir()
        write(folder)  # what was there before, and the proof that it works
        for limit in LIMITS:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            result[f"{name}, files of at most {limit} bytes"] = attempt(write, folder)
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        file = place / f"{folder.name}.file"
        file.write_text("in the way")
        result[f"{name}, a file where the folder should be"] = attempt(write, file / "deep")
    if sys.platform == "linux":
        drop_rights()
        for name, write in every.items():
            folder = place / name.replace(" ", "_")
            for inner in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
                inner.chmod(0o555)
            result[f"{name}, a folder that may only be read"] = attempt(write, folder)
            for inner in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
                inner.chmod(0o755)
    sys.stdout.write(json.dumps(result) + "\n")
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
