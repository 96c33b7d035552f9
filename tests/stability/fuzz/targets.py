"""What is fed: small real samples of every format that is read, and what reads them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from fieldfuse.camera import Intrinsics, Similarity, opengl_from_world
from fieldfuse.capture import open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.gps import gps_of_images
from fieldfuse.capture.images import load_image, load_mask
from fieldfuse.capture.ply_points import read_ply_points
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.sphere import cut_view, to_cut, views_of
from fieldfuse.capture.storage import capture_from_dict, capture_to_dict, load_views, save_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.capture.video import iterate_video, read_video
from fieldfuse.config import CaptureSettings, load_settings
from fieldfuse.files import read_json, write_json
from fieldfuse.poses.result import given_poses
from fieldfuse.render.field import Field
from fieldfuse.render.rays import render_rays
from fieldfuse.tone import Tone
from tests.capture.dng import mosaic, write_dng
from tests.capture.layouts import LAYOUTS, write_record3d, zipped
from tests.capture.made import eyes, render, save_picture
from tests.capture.spheres import room, walk
from tests.stability.fuzz.given import (
    DATASETS,
    MESHES,
    SPLATS,
    TRUTH,
    make_datasets,
    make_meshes,
    make_splats,
    make_truth,
    read_datasets,
    read_meshes,
    read_splats,
    read_truth,
)
from tests.stability.fuzz.models import make_models, make_training, read_baked_field, read_models, read_training
from tests.stability.fuzz.results import FILES as RESULT_FILES
from tests.stability.fuzz.results import MEASURED, make_measured, make_results, read_measured, read_results
from tests.stability.fuzz.watch import all_of
from tests.stability.hard.fields import aimed_rays, small_field

Act = Callable[[Path, int], object]


@dataclass(frozen=True)
class Target:
    """Files below `root`, one of which is damaged at a time, and `act(root, number)` which reads them."""

    name: str
    files: tuple[str, ...]
    make: Callable[[Path], object]
    act: Act
    weight: float = 1.0


class Escape(Exception):
    """A reader answered with a file outside the capture."""


def contained(capture: Capture, root: Path) -> Capture:
    """The capture, when all its files lie inside its folder."""
    for frame in capture.frames:
        for path in (frame.image, frame.depth, frame.mask):
            if path is not None and not path.resolve().is_relative_to(root.resolve()):
                raise Escape(str(path))
    return capture


def read_capture(root: Path, number: int) -> None:
    """Read a capture; every fourth time look at its pictures and prepare them as well."""
    capture = contained(open_capture(root), root)
    if number % 4 == 0:
        capture = check_capture(capture)
        posed = given_poses(capture).apply(capture)
        prepare_views(posed, Similarity.identity(), CaptureSettings(image_size=32))


# ------------------------------------------------------------------------------------------------ samples

FILES = {
    "transforms": ("transforms.json", "transforms.json", "images/0001.png", "depth/0002.png"),
    "blender": ("transforms_test.json", "transforms_train.json", "train/r_0.png"),
    "colmap bin": ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    "colmap txt": ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"),
    "7scenes": ("frame-000002.pose.txt", "frame-000002.depth.png"),
    "tum": ("rgb.txt", "depth.txt", "groundtruth.txt"),
    "scannet": ("pose/10.txt", "intrinsic/intrinsic_color.txt", "color/5.jpg"),
    "sens": ("scene0000_00.sens",),
    "llff": ("poses_bounds.npy",),
    "dtu": ("cameras.npz",),
    "redwood": ("trajectory.log", "camera_intrinsics.json"),
    "replica": ("traj.txt", "cam_params.json", "results/depth000001.png"),
    "polycam": ("keyframes/corrected_cameras/100333.json", "keyframes/depth/100333.png", "keyframes/confidence/100333.png"),
    "stray": ("odometry.csv", "camera_matrix.csv", "depth/000001.png"),
    "record3d": ("metadata", "metadata", "rgbd/1.depth", "rgbd/0.depth", "rgbd/2.conf", "rgbd/0.jpg"),
    "scanner3d": ("frame_00002.json", "frame_00004.json", "depth_00002.png", "conf_00000.png"),
    "metashape": ("cameras.xml",),
    "realitycapture": ("registration.csv",),
    "xmp": ("IMG_02.xmp", "IMG_03.xmp"),
    "opensfm": ("opensfm/reconstruction.json",),
    "meshroom": ("MeshroomCache/StructureFromMotion/0a1b/cameras.sfm",),
    "bundler": ("bundle.out", "list.txt"),
    "scannetpp": ("dslr/nerfstudio/transforms_undistorted.json", "dslr/train_test_lists.json"),
    "rgbd": ("truth_cam_poses.txt", "TUM3.yaml", "depth_imgs/0001_depth_raw.png"),
    "arkitscenes": ("lowres_wide.traj", "lowres_wide_intrinsics/41069021_305.377.pincam", "lowres_depth/41069021_305.477.png"),
}


def make_recording(root: Path) -> None:
    """Record3D's own file, without depth's size in it."""
    source = root.with_name(f"{root.name}-unpacked")
    write_record3d(source)
    told = json.loads((source / "metadata").read_text())
    (source / "metadata").write_text(json.dumps({key: value for key, value in told.items() if key not in ("dw", "dh")}))
    root.mkdir(parents=True, exist_ok=True)
    zipped(source, root / "a.r3d")
    shutil.rmtree(source)


def make_extras(root: Path) -> None:
    """`transforms.json` with everything optional: masks, float depth, a point cloud, splits."""
    LAYOUTS["transforms"][1](root)
    data = json.loads((root / "transforms.json").read_text())
    for index, frame in enumerate(data["frames"]):
        mask = np.full((60, 80), 255, np.uint8)
        mask[:10] = 0
        cv2.imwrite(str(root / f"mask{index}.png"), mask)
        np.save(root / f"depth{index}.npy", render(eyes()[index], LAYOUTS_CAMERA)[1].astype(np.float32))
        frame.update(mask_path=f"mask{index}.png", depth_file_path=f"depth{index}.npy", k1=0.01)
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (root / "points.ply").write_text(header + "0 0 0\n1 0.5 2\n-1 3 1e-3\n")
    data.update(ply_file_path="points.ply", depth_unit_scale_factor=1.0, train_filenames=["images/0001.png"], applied_scale=1.0)
    (root / "transforms.json").write_text(json.dumps(data))


def make_panoramas(root: Path) -> None:
    """Posed panoramas, photos of panoramas with Google's XMP in a folder beside, and fisheye images."""
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><GPano:ProjectionType>equirectangular</GPano:ProjectionType></x:xmpmeta>'
    for name, model in (("posed", "EQUIRECTANGULAR"), ("photos", ""), ("fisheye", "OPENCV_FISHEYE")):
        (root / name).mkdir(parents=True)
        frames = []
        for number, pose in enumerate(walk(4)):
            frames.append({"file_path": f"{number}.jpg", "transform_matrix": opengl_from_world(pose).tolist()})
            Image.fromarray(room(Intrinsics.equirectangular(64, 32), pose)[0]).save(root / name / f"{number}.jpg", xmp=xmp)
        lens = {"fl_x": 20.0, "fl_y": 20.0, "k1": 0.01, "k2": -0.002} if model == "OPENCV_FISHEYE" else {}
        if model:
            (root / name / "transforms.json").write_text(json.dumps({"camera_model": model, **lens, "frames": frames}))


