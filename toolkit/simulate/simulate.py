"""A scene file becomes a capture, its images or video, depth and `transforms.json`, with the ground truth beside: all of it, or nothing."""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from safetensors.numpy import save

from fieldfuse.camera import EQUIRECTANGULAR, FISHEYE, Array, Intrinsics, opengl_from_world
from fieldfuse.effects.effect_specs import Effects, parse
from fieldfuse.errors import InputError, OutputError
from fieldfuse.files import atomic_path, write_json
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate.eye import Scenery
from fieldfuse.simulate.film import Film, FilmCamera, Shot, drawing
from fieldfuse.simulate.mesh_scene import SUFFIXES, load_mesh_scene
from fieldfuse.simulate.paths import plan
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.scene import Scene
from fieldfuse.simulate.settings import PANORAMA, PINHOLE, SceneFile
from fieldfuse.simulate.solids import Mesh
from fieldfuse.simulate.survey import Receiver, with_markers

SCENE, PATH = 0, 1  # streams of random numbers
TRUTH = "ground_truth"
DEPTH_STEPS = 1000.0  # stored depth values a metre
MOST_STEPS = 65535
LENS_EFFECTS = ("distortion", "vignetting")
MODELS = ("PINHOLE", "OPENCV")


def open_scene(settings: SceneFile, beside: Path) -> Scenery:
    """The scene that a file names; meshes are looked for relative to the folder `beside`.

    Raises:
        InputError: there is no such kind or mesh.
    """
    if Path(settings.scene).suffix.lower() in SUFFIXES:
        mesh = load_mesh_scene(beside / settings.scene, settings.mesh.up, settings.mesh.scale)
        if settings.mesh.free is not None:
            mesh.free = np.sort(np.array(settings.mesh.free, dtype=np.float64), axis=0)
        if settings.mesh.focus is not None:
            mesh.focus = np.array(settings.mesh.focus, dtype=np.float64)
        return mesh
    return random_scene(settings.scene, np.random.default_rng([settings.seed, SCENE]))


def prepare(settings: SceneFile, beside: Path, effects: Effects) -> Film:
    """All that is needed to film: scene, path, camera and effects.

    Raises:
        InputError: as for `open_scene`, or the path does not fit into the scene, or the lens not over the image.
    """
    for name in ("depth_noise", "depth_offset"):
        if getattr(effects, name) is not None and not settings.depth:
            raise InputError(f"{name} is listed, but the capture has no depth; set `depth: true` in the scene file")
    if settings.camera.kind != PINHOLE and (wrong := [name for name in LENS_EFFECTS if getattr(effects, name) is not None]):
        kind = f"camera.kind: {settings.camera.kind}"
        raise InputError(f"{wrong[0]} is listed, which is modelled for a pinhole camera only; leave it out with {kind}")
    scene = open_scene(settings, beside)
    if settings.markers:
        if not isinstance(scene, Scene):
            raise InputError("markers can be put into procedural scenes only; put them into the mesh itself, or leave `markers` out")
        scene = with_markers(scene, settings.markers)
    motion = plan(scene, settings.path, np.random.default_rng([settings.seed, PATH]))
    if settings.camera.kind == PANORAMA:  # such cameras stand upright, or their software turns what they filmed so
        motion = replace(motion, curve=replace(motion.curve, forward=motion.curve.forward * [1.0, 1.0, 0.0]))
    if effects.background is not None:
        effects = replace(effects, background=replace(effects.background, seed=effects.background.seed + settings.seed))
    camera = FilmCamera(settings.camera.intrinsics(), settings.side, settings.depth)
    return Film(scene, camera, motion, settings.path.times(), effects, settings.seed)


