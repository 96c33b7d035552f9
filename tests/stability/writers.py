"""Every writer of the program under a full disk, in a folder that may not be written, and in one that is a file: JSON on stdout.

`python -m tests.stability.writers FOLDER`. A process of its own, because limits and rights are those of a whole process.
"""

from __future__ import annotations

import ctypes
import itertools
import json
import os
import resource
import signal
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pillow_heif
import torch
from PIL import Image

from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture import open_capture
from fieldfuse.capture.convert import convert_images
from fieldfuse.capture.film import Film
from fieldfuse.capture.photos import read_photos
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.sphere import announced, cut_images
from fieldfuse.capture.storage import save_views
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.capture.unpack import unpack
from fieldfuse.capture.video import read_video
from fieldfuse.config import CaptureSettings, Settings
from fieldfuse.errors import OutputError
from fieldfuse.evaluation.compare_page import write_comparison
from fieldfuse.evaluation.report_page import write_report
from fieldfuse.evaluation.tradeoff_page import write_tradeoff
from fieldfuse.export.atlas import make_atlas
from fieldfuse.export.cameras import write_cameras
from fieldfuse.export.clouds import write_cloud
from fieldfuse.export.coarse import coarsened
from fieldfuse.export.georeference import write_georeference
from fieldfuse.export.mesh import write_mesh
from fieldfuse.export.page import Tour, write_page
from fieldfuse.export.parts import write_parts
from fieldfuse.export.ply import write_points
from fieldfuse.export.undistorted import write_undistorted
from fieldfuse.export.usd import write_usdz
from fieldfuse.export.video import write_video
from fieldfuse.files import write_json
from fieldfuse.georeference import Georeference
from fieldfuse.nerfusion.training.checkpoint import TrainState, save_checkpoint
from fieldfuse.nerfusion.training.curve import Curve
from fieldfuse.nerfusion.training.scenes import write_shard
from fieldfuse.nerfusion.training.train import make_model
from fieldfuse.nerfusion.weights import save_model
from fieldfuse.pipelines.folder import RunFolder
from fieldfuse.pipelines.rendered import Picture, Pictures, save_pictures, write_png, write_pngs
from fieldfuse.render.bake import bake
from fieldfuse.render.bake_file import write_baked
from fieldfuse.render.splat_files import save_splats
from fieldfuse.render.splats import Splats
from fieldfuse.simulate import procedural
from fieldfuse.simulate.materials import texture_bank
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate
from fieldfuse.stereo.maps import save_stereo
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.stereo.transients import LeftOut, save_left_out
from fieldfuse.training.cells.scene import write_tensors
from fieldfuse.training.pixels import PixelPool
from fieldfuse.tsdf.volume import DepthFrame, TsdfVolume
from tests.capture.layouts import write_record3d, write_sens
from tests.evaluation.test_compare_page import made, pictures
from tests.evaluation.test_tradeoff import ladder
from tests.nerfusion.training.tiny import tiny_settings
from tests.render.made import some_splats
from tests.simulate.test_simulate import SMALL
from tests.stability.hard.captures import poses, texture
from tests.stability.hard.fields import small_field
from tests.stability.hard.places import ball

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
        "write_tensors": lambda folder: write_tensors(folder / "pixels.safetensors", PixelPool(views).arrays(), {"height": "48"}),
        "save_pictures": lambda folder: save_pictures(folder / "pictures.safetensors", pictures),
        "write_pngs": lambda folder: write_pngs(folder, "a", pictures, 1.0),
        "write_png": lambda folder: write_png(folder / "a.png", pixels),
        "write_points": lambda folder: write_points(folder / "points.ply", mesh.vertices, mesh.colours),
        "write_cameras": lambda folder: write_cameras(folder, list("abcd"), [camera] * 4, poses(4), mesh.vertices),
        "write_georeference": lambda folder: write_georeference(folder, Georeference(47.0, 8.0, 400.0)),
        "write_usdz": lambda folder: write_usdz(
            folder / "textured.usdz", mesh, make_atlas(mesh, 5.0, 256), np.zeros((256, 256, 3), np.uint8), Similarity.identity()
        ),
        "write_video": lambda folder: write_video(folder / "a.mp4", [texture(i, 48, 64) for i in range(6)]),
        "write_video vp09": lambda folder: write_video(folder / "c.mp4", [texture(i, 48, 64) for i in range(6)], codec="vp09"),
        "write_video mp4v": lambda folder: write_video(folder / "b.mp4", [texture(i, 48, 64) for i in range(6)], codec="mp4v"),
        "write_report": lambda folder: write_report(
            folder, {"command": "fieldfuse run", "timeline": [{"seconds": 1.0, "psnr": 20.0}] * 20}
        ),
    }
    splats = Splats(some_splats(50, 1), np.zeros(3))
    for suffix in ("ply", "spz"):
        out[f"save_splats {suffix}"] = lambda folder, suffix=suffix: save_splats(folder / f"splat.{suffix}", splats)
    for suffix in ("laz", "e57"):
        out[f"write_cloud {suffix}"] = lambda folder, suffix=suffix: write_cloud(folder / f"a.{suffix}", mesh.vertices, mesh.colours)
    for suffix in ("ply", "obj", "glb"):
        out[f"write_mesh {suffix}"] = lambda folder, suffix=suffix: write_mesh(folder / f"mesh.{suffix}", mesh)
    return out


