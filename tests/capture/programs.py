"""Writers of the made-up scene as photogrammetry programs and data sets export it, each in the program's own conventions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array
from tests.capture.made import Eye, Pinhole, eyes, render, save_depth, save_picture

OFF_CENTRE = Pinhole(80, 60, 71.0, 73.0, 42.25, 27.5)
SQUARE = Pinhole(80, 60, 72.0, 72.0, 42.25, 27.5)
CENTRED = Pinhole(80, 60, 72.0, 72.0, 40.0, 30.0)
POINTS = np.array([[0.1, -0.2, 1.2], [0.5, 0.5, 0.0], [-0.4, 0.2, 0.0]])
WORLD_SCALE, WORLD_SHIFT = 2.5, np.array([10.0, -20.0, 3.0])
WORLD_TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()


def words(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())


def pictures(root: Path, camera: Pinhole, name: str = "IMG_{:02d}.png") -> list[tuple[str, Eye]]:
    out = []
    for index, eye in enumerate(eyes()):
        file = name.format(index)
        save_picture(root / file, render(eye, camera)[0])
        out.append((file, eye))
    return out


# ------------------------------------------------------------------------------------------------ Metashape


def metashape_xml(cameras: str, calibration: str, transform: str = "", reference: str = 'LOCAL_CS["Local Coordinates (m)"]') -> str:
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="X100, 23mm" type="frame">
        <resolution width="80" height="60"/>
        <property name="layer_index" value="0"/>
        <calibration type="frame" class="initial"><resolution width="80" height="60"/><f>999</f></calibration>
        {calibration}
        <covariance><params>f cx cy</params></covariance>
      </sensor>
    </sensors>
    <components next_id="1" active_id="0"><component id="0" label="Component 1">{transform}</component></components>
    <cameras next_id="9" next_group_id="0">
{cameras}
    </cameras>
    <reference>{reference}</reference>
  </chunk>
</document>
"""


def metashape_camera(number: int, label: str, eye: Eye) -> str:
    """In the component's frame, from which the world comes by scale, turn and shift."""
    local = np.eye(4)
    local[:3, :3] = WORLD_TURN.T @ np.stack([eye.right, eye.down, eye.forward], axis=1)
    local[:3, 3] = WORLD_TURN.T @ (eye.centre - WORLD_SHIFT) / WORLD_SCALE
    transform = f"<transform>{words(local)}</transform><rotation_covariance>0 0 0</rotation_covariance>"
    return f'<camera id="{number}" sensor_id="0" component_id="0" label="{label}">{transform}<orientation>1</orientation></camera>'


METASHAPE_WORLD = (
    f'<transform><rotation locked="true">{words(WORLD_TURN)}</rotation><translation locked="true">{words(WORLD_SHIFT)}</translation>'
    f'<scale locked="true">{WORLD_SCALE}</scale></transform>'
)


def metashape_calibration(camera: Pinhole, lens: str = "") -> str:
    cx, cy = camera.cx - camera.width / 2, camera.cy - camera.height / 2
    size = f'<resolution width="{camera.width}" height="{camera.height}"/>'
    values = f"<f>{camera.fy}</f><cx>{cx}</cx><cy>{cy}</cy><b1>{camera.fx - camera.fy}</b1>{lens}"
    return f'<calibration type="frame" class="adjusted">{size}{values}</calibration>'


def write_metashape(root: Path) -> Pinhole:
    """Labels without suffix, some of them in a group, and a camera that was not aligned."""
    cameras = [metashape_camera(number, name[:-4], eye) for number, (name, eye) in enumerate(pictures(root / "photos", OFF_CENTRE))]
    cameras.append('<camera id="7" sensor_id="0" label="IMG_99"><orientation>1</orientation></camera>')
    grouped = f'<group id="0" label="Group 1" type="folder">{"".join(cameras[:2])}</group>' + "\n".join(cameras[2:])
    (root / "cameras.xml").write_text(metashape_xml(grouped, metashape_calibration(OFF_CENTRE), METASHAPE_WORLD))
    return OFF_CENTRE


# ------------------------------------------------------------------------------------------------ RealityCapture


def heading_pitch_roll(eye: Eye) -> Array:
    """Degrees: turns of a camera that looks down with its top to the north, about north, then east, then (clockwise) up."""
    right, top, back = eye.right, -eye.down, -eye.forward
    roll = np.arctan2(-right[2], back[2])
    pitch = np.arcsin(np.clip(top[2], -1, 1))
    heading = np.arctan2(top[0], top[1])
    return np.degrees([heading, pitch, roll])