def read_panoramas(root: Path, number: int) -> None:
    def read(folder: Path) -> None:
        capture = check_capture(contained(open_capture(folder), folder))
        for index in to_cut(capture):
            frame = capture.frames[index]
            for view in views_of(frame.intrinsics)[0]:
                cut_view(load_image(frame), frame.intrinsics, view)

    all_of(*(partial(read, root / name) for name in ("posed", "photos", "fisheye")))


LAYOUTS_CAMERA = LAYOUTS["transforms"][1].__globals__["OFF_CENTRE"]
PHOTOS = ("a.jpg", "b.png", "c.webp", "d.bmp", "e.tif", "f.png", "g.jpg", "h.heic")


def make_photos(root: Path) -> None:
    """Photos in every format that is read, with EXIF, alpha and 16 bits."""
    import pillow_heif
    from PIL import Image

    pictures = [render(eye, LAYOUTS_CAMERA)[0] for eye in eyes()]
    root.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    tags[0x0112], tags[0x010F] = 6, "maker"
    tags.get_ifd(0x8769)[0xA405] = 28
    tags.get_ifd(0x8825).update({1: "N", 2: (46.0, 50.0, 33.4), 3: "W", 4: (91.0, 59.0, 40.4), 5: b"\0", 6: 198.3})
    Image.fromarray(pictures[0]).save(root / "a.jpg", exif=tags, quality=85)
    save_picture(root / "b.png", np.dstack([pictures[1], np.full((60, 80), 200, np.uint8)]))
    Image.fromarray(pictures[2]).save(root / "c.webp")
    Image.fromarray(pictures[3]).save(root / "d.bmp")
    Image.fromarray(pictures[4]).save(root / "e.tif", compression="tiff_deflate")
    cv2.imwrite(str(root / "f.png"), pictures[0].astype(np.uint16) * 257)
    Image.fromarray(pictures[1]).save(root / "g.jpg", progressive=True)
    small = pillow_heif.from_pillow(Image.fromarray(pictures[2]))
    small.save(root / "h.heic", quality=80, exif=tags.tobytes())


