"""Writers of the made-up scene, one a layout. Each states the layout's convention in its own words, from the cameras' axes."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from tests.capture import programs
from tests.capture.films import film
from tests.capture.made import Eye, Pinhole, eyes, render, save_depth, save_picture

OFF_CENTRE = Pinhole(80, 60, 71.0, 73.0, 42.25, 27.5)
CENTRED = Pinhole(80, 60, 72.0, 72.0, 40.0, 30.0)
EIGHTH_525 = Pinhole(80, 60, 525 / 8, 525 / 8, 40.0, 30.0)
EIGHTH_585 = Pinhole(80, 60, 585 / 8, 585 / 8, 40.0, 30.0)
PHONE = Pinhole(160, 120, 128.0, 128.0, 81.0, 59.0)
SCANNET_COLOUR = Pinhole(96, 72, 86.0, 87.0, 47.25, 37.5)


def rows(matrix: Array) -> str:
    return "\n".join(" ".join(f"{value:.12g}" for value in row) for row in np.asarray(matrix)) + "\n"


def transforms_entry(eye: Eye, name: str) -> dict:
    return {"file_path": name, "transform_matrix": eye.opengl().tolist()}


def shared_camera(camera: Pinhole) -> dict:
    return {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height}


def write_transforms(root: Path, depth_scale: float = 1000.0) -> Pinhole:
    frames = []
    for index, eye in enumerate(eyes()):
        picture, depth = render(eye, OFF_CENTRE)
        save_picture(root / f"images/{index:04d}.png", picture)
        save_depth(root / f"depth/{index:04d}.png", depth, depth_scale)
        frames.append({**transforms_entry(eye, f"images/{index:04d}.png"), "depth_file_path": f"depth/{index:04d}.png"})
    (root / "transforms.json").write_text(json.dumps({**shared_camera(OFF_CENTRE), "frames": frames}))
    return OFF_CENTRE


def write_blender(root: Path) -> Pinhole:
    angle = 2 * np.arctan(0.5 * CENTRED.width / CENTRED.fx)
    entries: dict[str, list] = {"train": [], "test": []}
    for index, eye in enumerate(eyes()):
        split = "train" if index < 3 else "test"
        picture, depth = render(eye, CENTRED)
        name = f"r_{index % 3}"  # numbers start again in each split
        save_picture(root / split / f"{name}.png", np.dstack([picture, np.where(depth > 0, 255, 0).astype(np.uint8)]))
        entries[split].append(transforms_entry(eye, f"./{split}/{name}"))
    for split, frames in entries.items():
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return CENTRED


def quaternion(rotation: Array) -> Array:
    """(w, x, y, z) of a rotation matrix (3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]])


POINTS = np.array([[0.1, -0.2, 1.2], [0.5, 0.5, 0.0], [-0.4, 0.2, 0.0]])


def colmap_images(root: Path) -> list[tuple[str, Array, Array]]:
    out = []
    for index, eye in enumerate(eyes()):
        save_picture(root / f"images/view {index}.png", render(eye, OFF_CENTRE)[0])
        out.append((f"view {index}.png", quaternion(eye.rotation()), -eye.rotation() @ eye.centre))
    return out


def write_colmap_bin(root: Path) -> Pinhole:
    folder = root / "sparse/0"
    folder.mkdir(parents=True)
    c = OFF_CENTRE
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, c.width, c.height, c.fx, c.fy, c.cx, c.cy))
    body = b""
    images = colmap_images(root)
    for number, (name, q, t) in enumerate(images):
        seen = b"".join(struct.pack("<ddQ", 3.0, 4.0, point + 1) for point in range(len(POINTS)))
        body += struct.pack("<I7dI", number + 1, *q, *t, 7) + name.encode() + b"\0" + struct.pack("<Q", len(POINTS)) + seen
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(images)) + body)
    points = b""
    for number, point in enumerate(POINTS):
        track = b"".join(struct.pack("<II", image + 1, number) for image in range(len(images)))
        points += struct.pack("<QdddBBBdQ", number + 1, *point, 9, 9, 9, 0.5, len(images)) + track
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(POINTS)) + points)
    return c