def write_realitycapture(root: Path) -> Pinhole:
    c, side = SQUARE, 80
    lines = ["#cameras 5", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, eye in pictures(root / "images", c):
        lens = [c.fx / side * 36, (c.cx - c.width / 2) / side, (c.cy - c.height / 2) / side, *[0.0] * 6]
        lines.append(",".join([name, *(f"{value:.15g}" for value in (*eye.centre, *heading_pitch_roll(eye), *lens))]))
    (root / "registration.csv").write_text("\n".join(lines) + "\n")
    return c


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute"
       xcr:DistortionModel="{model}" xcr:FocalLength35mm="{focal}"
       xcr:Skew="0" xcr:AspectRatio="{aspect}" xcr:PrincipalPointU="{u}"
       xcr:PrincipalPointV="{v}" xcr:CalibrationPrior="exact" xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      <xcr:Rotation>{rotation}</xcr:Rotation>
      <xcr:Position>{position}</xcr:Position>
      <xcr:DistortionCoeficients>{lens}</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""


def write_xmp(root: Path, model: str = "brown3", lens: str = "0 0 0 0 0 0") -> Pinhole:
    c = OFF_CENTRE
    for name, eye in pictures(root, c):
        u, v = (c.cx - c.width / 2) / 80, (c.cy - c.height / 2) / 80
        values = {"focal": c.fx / 80 * 36, "aspect": c.fy / c.fx, "u": u, "v": v, "rotation": words(eye.rotation())}
        text = XMP.format(model=model, lens=lens, position=words(eye.centre), **values)
        (root / name).with_suffix(".xmp").write_text(text)
    return c


# ------------------------------------------------------------------------------------------------ OpenSfM, Meshroom, Bundler


def opensfm_shots(named: list[tuple[str, Eye]]) -> dict[str, Any]:
    return {
        name: {
            "rotation": Rotation.from_matrix(eye.rotation()).as_rotvec().tolist(),
            "translation": (-eye.rotation() @ eye.centre).tolist(),
            "camera": "v2 maker model 80 60 brown 0.9",
            "orientation": 1,
            "gps_position": [0.0, 0.0, 0.0],
        }
        for name, eye in named
    }


def opensfm_camera(camera: Pinhole, **lens: float) -> dict[str, Any]:
    c, side = camera, max(camera.width, camera.height)
    place = {"c_x": (c.cx - c.width / 2) / side, "c_y": (c.cy - c.height / 2) / side}
    size = {"projection_type": "brown", "width": c.width, "height": c.height}
    return {**size, "focal_x": c.fx / side, "focal_y": c.fy / side, **place, **lens}


def write_opensfm(root: Path) -> Pinhole:
    """A project of OpenDroneMap, of which two photos were not joined to the others and were reconstructed apart."""
    named = pictures(root / "images", OFF_CENTRE)
    cameras = {"v2 maker model 80 60 brown 0.9": opensfm_camera(OFF_CENTRE)}
    points = {str(index): {"color": [9, 9, 9], "coordinates": point.tolist()} for index, point in enumerate(POINTS)}
    place = {"latitude": 50.8, "longitude": -0.14, "altitude": 12.0}
    whole = {"cameras": cameras, "shots": opensfm_shots(named), "points": points, "reference_lla": place}
    rest = {"cameras": cameras, "shots": opensfm_shots(named[:1]), "points": {}}
    (root / "opensfm").mkdir()
    (root / "opensfm/reconstruction.json").write_text(json.dumps([rest, whole]))
    return OFF_CENTRE


def meshroom_scene(camera: Pinhole, named: list[tuple[str, Eye]], version: tuple[int, int, int] = (1, 2, 6)) -> dict[str, Any]:
    """With numbers in quotes, as the program writes them; paths are of another machine."""
    c = camera
    views = [
        {"viewId": str(10 + index), "poseId": str(10 + index), "intrinsicId": "7", "path": f"D:/photos/{name}", "metadata": {}}
        for index, (name, _) in enumerate(named)
    ]
    poses = [
        {
            "poseId": str(10 + index),
            "pose": {
                "transform": {
                    "rotation": [repr(float(value)) for value in eye.rotation().T.ravel()],  # camera_from_world by column
                    "center": [repr(float(value)) for value in eye.centre],
                },
                "locked": "0",
            },
        }
        for index, (_, eye) in enumerate(named)
    ]
    middle = [str(c.cx - c.width / 2), str(c.cy - c.height / 2)]
    lens: dict[str, Any] = {"intrinsicId": "7", "width": "80", "height": "60", "sensorWidth": "8", "principalPoint": middle}
    lens |= {"type": "radial3", "focalLength": str(c.fx / 80 * 8), "pixelRatio": str(c.fy / c.fx), "distortionParams": ["0", "0", "0"]}
    structure = [{"landmarkId": str(index), "X": [str(value) for value in point]} for index, point in enumerate(POINTS)]
    return {"version": [str(part) for part in version], "views": views, "intrinsics": [lens], "poses": poses, "structure": structure}


def write_meshroom(root: Path) -> Pinhole:
    scene = meshroom_scene(OFF_CENTRE, pictures(root, OFF_CENTRE))
    scene["views"].append({"viewId": "99", "poseId": "99", "intrinsicId": "7", "path": "D:/photos/IMG_99.png"})
    folder = root / "MeshroomCache/StructureFromMotion/0a1b"
    folder.mkdir(parents=True)
    (folder / "cameras.sfm").write_text(json.dumps(scene, indent=4))
    return OFF_CENTRE


def write_bundler(root: Path) -> Pinhole:
    """Names as Bundler lists them, with the focal length that EXIF gives; one camera was not registered."""
    c = CENTRED
    named = pictures(root / "images", c)
    lines = ["# Bundle file v0.3", f"{len(named) + 1} {len(POINTS)}"]
    lines += ["0 0 0", *["0 0 0"] * 4]
    for _, eye in named:
        rotation = np.stack([eye.right, -eye.down, -eye.forward])
        lines += [f"{c.fx} 0 0", *(words(row) for row in rotation), words(-rotation @ eye.centre)]
    for point in POINTS:
        lines += [words(point), "200 100 50", "2 0 5 1.5 -2.5 1 7 3.25 4.5"]
    (root / "bundle.out").write_text("\n".join(lines) + "\n")
    (root / "list.txt").write_text("\n".join(["images/lost.png", *(f"images/{name} 0 {c.fx}" for name, _ in named)]) + "\n")
    return c


# ------------------------------------------------------------------------------------------------ data sets


def write_scannetpp(root: Path) -> Pinhole:
    """A scene's DSLR part; as published, its frames stand in two lists, and the json does not name the images' folder."""
    c = OFF_CENTRE
    named = pictures(root / "dslr/resized_undistorted_images", c, "DSC{:05d}.JPG")
    for name, _ in named:
        mask = np.full((60, 80, 3), 255, np.uint8)
        mask[:10] = 0
        save_picture(root / "dslr/resized_undistorted_masks" / Path(name).with_suffix(".png"), mask)
    frames = [
        {"file_path": name, "mask_path": f"{name[:-4]}.png", "is_bad": False, "transform_matrix": eye.opengl().tolist()}
        for name, eye in named
    ]
    lens = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height, "camera_model": "PINHOLE"}
    (root / "dslr/nerfstudio").mkdir()
    data = {**lens, "frames": frames[:3], "test_frames": frames[3:]}
    (root / "dslr/nerfstudio/transforms_undistorted.json").write_text(json.dumps(data))
    lists = {"train": [name for name, _ in named[:3]], "test": [name for name, _ in named[3:]]}
    (root / "dslr/train_test_lists.json").write_text(json.dumps(lists))
    return c