def make_exr(root: Path) -> None:
    """OpenEXR with and without alpha, in half and full precision, by several ways to compress."""
    import OpenEXR

    root.mkdir(parents=True, exist_ok=True)
    ways = (OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION, OpenEXR.DWAA_COMPRESSION)
    for name, eye, way, kind in zip("abc", eyes(), ways, (np.float16, np.float32, np.float16), strict=False):
        colours = render(eye, LAYOUTS_CAMERA)[0].astype(kind) / kind(255)
        planes = {channel: np.ascontiguousarray(colours[..., index]) for index, channel in enumerate("RGB")}
        planes |= {"A": np.ones((60, 80), kind)} if name == "b" else {}
        OpenEXR.File({"compression": way, "type": OpenEXR.scanlineimage}, planes).write(str(root / f"{name}.exr"))


def make_raw(root: Path) -> None:
    root.mkdir(parents=True, exist_ok=True)
    for name, eye in zip("abc", eyes(), strict=False):
        write_dng(root / f"{name}.dng", mosaic(render(eye, LAYOUTS_CAMERA)[0].astype(np.float32) / 255))


def read_photo_folder(root: Path, number: int) -> None:
    capture = contained(open_capture(root), root)
    for frame in capture.frames:
        load_image(frame, exif=True)
        load_mask(frame)
    places = gps_of_images([frame.image for frame in capture.frames])
    if not np.isfinite(places[~np.isnan(places)]).all():
        raise ValueError("a place that is not finite")
    if number % 4 == 0:
        check_capture(capture)


def make_videos(root: Path) -> None:
    root.mkdir(parents=True, exist_ok=True)
    for name, codec in (("a.avi", "MJPG"), ("b.mp4", "mp4v"), ("c.webm", "VP80")):
        writer = cv2.VideoWriter(str(root / name), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 10, (80, 60))
        for eye in eyes():
            writer.write(np.ascontiguousarray(render(eye, LAYOUTS_CAMERA)[0][..., ::-1]))
        writer.release()


def read_one_video(root: Path, number: int) -> None:
    path = sorted(root.iterdir())[number % 3]
    capture = contained(read_video(path), root)
    for _ in iterate_video(path, range(min(3, len(capture.frames)))):
        pass


def make_runs(root: Path) -> None:
    """The files of a run's folder that later commands read."""
    from fieldfuse.config import Settings
    from fieldfuse.georeference import Georeference
    from fieldfuse.pipelines.folder import RunFolder
    from fieldfuse.pipelines.rendered import Picture, Pictures, save_pictures
    from fieldfuse.poses.scaling import Scaling
    from fieldfuse.poses.scene import Scene

    source = root / "source"
    LAYOUTS["transforms"][1](source)
    capture = open_capture(source)
    folder = RunFolder(root)
    folder.start(source, Settings())
    write_json(root / "capture.json", capture_to_dict(capture))
    write_json(root / "poses.json", given_poses(capture).to_dict())
    scene = Scene(Similarity.identity(), np.zeros(3), np.ones(3), 1.5, 0.1, 9.0, 0.1, True, False)
    write_json(root / "scene.json", scene.to_dict())
    found = {"source": "gps", "factor": 2.5, "error": 0.01, "text": "the GPS of 8 of 8 images"}
    place = Georeference(46.8, -92.0, 198.0, error=0.5)
    write_json(root / "scaling.json", Scaling(Similarity.identity(), True, place, found, ("a note",)).to_dict())
    record = {
        "name": "views",
        "key": "a",
        "made": "b",
        "seconds": 1.0,
        "peak_memory_mb": 2.0,
        "outputs": {"run.json": 5},
        "after": {"poses": "c"},
    }
    write_json(root / "stages" / "views.json", record)
    camera = Intrinsics(16, 12, 15.0, 15.0, 8.0, 6.0)
    pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    depth = np.ones((12, 16), np.float32)
    views = Views(["a", "b"], [pixels] * 2, [camera] * 2, np.tile(np.eye(4), (2, 1, 1)), np.array([True, False]), depths=[depth, None])
    views.photos, views.tones = [pixels, None], [Tone((1.2, 1.1, 0.9), 0.8), None]
    save_views(root / "views.safetensors", views)
    save_pictures(root / "field.pictures.safetensors", Pictures(["a"], [Picture(pixels, depth)], [0.1], {"x": 1}))
    small_field(1, 0.2).save(root / "field.safetensors")
    small_field(1, 0.2, decoder="per_sample", shell=1.0).save(root / "other.safetensors")
    frame = {"camera_to_world": np.eye(4).reshape(-1).tolist(), "fov": 50.0}
    write_json(root / "camera_path.json", {"render_width": 16, "render_height": 12, "fps": 24, "camera_path": [frame] * 2})
    (root / "settings.yaml").write_text("preset: fast\nfit: {budget: 5.0}\nexport:\n  formats: [ply, obj]\ntsdf: {enabled: off}\n")


