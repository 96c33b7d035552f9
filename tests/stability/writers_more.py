"""The rest of the writers for `writers`: what is baked, learnt, simulated, compared and drawn. Each takes a folder."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pillow_heif
import torch
from PIL import Image

from fieldfuse.camera import Intrinsics
from fieldfuse.capture import open_capture
from fieldfuse.capture.convert import convert_pictures
from fieldfuse.capture.film import Film
from fieldfuse.capture.photos import read_photos
from fieldfuse.capture.select import select_frames
from fieldfuse.capture.video import read_video
from fieldfuse.config import CaptureSettings, Settings
from fieldfuse.evaluation.compare_page import write_comparison
from fieldfuse.evaluation.tradeoff_page import write_tradeoff
from fieldfuse.export.page import Tour, write_page
from fieldfuse.nerfusion.training.caution import Caution
from fieldfuse.nerfusion.training.checkpoint import save_checkpoint
from fieldfuse.nerfusion.training.curve import Curve
from fieldfuse.nerfusion.training.shards import write_shard
from fieldfuse.nerfusion.training.train import make_model
from fieldfuse.nerfusion.weights import save_model
from fieldfuse.pipelines.folder import RunFolder
from fieldfuse.render.bake import bake
from fieldfuse.render.bake_file import write_baked
from fieldfuse.simulate import procedural
from fieldfuse.simulate.materials import texture_bank
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import simulate
from fieldfuse.stereo.maps import save_stereo
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.stereo.transients import LeftOut, save_left_out
from tests.capture.layouts import write_record3d, write_sens
from tests.evaluation.test_compare_page import made, pictures
from tests.evaluation.test_tradeoff import ladder
from tests.nerfusion.training.tiny import tiny_settings
from tests.simulate.test_simulate import SMALL
from tests.stability.hard.captures import texture
from tests.stability.hard.fields import small_field

Write = Callable[[Path], object]


def more_writers(place: Path) -> dict[str, Write]:
    """By name. `place` is for what they read."""
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
        "save_model": lambda folder: save_model(folder / "weights.safetensors", model),
        "save_checkpoint": lambda folder: save_checkpoint(folder, 3, model, adam, {}, 2, Caution()),
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
        "convert_pictures": lambda folder: convert_pictures(read_photos(photos), folder / f"photos{next(numbers)}", 2),
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
    "pipelines/doctor.py": "a probe in a temporary folder",
}