def more_writers(place: Path) -> dict[str, Write]:
    """The rest: what is baked, learnt, simulated, compared and drawn. `place` is for what they read."""
    baked, model = bake(small_field(1, 0.2)), make_model(tiny_settings())
    tour = Tour(["a"], [Intrinsics(16, 12, 15.0, 15.0, 8.0, 6.0)], np.eye(4)[None], np.zeros(1, bool), np.eye(4)[None], 1.0)
    adam = torch.optim.Adam(model.parameters())
    shown, meshes = pictures()
    tradeoff = {
        "source": "/x",
        "unit": "m",
        "rows": [{**row, "ssim": None, "lpips": None, "depth_error": None} for row in ladder()],  # one measure, one plot of it
        "warnings": [],
        "machine": {"cores": 2},
        "stages": [],
        "left_out": [],
        "refused": [],
    }
    camera, depth = Intrinsics(16, 12, 15.0, 15.0, 8.0, 6.0), np.ones((12, 16), np.float32)
    scene, numbers = scene_file({**SMALL, "path": {"frames": 2, "fps": 4, "speed": 0.4}, "depth": True}, "test"), itertools.count()
    video = place / "film.avi"
    writer = cv2.VideoWriter(str(video), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for index in range(8):
        writer.write(texture(index, 48, 64))
    writer.release()
    film = read_video(video)
    write_sens(place / "scan")
    write_record3d(place / "recording")
    scan, recording = open_capture(place / "scan"), Film.of(open_capture(place / "recording"))
    photos = place / "photos"
    photos.mkdir()
    for index in range(3):
        pillow_heif.from_pillow(Image.fromarray(texture(index, 48, 64))).save(photos / f"{index}.heic")

    cv2.imwrite(str(place / "posed.png"), texture(0, 48, 64))
    posed = Capture("transforms", place, (Frame("posed", place / "posed.png", Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0), np.eye(4)),))
    sphere = announced(replace(posed, frames=(replace(posed.frames[0], intrinsics=Intrinsics.equirectangular(64, 32)),)))
    with zipfile.ZipFile(place / "photos.zip", "w") as archive:
        archive.write(place / "posed.png", "photos/posed.png")

    def curve(folder: Path) -> None:
        curve = Curve(folder)
        for step in range(40):
            curve.add({"step": float(step), "loss": 1.0 / (step + 1), "psnr_local": 20.0})
        curve.write()

    def filmed(folder: Path) -> None:
        with mock.patch.object(procedural, "texture_bank", partial(texture_bank, size=128)):  # nobody looks at what the pictures show
            simulate(scene, folder / f"film{next(numbers)}", workers=1)

    def run_folder(folder: Path) -> None:
        with RunFolder(folder) as opened:
            opened.start(Path("source"), Settings())

    def shard(folder: Path) -> None:
        arrays = (np.zeros((2, 3, 12, 16), np.uint8), np.stack([depth] * 2), np.ones((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
        write_shard(folder / "shard.safetensors", *arrays, kind="room", ordered=False)

    return {
        "write_baked": lambda folder: write_baked(folder / "baked.safetensors", baked),
        "write_page": lambda folder: write_page(folder / "field.html", baked, tour, "page"),
        "write_parts": lambda folder: write_parts(folder / "field_parts", baked, bake(coarsened(baked.to_field(), 2), like=baked), 2, 3),
        "save_model": lambda folder: save_model(folder / "weights.safetensors", model),
        "save_checkpoint": lambda folder: save_checkpoint(folder, TrainState(model, adam, step=3), {}, 2),
        "Curve.write": curve,
        "write_shard": shard,
        "save_left_out": lambda folder: save_left_out(folder / "left_out.safetensors", LeftOut.of(["a"], [np.ones((96, 128), bool)])),
        "save_stereo": lambda folder: save_stereo(folder / "depths.safetensors", ["a"], [StereoDepth(depth, depth, camera)]),
        "write_comparison": lambda folder: write_comparison(folder, made(), shown, meshes, 0.075),
        "write_tradeoff": lambda folder: write_tradeoff(folder, tradeoff),
        "simulate": filmed,
        "select_frames": lambda folder: select_frames(film, folder / f"video{next(numbers)}", CaptureSettings(max_frames=4)),
        "select_frames, a scan": lambda folder: select_frames(scan, folder / f"scan{next(numbers)}", CaptureSettings(max_frames=4)),
        "Film.write_depth, a recording's": lambda folder: recording.write_depth(0, folder / "0.npy"),
        "Film.write_depth, a scan's": lambda folder: Film.of(scan).write_depth(0, folder / "0.png"),
        "write_undistorted": lambda folder: write_undistorted(folder / "undistorted", posed, np.zeros((1, 3)), np.zeros((1, 3), np.uint8)),
        "cut_images": lambda folder: cut_images(sphere, folder / f"cut{next(numbers)}", 1),
        "unpack": lambda folder: unpack(place / "photos.zip", folder / f"unpacked{next(numbers)}"),
        "convert_images": lambda folder: convert_images(read_photos(photos), folder / f"photos{next(numbers)}", 2),
        "RunFolder": run_folder,
    }  # fmt: skip


# Modules with writers of files that no user keeps, or that the tests of their own part put on a full disk.
ELSEWHERE = {
    "toolkit/files.py": "what all others write through",
    "toolkit/poses/database.py": "COLMAP's own files: tests/poses puts their folder on a full disk",
    "toolkit/poses/match.py": "as above",
    "toolkit/poses/job.py": "as above",
    "toolkit/poses/sfm.py": "as above",
    "toolkit/poses/child.py": "as above",
    "toolkit/poses/worker.py": "as above",
    "toolkit/evaluation/budget.py": "a cache: what cannot be written is not remembered",
    "toolkit/simulate/demo.py": "one video, for people, through `atomic_path`",
    "toolkit/evaluation/plots.py": "draws into memory",
    "toolkit/cluster/checks.py": "a probe: tests/cluster puts it on a full disk",
    "pipelines/doctor.py": "a probe in a temporary folder",
}


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
    sys.dont_write_bytecode = True  # else what is imported under a limit leaves cut-off bytecode to all others
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