def write_arkitscenes(root: Path) -> Pinhole:
    """One of the raw scenes; poses come six times as often as images, and some files' times are rounded otherwise."""
    c, rows = OFF_CENTRE, []
    for index, eye in enumerate(eyes()):
        time = 305.377 + 0.1 * index
        name = f"41069021_{time:.3f}"
        picture, depth = render(eye, c)
        save_picture(root / f"lowres_wide/{name}.png", picture)
        save_depth(root / f"lowres_depth/{name}.png", depth)
        save_depth(root / f"confidence/{name}.png", np.full(depth.shape, 2e-3))
        lens = root / f"lowres_wide_intrinsics/41069021_{time + 0.001 * (index % 2):.3f}.pincam"
        lens.parent.mkdir(exist_ok=True)
        lens.write_text(f"{c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}")
        turn, shift = Rotation.from_matrix(eye.rotation()).as_rotvec(), -eye.rotation() @ eye.centre
        rows.append(words([time - 0.0012, *turn, *shift]))
        rows += [words([time + 0.0167 * step, *turn + 1, *shift + 1]) for step in range(1, 6)]
    (root / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    return c


def write_rgbd(root: Path) -> Pinhole:
    """Folders of no published layout: poses row by row as TUM has them, ORB-SLAM's camera."""
    c, rows = OFF_CENTRE, []
    for index, eye in enumerate(eyes()):
        picture, depth = render(eye, c)
        save_picture(root / f"raw_imgs/{index:04d}_rgb_raw.png", picture)
        save_depth(root / f"depth_imgs/{index:04d}_depth_raw.png", depth, 5000.0)
        rows.append(words([1341841278.8 + index, *eye.centre, *Rotation.from_matrix(eye.rotation().T).as_quat()]))
    (root / "truth_cam_poses.txt").write_text("\n".join(rows) + "\n")
    lens = {"fx": c.fx, "fy": c.fy, "cx": c.cx - 0.5, "cy": c.cy - 0.5}
    lines = [f"Camera.{name}: {value}" for name, value in lens.items()]
    (root / "TUM3.yaml").write_text("\n".join(["%YAML:1.0", *lines, "DepthMapFactor: 5000.0"]) + "\n")
    return c
