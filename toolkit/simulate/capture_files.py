"""The files of a simulated capture: pictures or a video, `transforms.json`, depth, and the ground truth beside them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from safetensors.numpy import save

from fieldfuse.camera import Array, Intrinsics, opengl_from_world
from fieldfuse.errors import OutputError
from fieldfuse.files import write_json
from fieldfuse.simulate.film import Shot
from fieldfuse.simulate.seen import Mesh

TRUTH = "ground_truth"
DEPTH_STEPS = 1000.0  # stored depth values a metre
MOST_STEPS = 65535


class CaptureWriter:
    """Writes the shots of one capture into a folder, in order.

    Args:
        output: "frames", "photos" or "video".
        suffix: ".jpg" when pictures are compressed, else ".png".
    """

    def __init__(self, folder: Path, intrinsics: Intrinsics, fps: float, output: str, suffix: str) -> None:
        self.folder, self.intrinsics, self.output, self.suffix = folder, intrinsics, output, suffix
        self.entries: list[dict[str, Any]] = []
        self.poses: list[dict[str, Any]] = []
        self.facts: list[dict[str, Any]] = []
        self._video: cv2.VideoWriter | None = None
        for name in ("", TRUTH, f"{TRUTH}/frames", *(() if output == "video" else ("images",))):
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
        elif shot.jpeg is not None:
            (self.folder / entry["file_path"]).write_bytes(shot.jpeg)
        else:
            self._png(entry["file_path"], cv2.cvtColor(shot.rgb, cv2.COLOR_RGB2BGR))
        if shot.sensor_depth is not None:
            entry["depth_file_path"] = f"depth/{name}.png"
            (self.folder / "depth").mkdir(exist_ok=True)
            self._png(entry["depth_file_path"], millimetres(shot.sensor_depth))
        entry["transform_matrix"] = opengl_from_world(shot.world_from_camera).tolist()
        self.entries.append(entry)
        exact = {"depth": np.ascontiguousarray(shot.depth), "normals": shot.normals.astype(np.float16)}
        if shot.passed is not None:
            exact["passers"] = shot.passed.astype(np.uint8)
        (self.folder / truth).write_bytes(save(exact))
        picture = {"video_index": shot.index} if self.output == "video" else {"picture": entry["file_path"]}
        self.poses.append({**picture, "truth": truth, "seconds": shot.seconds, "world_from_camera": shot.world_from_camera.tolist()})
        self.facts.append({**picture, **shot.facts})

    def finish(self, about: dict[str, Any], effects: dict[str, Any], mesh: Mesh) -> None:
        """Write what tells about all frames."""
        if self._video is not None:
            self._video.release()
        if self.output == "frames":
            write_json(self.folder / "transforms.json", transforms(self.intrinsics, self.entries))
        truth = self.folder / TRUTH
        write_json(truth / "cameras.json", {"intrinsics": self.intrinsics.to_dict(), "frames": self.poses})
        write_json(truth / "effects.json", {"effects": effects, "frames": self.facts})
        write_json(truth / "scene.json", about)
        write_mesh(truth / "mesh.ply", mesh)

    def close(self) -> None:
        """Let go of open files; harmless after `finish`."""
        if self._video is not None:
            self._video.release()

    def _png(self, name: str, picture: Array) -> None:
        _, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        (self.folder / name).write_bytes(data.tobytes())


@contextmanager
def writing(folder: Path, intrinsics: Intrinsics, fps: float, output: str, suffix: str) -> Iterator[CaptureWriter]:
    """A writer whose files are closed whatever happens."""
    writer = CaptureWriter(folder, intrinsics, fps, output, suffix)
    try:
        yield writer
    finally:
        writer.close()


def millimetres(depth: Array) -> Array:
    """(H, W) metres → uint16 millimetres, 0 where there is none or it is too far to be stored (65.5 m)."""
    steps = np.round(depth.astype(np.float64) * DEPTH_STEPS)
    return np.where((steps > 0) & (steps < MOST_STEPS), steps, 0).astype(np.uint16)


def transforms(intrinsics: Intrinsics, entries: list[dict[str, Any]]) -> dict[str, Any]:
    """`transforms.json` as instant-ngp and nerfstudio read it: OpenGL axes, pixel centres at +0.5, lens coefficients."""
    keys = ("k1", "k2", "p1", "p2", "k3")
    out: dict[str, Any] = {
        "camera_model": "OPENCV" if intrinsics.distorted else "PINHOLE",
        "w": intrinsics.width,
        "h": intrinsics.height,
        "fl_x": intrinsics.fx,
        "fl_y": intrinsics.fy,
        "cx": intrinsics.cx,
        "cy": intrinsics.cy,
        **dict(zip(keys, intrinsics.distortion, strict=False)),
    }
    if any("depth_file_path" in entry for entry in entries):
        out["integer_depth_scale"] = 1 / DEPTH_STEPS
    return {**out, "frames": entries}


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