def read_json_files(root: Path, number: int) -> None:
    """Every JSON file of a run's folder, as the commands read it."""
    from fieldfuse.pipelines.folder import RunFolder
    from fieldfuse.pipelines.render_path import path_fps, read_cameras
    from fieldfuse.pipelines.stages import finished_stages
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scaling import Scaling
    from fieldfuse.poses.scene import Scene

    folder = RunFolder(root)
    finished_stages(folder)
    all_of(
        lambda: load_settings("balanced", stored=folder.about()["settings"]),
        lambda: capture_from_dict(read_json(root / "capture.json")),
        lambda: PoseResult.from_dict(read_json(root / "poses.json")),
        lambda: Scene.from_dict(read_json(root / "scene.json")),
        lambda: Scaling.from_dict(read_json(root / "scaling.json")),
        lambda: read_cameras(root / "source" / "transforms.json"),
        lambda: read_cameras(root / "camera_path.json"),
        lambda: path_fps(root / "camera_path.json"),
        lambda: load_settings("balanced", file=root / "settings.yaml"),
    )


RAYS = aimed_rays(8)


def read_fields(root: Path, number: int) -> None:
    """Load a field and look along eight rays."""
    for name in ("field.safetensors", "other.safetensors"):
        field = Field.load(root / name)
        values = render_rays(field, *RAYS)
        if not bool(torch.isfinite(values.colour).all()):
            raise ValueError("a colour that is not finite")


def read_tensors(root: Path, number: int) -> None:
    from fieldfuse.pipelines.rendered import load_pictures

    all_of(lambda: load_views(root / "views.safetensors"), lambda: load_pictures(root / "field.pictures.safetensors"))


RUN_FILES = (
    "run.json", "capture.json", "poses.json", "scene.json", "scaling.json", "stages/views.json", "settings.yaml",
    "source/transforms.json", "camera_path.json",
)  # fmt: skip
TRAINING_FILES = (
    "shard.safetensors", "checkpoint-0000007.safetensors", "train.yaml", "depths.safetensors", "left_out.safetensors",
    "fieldfuse/speed.json",
)  # fmt: skip
PANORAMAS = ("posed/transforms.json", "posed/1.jpg", "photos/1.jpg", "fisheye/transforms.json", "fisheye/transforms.json")
TARGETS: tuple[Target, ...] = (
    *(Target(layout, files, LAYOUTS[layout][1], read_capture, 1.0) for layout, files in FILES.items()),
    Target("recording", ("a.r3d",), make_recording, read_capture, 1.0),
    Target("extras", ("transforms.json", "mask1.png", "depth2.npy", "points.ply"), make_extras, read_capture, 2.0),
    Target("photos", PHOTOS, make_photos, read_photo_folder, 3.0),
    Target("openexr", ("a.exr", "b.exr", "c.exr"), make_exr, read_photo_folder, 1.0),
    Target("camera raw", ("a.dng", "b.dng", "c.dng"), make_raw, read_photo_folder, 1.0),
    Target("panoramas", PANORAMAS, make_panoramas, read_panoramas, 1.0),
    Target("videos", ("a.avi", "b.mp4", "c.webm"), make_videos, read_one_video, 1.5),
    Target("run json", RUN_FILES, make_runs, read_json_files, 2.0),
    Target("results", RESULT_FILES, make_results, read_results, 2.5),
    Target("measured", MEASURED, make_measured, read_measured, 2.5),
    Target("field", ("field.safetensors", "other.safetensors"), make_runs, read_fields, 3.0),
    Target("tensors", ("views.safetensors", "field.pictures.safetensors"), make_runs, read_tensors, 1.5),
    Target("baked", ("bounded.safetensors", "background.safetensors"), make_models, read_baked_field, 2.0),
    Target("models", ("weights.safetensors", "scene.yaml", "scene.yaml"), make_models, read_models, 1.0),
    Target("training", TRAINING_FILES, make_training, read_training, 1.0),
    Target("meshes", MESHES, make_meshes, read_meshes, 2.0),
    Target("splats", SPLATS, make_splats, read_splats, 1.5),
    Target("ground truth", TRUTH, make_truth, read_truth, 1.0),
    Target("data sets", DATASETS, make_datasets, read_datasets, 1.0),
    Target("points", ("points.ply",), make_extras, lambda root, number: read_ply_points(root / "points.ply"), 0.5),
)  # fmt: skip