def write_colmap_txt(root: Path) -> Pinhole:
    folder = root / "sparse/0"
    folder.mkdir(parents=True)
    c = OFF_CENTRE
    (folder / "cameras.txt").write_text(f"# list\n7 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    lines = ["# list"]
    for number, (name, q, t) in enumerate(colmap_images(root)):
        lines += [f"{number + 1} {' '.join(map(repr, map(float, [*q, *t])))} 7 {name}", "1.5 2.5 -1" if number % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("".join(f"{n} {p[0]} {p[1]} {p[2]} 9 9 9 0.5 1 0\n" for n, p in enumerate(POINTS)))
    return c


def write_seven_scenes(root: Path, folder: str = "") -> Pinhole:
    for index, eye in enumerate(eyes()):
        save_picture(root / folder / f"frame-{index:06d}.color.png", render(eye, EIGHTH_525)[0])
        save_depth(root / folder / f"frame-{index:06d}.depth.png", render(eye, EIGHTH_585)[1])
        (root / folder / f"frame-{index:06d}.pose.txt").write_text(rows(eye.pose()))
    return EIGHTH_525


def write_tum(root: Path) -> Pinhole:
    colour, depths, truth = ["# colour"], ["# depth"], ["# time tx ty tz qx qy qz qw"]
    for index, eye in enumerate(eyes()):
        time = 1000 + 0.1 * index
        picture, depth = render(eye, EIGHTH_525)
        save_picture(root / f"rgb/{time:.6f}.png", picture)
        save_depth(root / f"depth/{time + 0.012:.6f}.png", depth, 5000.0)
        colour.append(f"{time:.6f} rgb/{time:.6f}.png")
        depths.append(f"{time + 0.012:.6f} depth/{time + 0.012:.6f}.png")
        w, x, y, z = quaternion(eye.rotation().T)
        truth.append(f"{time - 0.004:.6f} {' '.join(map(repr, map(float, [*eye.centre, x, y, z, w])))}")
        truth.append(f"{time + 0.05:.6f} 9 9 9 0 0 0 1")
    for name, lines in (("rgb", colour), ("depth", depths), ("groundtruth", truth)):
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return EIGHTH_525


def whole_centres(camera: Pinhole) -> Array:
    """K as calibration tools write it: the middle of the first pixel is 0."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def write_scannet(root: Path) -> Pinhole:
    for index, eye in enumerate(eyes()):
        save_picture(root / f"color/{index * 5}.jpg", render(eye, SCANNET_COLOUR)[0])
        save_depth(root / f"depth/{index * 5}.png", render(eye, OFF_CENTRE)[1])
        (root / "pose").mkdir(exist_ok=True)
        (root / f"pose/{index * 5}.txt").write_text(rows(eye.pose()))
    (root / "intrinsic").mkdir()
    for name, camera in (("color", SCANNET_COLOUR), ("depth", OFF_CENTRE)):
        k = np.eye(4)
        k[:3, :3] = whole_centres(camera)
        (root / f"intrinsic/intrinsic_{name}.txt").write_text(rows(k))
    return SCANNET_COLOUR


def write_sens(root: Path) -> Pinhole:
    """The file that ScanNet publishes beside meshes and a text; its tracking was lost in frame 2."""
    pictures = [cv2.imencode(".jpg", render(eye, SCANNET_COLOUR)[0][..., ::-1])[1].tobytes() for eye in eyes()]
    depths = [zlib.compress((1000 * render(eye, OFF_CENTRE)[1]).round().astype("<u2").tobytes()) for eye in eyes()]
    poses = [eye.pose() for eye in eyes()]
    root.mkdir(parents=True, exist_ok=True)
    lost = (pictures[0], depths[0], np.full((4, 4), -np.inf))
    frames = [*zip(pictures, depths, poses, strict=True)]
    (root / "scene0000_00.sens").write_bytes(sens_of([*frames[:2], lost, *frames[2:]]))
    (root / "scene0000_00.txt").write_text("sceneType = Kitchen\n")
    return SCANNET_COLOUR


def sens_of(frames: list[tuple[bytes, bytes, Array]], codings: tuple[int, int] = (2, 1), count: int | None = None) -> bytes:
    """The file of frames (picture and depth as they are packed, pose), 30 a second, with the readings of one other sensor behind them."""

    def k(camera: Pinhole) -> Array:
        matrix = np.eye(4, dtype="<f4")
        matrix[:3, :3] = whole_centres(camera)
        return matrix

    name, still = b"StructureSensor", np.eye(4, dtype="<f4")
    out = struct.pack("<IQ", 4, len(name)) + name
    out += b"".join(matrix.tobytes() for matrix in (k(SCANNET_COLOUR), still, k(OFF_CENTRE), still))
    c, d = SCANNET_COLOUR, OFF_CENTRE
    out += struct.pack("<2i4IfQ", *codings, c.width, c.height, d.width, d.height, 1000.0, len(frames) if count is None else count)
    for index, (picture, depth, pose) in enumerate(frames):
        time = 1000 + 33333 * index
        out += np.asarray(pose, "<f4").tobytes() + struct.pack("<4Q", time, time, len(picture), len(depth)) + picture + depth
    return out + struct.pack("<Q15dQ", 1, *[0.0] * 15, 1000)


def write_llff(root: Path) -> Pinhole:
    table = []
    for index, eye in enumerate(eyes()):
        save_picture(root / f"images_4/IMG_{index:02d}.png", render(eye, CENTRED)[0])
        axes = np.stack([eye.down, eye.right, -eye.forward, eye.centre], axis=1)
        size = np.array([[4 * CENTRED.height], [4 * CENTRED.width], [4 * CENTRED.fx]])
        table.append(np.concatenate([np.hstack([axes, size]).ravel(), [1.0 + index, 9.0 - index]]))
    np.save(root / "poses_bounds.npy", np.array(table))
    return CENTRED


def write_dtu(root: Path) -> Pinhole:
    arrays = {}
    for index, eye in enumerate(eyes()):
        save_picture(root / f"image/{index:06d}.png", render(eye, OFF_CENTRE)[0])
        projection = whole_centres(OFF_CENTRE) @ np.hstack([eye.rotation(), -eye.rotation() @ eye.centre[:, None]])
        arrays[f"world_mat_{index}"] = np.vstack([projection * (-3.5 if index % 2 else 0.25), [0, 0, 0, 1]])
        arrays[f"scale_mat_{index}"] = np.array([[2.0, 0, 0, 0.1], [0, 2.0, 0, -0.2], [0, 0, 2.0, 0.6], [0, 0, 0, 1]])
    np.savez(root / "cameras.npz", **arrays)
    return OFF_CENTRE


def write_redwood(root: Path) -> Pinhole:
    log = ""
    for index, eye in enumerate(eyes()):
        picture, depth = render(eye, OFF_CENTRE)
        save_picture(root / f"color/{index:05d}.jpg", picture)
        save_depth(root / f"depth/{index:05d}.png", depth)
        log += f"{index} {index} {index + 1}\n{rows(eye.pose())}"
    (root / "trajectory.log").write_text(log)
    c = OFF_CENTRE
    by_column = [c.fx, 0, 0, 0, c.fy, 0, c.cx - 0.5, c.cy - 0.5, 1]
    (root / "camera_intrinsics.json").write_text(json.dumps({"width": c.width, "height": c.height, "intrinsic_matrix": by_column}))
    return c


def write_replica(root: Path) -> Pinhole:
    lines = []
    for index, eye in enumerate(eyes()):
        picture, depth = render(eye, OFF_CENTRE)
        save_picture(root / f"results/frame{index:06d}.jpg", picture)
        save_depth(root / f"results/depth{index:06d}.png", np.where(depth < 9.99, depth, 0), 6553.5)  # 16 bits reach 10 m
        lines.append(" ".join(f"{value:.18e}" for value in eye.pose().ravel()))
    (root / "traj.txt").write_text("\n".join(lines) + "\n")
    c = OFF_CENTRE
    told = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5, "scale": 6553.5}
    (root / "cam_params.json").write_text(json.dumps({"camera": told}))
    return c


def write_polycam(root: Path) -> Pinhole:
    """As the app exports it: depth and confidence at a quarter of the pictures' size, and cameras before and after loops were closed."""
    quarter, place = quarter_size(PHONE), root / "keyframes"
    for index, eye in enumerate(eyes()):
        name = f"{100000 + 333 * index}"
        save_picture(place / f"corrected_images/{name}.jpg", render(eye, PHONE)[0])
        depth = render(eye, quarter)[1]
        save_depth(place / f"depth/{name}.png", depth)
        assert (place / "confidence").mkdir(exist_ok=True) is None
        assert cv2.imwrite(
            str(place / f"confidence/{name}.png"), np.where(np.arange(quarter.width) < 2, 0, 255 - 0 * depth).astype(np.uint8)
        )
        pose = eye.opengl()
        told = {f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)}
        c = PHONE
        told |= {
            "fx": c.fx,
            "fy": c.fy,
            "cx": c.cx,
            "cy": c.cy,
            "width": c.width,
            "height": c.height,
            "blur_score": 90.1,
            "timestamp": index,
        }
        for folder, shift in (("corrected_cameras", 0.0), ("cameras", 0.07 * index)):
            (place / folder).mkdir(exist_ok=True)
            (place / folder / f"{name}.json").write_text(json.dumps({**told, "t_03": told["t_03"] + shift}))
    return PHONE


def write_stray(root: Path, header: bool = True) -> Pinhole:
    """As the app records it; `header`: as it does since 2022."""
    quarter, c = quarter_size(PHONE), PHONE
    root.mkdir(parents=True, exist_ok=True)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"] if header else []
    for index, eye in enumerate(eyes()):
        depth = render(eye, quarter)[1]
        save_depth(root / f"depth/{index:06d}.png", depth)
        (root / "confidence").mkdir(exist_ok=True)
        assert cv2.imwrite(
            str(root / f"confidence/{index:06d}.png"), np.where(np.arange(quarter.width) < 2, 0, 2 - 0 * depth).astype(np.uint8)
        )
        w, x, y, z = quaternion(eye.rotation().T)
        values = [f"{value:.9f}" for value in (*eye.centre, x, y, z, w)]
        lines.append(", ".join([f"{7.5 + index / 60:.6f}", f"{index:06d}", *values] if header else values))
    (root / "odometry.csv").write_text("\n".join(lines))
    (root / "camera_matrix.csv").write_text(f"{c.fx}, 0.0, {c.cx}\n0.0, {c.fy}, {c.cy}\n0.0, 0.0, 1.0")
    film(root / "rgb.mp4", [render(eye, PHONE)[0] for eye in eyes()], fps=60)
    return PHONE


def write_record3d(root: Path, camera: Pinhole = PHONE) -> Pinhole:
    """As a recording comes out of its zip file: depth at a quarter of the pictures' size, the matrix column by column."""
    from imagecodecs import lzfse_encode

    quarter, c, poses = quarter_size(camera), camera, []
    for index, eye in enumerate(eyes()):
        save_picture(root / f"rgbd/{index}.jpg", render(eye, camera)[0])
        depth = render(eye, quarter)[1].astype(np.float32)
        believed = np.where(np.arange(quarter.width) < 2, 0, 2 - 0 * depth).astype(np.uint8)
        (root / f"rgbd/{index}.depth").write_bytes(lzfse_encode(np.where(depth > 0, depth, np.nan).astype("<f4").tobytes()))
        (root / f"rgbd/{index}.conf").write_bytes(lzfse_encode(believed.tobytes()))
        w, x, y, z = quaternion(eye.opengl()[:3, :3])
        poses.append([x, y, z, w, *eye.centre])
    told = {
        "w": c.width, "h": c.height, "dw": quarter.width, "dh": quarter.height, "fps": 60, "cameraType": 1, "deviceType": 3,
        "K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1], "perFrameIntrinsicCoeffs": [[c.fx, c.fy, c.cx, c.cy]] * len(poses),
        "frameTimestamps": [7.5 + index / 60 for index in range(len(poses))], "initPose": [0, 0, 0, 1, 0, 0, 0],
    }  # fmt: skip
    (root / "metadata").write_text(json.dumps({**told, "poses": np.array(poses).tolist()}))
    return camera


def write_scanner3d(root: Path) -> Pinhole:
    """As the app exports all it has: a JSON, depth and confidence for every frame, a picture for every other."""
    quarter, c = quarter_size(PHONE), PHONE
    for index, eye in enumerate(eye for eye in eyes() for _ in range(2)):
        if index % 2 == 0:
            save_picture(root / f"frame_{index:05d}.jpg", render(eye, PHONE)[0])
        depth = render(eye, quarter)[1]
        save_depth(root / f"depth_{index:05d}.png", depth)
        believed = np.where(np.arange(quarter.width) < 2, 0, 2 - 0 * depth).astype(np.uint8)
        assert cv2.imwrite(str(root / f"conf_{index:05d}.png"), believed)
        told = {
            "cameraPoseARFrame": eye.opengl().ravel().tolist(),
            "intrinsics": [c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1],
            "frame_index": index, "time": 7.5 + index / 60, "motionQuality": 1,
        }  # fmt: skip
        (root / f"frame_{index:05d}.json").write_text(json.dumps(told))
    (root / "info.json").write_text(json.dumps({"device": "phone"}))
    (root / "thumb_00.jpg").write_bytes((root / "frame_00000.jpg").read_bytes())
    return PHONE


def zipped(root: Path, path: Path, folder: str = "") -> Path:
    """The folder as a zip file at `path`, its files below `folder` in it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for source in sorted(root.rglob("*")):
            if source.is_file():
                file.write(source, folder + source.relative_to(root).as_posix())
    return path


LAYOUTS: dict[str, tuple[str, Callable[[Path], Pinhole]]] = {
    "transforms": ("transforms", write_transforms),
    "blender": ("blender", write_blender),
    "colmap bin": ("colmap", write_colmap_bin),
    "colmap txt": ("colmap", write_colmap_txt),
    "7scenes": ("7scenes", write_seven_scenes),
    "tum": ("tum", write_tum),
    "scannet": ("scannet", write_scannet),
    "sens": ("scannet", write_sens),
    "llff": ("llff", write_llff),
    "dtu": ("dtu", write_dtu),
    "redwood": ("redwood", write_redwood),
    "replica": ("replica", write_replica),
    "polycam": ("polycam", write_polycam),
    "stray": ("stray", write_stray),
    "record3d": ("record3d", write_record3d),
    "scanner3d": ("scanner3d", write_scanner3d),
    "metashape": ("metashape", programs.write_metashape),
    "realitycapture": ("realitycapture", programs.write_realitycapture),
    "xmp": ("realitycapture", programs.write_xmp),
    "opensfm": ("opensfm", programs.write_opensfm),
    "meshroom": ("meshroom", programs.write_meshroom),
    "bundler": ("bundler", programs.write_bundler),
    "scannetpp": ("scannetpp", programs.write_scannetpp),
    "arkitscenes": ("arkitscenes", programs.write_arkitscenes),
    "rgbd": ("rgbd", programs.write_rgbd),
}


def true_eyes(layout: str) -> list[Eye]:
    """The cameras in the order in which the capture's frames stand: by name, and a split's name comes first (test before train)."""
    made = eyes()
    return made[3:] + made[:3] if layout == "blender" else made


def quarter_size(camera: Pinhole) -> Pinhole:
    return half_size(half_size(camera))


def half_size(camera: Pinhole) -> Pinhole:
    return replace(
        camera, width=camera.width // 2, height=camera.height // 2, fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2
    )