def simulate(
    settings: SceneFile,
    out: Path | str,
    beside: Path | str = ".",
    effects: Any = None,
    progress: Progress = SILENT,
    workers: int | None = None,
) -> Film:
    """Film a scene into the folder `out`.

    Args:
        beside: the folder that the scene file's paths start from.
        effects: a list that replaces the scene file's; None: the scene file's.
        workers: frames drawn at the same time; None: one a core, at most 4. It changes no bit of the result.

    Returns:
        what was filmed, for comparing with what is found in it.

    Raises:
        InputError: settings that do not work, or a folder that already holds something.
        OutputError: a file cannot be written.
        Interrupted: stopped by the user; nothing is left behind.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} already holds something; give a new folder with --out, or remove it")
    listed = parse(settings.effects if effects is None else effects, "the effects")
    film = prepare(settings, Path(beside), listed)
    suffix = ".png" if listed.compression is None else ".jpg"
    with (
        atomic_path(out) as temporary,
        closing(CaptureWriter(temporary, film.intrinsics, settings.path.fps, settings.output, suffix)) as writer,
        drawing(film.shot, range(len(film)), workers) as shots,
    ):
        writer.receiver = None if settings.gps is None else Receiver(settings.gps, settings.seed)
        for done, shot in enumerate(shots):
            progress.check()
            writer.add(shot)
            progress.update(done + 1, len(film))
        about = {name: value for name, value in asdict(settings).items() if name != "effects"}  # which stand in a file of their own
        writer.finish(about, film.effects.describe(), film.scene.mesh())
    return film


class CaptureWriter:
    """Writes the shots of one capture into a folder, in order.

    Args:
        output: "frames", "photos" or "video".
        suffix: ".jpg" when images are compressed, else ".png".
        per_pixel: whether the ground truth has depth and normals of each frame, 10 bytes a pixel.
    """

    def __init__(self, folder: Path, intrinsics: Intrinsics, fps: float, output: str, suffix: str, per_pixel: bool = True) -> None:
        self.folder, self.intrinsics, self.output, self.suffix, self.per_pixel = folder, intrinsics, output, suffix, per_pixel
        self.entries, self.poses, self.facts = (list[dict[str, Any]]() for _ in range(3))
        self.receiver: Receiver | None = None  # where images get their GPS from
        self._video: cv2.VideoWriter | None = None
        for name in (f"{TRUTH}/frames" if per_pixel else TRUTH, *(() if output == "video" else ("images",))):
            (folder / name).mkdir(parents=True, exist_ok=True)
        if output == "video":
            size = (intrinsics.width, intrinsics.height)
            self._video = cv2.VideoWriter(str(folder / "video.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
            if not self._video.isOpened():
                raise OutputError(f"cannot write {folder / 'video.mp4'}: OpenCV has no mp4 encoder; see `fieldfuse doctor`")

    def add(self, shot: Shot) -> None:
        """Write one frame."""
        name = f"{shot.index:06d}"
        truth = f"{TRUTH}/frames/{name}.safetensors"
        entry: dict[str, Any] = {"file_path": f"images/{name}{self.suffix}"}
        if self._video is not None:
            self._video.write(cv2.cvtColor(shot.rgb, cv2.COLOR_RGB2BGR))
        else:
            data = shot.jpeg if shot.jpeg is not None else encoded(cv2.cvtColor(shot.rgb, cv2.COLOR_RGB2BGR))
            tagged = data if self.receiver is None else self.receiver.tagged(data, shot.world_from_camera[:3, 3], shot.index)
            (self.folder / entry["file_path"]).write_bytes(tagged)
        if shot.sensor_depth is not None:
            entry["depth_file_path"] = f"depth/{name}.png"
            (self.folder / "depth").mkdir(exist_ok=True)
            steps = np.round(shot.sensor_depth.astype(np.float64) * DEPTH_STEPS)  # 0 where there is none or it is too far (65.5 m)
            stored = np.where((steps > 0) & (steps < MOST_STEPS), steps, 0).astype(np.uint16)
            (self.folder / entry["depth_file_path"]).write_bytes(encoded(stored))
        entry["transform_matrix"] = opengl_from_world(shot.world_from_camera).tolist()
        self.entries.append(entry)
        if self.per_pixel:
            exact = {"depth": np.ascontiguousarray(shot.depth), "normals": shot.normals.astype(np.float16)}
            if shot.passed is not None:
                exact["passers"] = shot.passed.astype(np.uint8)
            (self.folder / truth).write_bytes(save(exact))
        picture = {"video_index": shot.index} if self.output == "video" else {"picture": entry["file_path"]}
        exactly = {"truth": truth} if self.per_pixel else {}
        self.poses.append({**picture, **exactly, "seconds": shot.seconds, "world_from_camera": shot.world_from_camera.tolist()})
        self.facts.append({**picture, **shot.facts})

    def finish(self, about: dict[str, Any], effects: dict[str, Any], mesh: Mesh) -> None:
        """Write what describes all frames; `transforms.json` as instant-ngp and nerfstudio read it: OpenGL axes, pixel centres at +0.5."""
        self.close()
        lens, truth = self.intrinsics, self.folder / TRUTH
        if self.output == "frames":
            size = {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
            bent = dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.distortion, strict=False))
            scale = {"integer_depth_scale": 1 / DEPTH_STEPS} if any("depth_file_path" in entry for entry in self.entries) else {}
            model = {"camera_model": {FISHEYE: "OPENCV_FISHEYE", EQUIRECTANGULAR: "EQUIRECTANGULAR"}.get(lens.lens, MODELS[lens.distorted])}
            write_json(self.folder / "transforms.json", {**model, **size, **bent, **scale, "frames": self.entries})
        write_json(truth / "cameras.json", {"intrinsics": lens.to_dict(), "frames": self.poses})
        write_json(truth / "effects.json", {"effects": effects, "frames": self.facts})
        write_json(truth / "scene.json", about)
        write_mesh(truth / "mesh.ply", mesh)

    def close(self) -> None:
        """Release open files; harmless after `finish`."""
        if self._video is not None:
            self._video.release()


def encoded(picture: Array) -> bytes:
    """As PNG."""
    _, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    return data.tobytes()


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Binary PLY with `double` positions; nothing but vertices and triangles."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(mesh.triangles), dtype=[("count", "u1"), ("corner", "<i4", (3,))])
    faces["count"], faces["corner"] = 3, mesh.triangles
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
        file.write(faces.tobytes())
