"""Cameras of photogrammetry programs: lenses against the programs' own equations, parts that do not belong together, and refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldfuse.camera import Array, project
from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.images import load_depth, load_mask
from fieldfuse.capture.xml_file import read_xml
from fieldfuse.errors import InputError
from fieldfuse.georeference import ecef
from tests.capture import programs
from tests.capture.layouts import write_colmap_bin, write_transforms
from tests.capture.made import Eye, Pinhole, eyes, pixel_error, render, save_picture, surface_points

Lens = Callable[[Array, Array], tuple[Array, Array]]  # ideal x/z and y/z → distorted


def brown(radial: list[float], to_x: float, to_y: float) -> Lens:
    """`to_x` is the factor of r² + 2x² in x', and of 2xy in y'; `to_y` the other way round."""

    def bend(x: Array, y: Array) -> tuple[Array, Array]:
        r = x**2 + y**2
        factor = 1 + sum(k * r ** (power + 1) for power, k in enumerate(radial))
        return x * factor + to_x * (r + 2 * x**2) + 2 * to_y * x * y, y * factor + to_y * (r + 2 * y**2) + 2 * to_x * x * y

    return bend


def by_angle(radial: list[float]) -> Lens:
    def bend(x: Array, y: Array) -> tuple[Array, Array]:
        r = np.hypot(x, y)
        angle = np.arctan(r)
        factor = angle * (1 + sum(k * angle ** (2 * power + 2) for power, k in enumerate(radial))) / r
        return x * factor, y * factor

    return bend


def division(k: float) -> Lens:
    """Solved step by step from undistorted = distorted / (1 + k distorted²)."""

    def bend(x: Array, y: Array) -> tuple[Array, Array]:
        bent_x, bent_y = x, y
        for _ in range(200):
            factor = 1 + k * (bent_x**2 + bent_y**2)
            bent_x, bent_y = x * factor, y * factor
        return bent_x, bent_y

    return bend


def field_of_view(angle: float) -> Lens:
    def bend(x: Array, y: Array) -> tuple[Array, Array]:
        r = np.hypot(x, y)
        factor = np.arctan(2 * r * np.tan(angle / 2)) / angle / r
        return x * factor, y * factor

    return bend


def seen(eye: Eye, camera: Pinhole, lens: Lens) -> Array:
    """(N, 2) pixels of `surface_points` through a lens."""
    offset = surface_points() - eye.centre
    depth = offset @ eye.forward
    x, y = lens(offset @ eye.right / depth, offset @ eye.down / depth)
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)


def lens_error(capture: Capture, camera: Pinhole, lens: Lens) -> float:
    """Pixels by which the capture's cameras see the points elsewhere than the true ones."""
    worst = 0.0
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        pixels, _ = project(frame.intrinsics, frame.world_from_camera, surface_points())
        worst = max(worst, float(np.abs(pixels - seen(eye, camera, lens)).max()))
    return worst


def said(capture: Capture) -> str:
    return " | ".join(capture.warnings)


# ------------------------------------------------------------------------------------------------ Metashape


def write_with(root: Path, lens: str, kind: str = "frame") -> None:
    programs.write_metashape(root)
    text = (root / "cameras.xml").read_text().replace("</b1>", f"</b1>{lens}").replace('type="frame"', f'type="{kind}"')
    (root / "cameras.xml").write_text(text)


@pytest.mark.parametrize(("k4", "pixels"), [(0.0, 1e-6), (0.08, 0.02)])
def test_metashape_lens(tmp_path: Path, k4: float, pixels: float) -> None:
    write_with(tmp_path, f"<k1>-0.2</k1><k2>0.11</k2><k3>-0.05</k3><k4>{k4}</k4><p1>0.004</p1><p2>-0.007</p2>")
    capture = open_capture(tmp_path)
    assert lens_error(capture, programs.OFF_CENTRE, brown([-0.2, 0.11, -0.05, k4], 0.004, -0.007)) < pixels
    assert "1 camera is not aligned and not used" in capture.warnings
    assert capture.up is None and not capture.metric


def test_lens_as_photoscan_wrote_it(tmp_path: Path) -> None:
    c = programs.write_metashape(tmp_path)
    text, lens = (tmp_path / "cameras.xml").read_text(), programs.metashape_calibration(c)
    old = f"<fx>{c.fx}</fx><fy>{c.fy}</fy><cx>{c.cx}</cx><cy>{c.cy}</cy><skew>0</skew><k1>-0.2</k1><p1>0.004</p1><p2>-0.007</p2>"
    old = f'<calibration class="adjusted"><resolution width="80" height="60"/>{old}</calibration>'
    (tmp_path / "cameras.xml").write_text(text.replace(lens, old))
    assert lens_error(open_capture(tmp_path), c, brown([-0.2], -0.007, 0.004)) < 1e-6


def test_metashape_fisheye(tmp_path: Path) -> None:
    write_with(tmp_path, "<k1>-0.04</k1><k2>0.02</k2><k3>-0.01</k3><k4>0.003</k4>", "fisheye")
    assert lens_error(open_capture(tmp_path), programs.OFF_CENTRE, by_angle([-0.04, 0.02, -0.01, 0.003])) < 1e-6
    with pytest.raises(InputError, match="twice as wide as high"):
        write_with(tmp_path, "", "spherical")
        open_capture(tmp_path)
    with pytest.raises(InputError, match=r"type .rpc. is not supported"):
        write_with(tmp_path, "", "rpc")
        open_capture(tmp_path)


def test_panoramas_with_poses(tmp_path: Path) -> None:
    """The middle looks along the camera's axis, longitude goes to the right and latitude down."""
    programs.write_metashape(tmp_path / "a")
    programs.write_opensfm(tmp_path / "b")
    change_camera(tmp_path / "b", {"projection_type": "spherical", "width": 80, "height": 40})
    xml = tmp_path / "a/cameras.xml"
    xml.write_text(xml.read_text().replace('type="frame"', 'type="spherical"').replace('height="60"', 'height="40"'))
    for image in (*(tmp_path / "a/photos").iterdir(), *(tmp_path / "b/images").iterdir()):
        save_picture(image, render(eyes()[0], programs.CENTRED)[0][:40])
    for capture in (open_capture(tmp_path / "a"), open_capture(tmp_path / "b")):
        for frame, eye in zip(capture.frames, eyes(), strict=True):
            offset = surface_points() - eye.centre
            across, down, along = (offset @ axis for axis in (eye.right, eye.down, eye.forward))
            longitude, latitude = np.arctan2(across, along), np.arctan2(down, np.hypot(across, along))
            true = np.stack([40 + 80 * longitude / (2 * np.pi), 20 + 40 * latitude / np.pi], axis=1)
            np.testing.assert_allclose(project(frame.intrinsics, frame.world_from_camera, surface_points())[0], true, atol=1e-6)


def test_metashape_leaves_out_disabled_cameras_and_smaller_components(tmp_path: Path) -> None:
    programs.write_metashape(tmp_path)
    text = (tmp_path / "cameras.xml").read_text()
    text = text.replace('<camera id="4" sensor_id="0"', '<camera id="4" enabled="false" sensor_id="0"')
    text = text.replace('<camera id="3" sensor_id="0" component_id="0"', '<camera id="3" sensor_id="0" component_id="1"')
    (tmp_path / "cameras.xml").write_text(text)
    capture = open_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["IMG_00", "IMG_01", "IMG_02"]
    assert "1 camera is disabled" in said(capture) and "1 camera is in other components" in said(capture)
    (tmp_path / "cameras.xml").write_text(text.replace("<transform>0", "<other>0").replace("<transform>-0", "<other>-0"))
    with pytest.raises(InputError, match=r"well-formed|is aligned"):
        open_capture(tmp_path)


def test_metashape_with_a_georeference_is_level(tmp_path: Path) -> None:
    programs.write_metashape(tmp_path)
    place = np.array([50.82, -0.137, 25.0])
    north, east = np.radians(place[:2])
    up = np.array([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)])
    east_axis = np.array([-np.sin(east), np.cos(east), 0.0])
    axes = np.stack([east_axis, np.cross(up, east_axis), up], axis=1)  # geocentric from local
    world = f"<transform><rotation>{programs.words(axes @ programs.WORLD_TURN)}</rotation>"
    shift = programs.words(ecef(place) + axes @ programs.WORLD_SHIFT)
    world += f"<translation>{shift}</translation><scale>{programs.WORLD_SCALE}</scale></transform>"
    text = (tmp_path / "cameras.xml").read_text().replace(programs.METASHAPE_WORLD, world)
    (tmp_path / "cameras.xml").write_text(text.replace("LOCAL_CS[", "GEOGCS["))
    capture = open_capture(tmp_path)
    assert capture.metric and capture.up == (0, 0, 1)
    origin = capture.extra["reference_lla"]
    assert origin["latitude"] == pytest.approx(50.82, abs=1e-4) and origin["longitude"] == pytest.approx(-0.137, abs=1e-4)
    middle = np.mean([eye.centre for eye in eyes()], axis=0)
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        np.testing.assert_allclose(frame.world_from_camera[:3, 3], eye.centre - middle, atol=1e-3)
        np.testing.assert_allclose(frame.world_from_camera[:3, 2], eye.forward, atol=1e-5)  # the middle is metres away on a round earth


def test_metashape_labels_that_repeat_are_found_by_their_group(tmp_path: Path) -> None:
    programs.write_metashape(tmp_path)
    for folder, numbers in (("cam A", (0, 1)), ("cam B", (2, 3, 4))):
        (tmp_path / folder).mkdir()
        for at, number in enumerate(numbers):
            (tmp_path / f"photos/IMG_{number:02d}.png").rename(tmp_path / folder / f"IMG_{at:02d}.png")
    cameras = [programs.metashape_camera(number, f"IMG_{at:02d}", eyes()[number]) for number, at in enumerate((0, 1, 0, 1, 2))]
    grouped = "".join(f'<group label="{name}">{"".join(some)}</group>' for name, some in (("cam A", cameras[:2]), ("cam B", cameras[2:])))
    lens = programs.metashape_calibration(programs.OFF_CENTRE)
    (tmp_path / "cameras.xml").write_text(programs.metashape_xml(grouped, lens, programs.METASHAPE_WORLD))
    assert pixel_error(open_capture(tmp_path), eyes(), programs.OFF_CENTRE) < 1e-6


@pytest.mark.parametrize(
    "text",
    [
        '<!DOCTYPE a [<!ENTITY b "bbbbbbbbbb">]><document><chunk>&b;</chunk></document>',
        '<!DOCTYPE a SYSTEM "file:///etc/passwd"><document><chunk/></document>',
        "<document><chunk>" + "<a>" * 100 + "</a>" * 100 + "</chunk></document>",
        "<document><chunk>",
    ],
)
def test_hostile_xml_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(InputError, match=r"document type|nests them|well-formed"):
        read_xml(tmp_path / "cameras.xml")
    with pytest.raises(InputError):
        open_capture(tmp_path)


@pytest.mark.parametrize("name", ["a.psx", "a.rsproj", "a.mg", "sfm.abc"])
def test_projects_are_no_exports(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(InputError, match=r"is (a project|an Alembic)"):
        open_capture(tmp_path / name)


# ------------------------------------------------------------------------------------------------ RealityCapture


def test_realitycapture_lens_in_all_tables(tmp_path: Path) -> None:
    """The tangential factors are OpenCV's in reverse order, as the program's own OpenCV-compliant table shows."""
    c = programs.write_realitycapture(tmp_path)
    radial, t1, t2 = [-0.2, 0.11, -0.05, 0.0], 0.004, -0.007
    expected = brown(radial, t1, t2)
    table = tmp_path / "registration.csv"
    table.write_text(table.read_text().replace(",0,0,0,0,0,0\n", f",{','.join(map(str, (*radial, t1, t2)))}\n"))
    assert lens_error(open_capture(tmp_path), c, expected) < 1e-6
    newer = table.read_text().replace("heading", "yaw").replace(",f,px,py", ",f_35mm,px_norm,py_norm").replace("#cameras 5\n", "")
    table.write_text(newer)
    assert lens_error(open_capture(table), c, expected) < 1e-6
    names = [f"R{row}{column}" for row in range(3) for column in range(3)]
    lines = [",".join(["#name,tx,ty,tz", *names, "f_pix,px_pix,py_pix,k1,k2,t2,t1,k3,k4 (Brown lens in OpenCV ordering)"])]
    for index, eye in enumerate(eyes()):
        place = -eye.rotation() @ eye.centre
        values = [*place, *eye.rotation().ravel(), c.fx, c.cx, c.cy, *radial[:2], t2, t1, *radial[2:]]
        lines.append(",".join([f"IMG_{index:02d}.png", *map(repr, map(float, values))]))
    table.write_text("\n".join(lines))
    capture = open_capture(tmp_path)
    assert lens_error(capture, c, expected) < 1e-6
    assert capture.kind == "realitycapture" and capture.up == (0, 0, 1)


@pytest.mark.parametrize(
    ("model", "lens", "expected", "pixels"),
    [
        ("brown3t2", "-0.2 0.11 -0.05 0 0.004 -0.007", brown([-0.2, 0.11, -0.05], 0.004, -0.007), 1e-6),
        ("brown4", "-0.2 0.11 -0.05 0.08 0 0", brown([-0.2, 0.11, -0.05, 0.08], 0, 0), 0.02),
        ("division", "-0.15 0 0 0 0 0", division(-0.15), 0.02),
        ("perspective", "0 0 0 0 0 0", brown([], 0, 0), 1e-6),
    ],
)
def test_xmp_lenses(tmp_path: Path, model: str, lens: str, expected: Lens, pixels: float) -> None:
    camera = programs.write_xmp(tmp_path, model, lens)
    assert lens_error(open_capture(tmp_path), camera, expected) < pixels


def test_xmp_that_cannot_be_used_costs_its_image_or_says_why(tmp_path: Path) -> None:
    programs.write_xmp(tmp_path)
    (tmp_path / "IMG_04.xmp").unlink()
    capture = open_capture(tmp_path)
    assert len(capture.frames) == 4 and "1 image beside these have no pose" in said(capture)
    programs.write_xmp(tmp_path, "rationalP2D1", "1 0 0 0 0 0")
    with pytest.raises(InputError, match="lens model 'rationalP2D1' is not supported; choose Brown3"):
        open_capture(tmp_path)
    for file in tmp_path.glob("*.xmp"):
        file.write_text(file.read_text().replace("xcr:Position", "xcr:Other"))
    assert open_capture(tmp_path).kind == "photos", "calibration alone is no pose"


def test_realitycapture_table_in_degrees_or_without_columns_is_refused(tmp_path: Path) -> None:
    programs.write_realitycapture(tmp_path)
    table = tmp_path / "registration.csv"
    lines = table.read_text().splitlines()
    rows = [line.split(",") for line in lines[2:]]
    degrees = [",".join([row[0], str(float(row[1]) * 1e-5), str(50 + float(row[2]) * 1e-5), *row[3:]]) for row in rows]
    table.write_text("\n".join([*lines[:2], *degrees]))
    with pytest.raises(InputError, match="degrees of longitude and latitude"):
        open_capture(tmp_path)
    table.write_text("\n".join([lines[1].replace(",f,", ",g,"), *lines[2:]]))
    with pytest.raises(InputError, match="no column f; export"):
        open_capture(tmp_path)


# ------------------------------------------------------------------------------------------------ OpenSfM


def change_camera(root: Path, camera: dict[str, Any]) -> None:
    file = root / "opensfm/reconstruction.json"
    data = json.loads(file.read_text())
    for part in data:
        part["cameras"] = dict.fromkeys(part["cameras"], camera)
    file.write_text(json.dumps(data))


def test_opensfm_cameras(tmp_path: Path) -> None:
    c = programs.write_opensfm(tmp_path)
    change_camera(tmp_path, programs.opensfm_camera(c, k1=-0.2, k2=0.11, k3=-0.05, p1=0.004, p2=-0.007))
    capture = open_capture(tmp_path)
    assert lens_error(capture, c, brown([-0.2, 0.11, -0.05], -0.007, 0.004)) < 1e-6
    assert capture.metric and capture.up == (0, 0, 1)
    assert capture.extra["reference_lla"] == {"latitude": 50.8, "longitude": -0.14, "altitude": 12.0}
    np.testing.assert_allclose(capture.points, programs.POINTS)
    assert "of 2 reconstructions the largest is used, with 5 of 6 images" in capture.warnings
    plain = {"projection_type": "perspective", "width": 160, "height": 120, "focal": 0.9, "k1": -0.2, "k2": 0.1}
    change_camera(tmp_path, plain)
    centred = Pinhole(80, 60, 72.0, 72.0, 40.0, 30.0)
    capture = open_capture(tmp_path / "opensfm/reconstruction.json")
    assert lens_error(capture, centred, brown([-0.2, 0.1], 0, 0)) < 1e-6
    assert "5 images of another size than in reconstruction.json; intrinsics were scaled to fit" in capture.warnings
    change_camera(tmp_path, {**plain, "projection_type": "fisheye"})
    assert lens_error(open_capture(tmp_path), centred, by_angle([-0.2, 0.1])) < 1e-6
    for kind, why in (("equirectangular", "twice as wide as high"), ("fisheye624", "not supported")):
        change_camera(tmp_path, {**plain, "projection_type": kind})
        with pytest.raises(InputError, match=why):
            open_capture(tmp_path)


def test_opensfm_of_itself_without_gps(tmp_path: Path) -> None:
    c = programs.write_opensfm(tmp_path)
    file = tmp_path / "opensfm/reconstruction.json"
    data = json.loads(file.read_text())
    data[1]["reference_lla"] = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    (tmp_path / "cameras.json").write_text(json.dumps(data[1].pop("cameras")))
    (tmp_path / "reconstruction.json").write_text(json.dumps(data))
    file.unlink()
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), c) < 1e-6
    assert not capture.metric and "reference_lla" not in capture.extra


# ------------------------------------------------------------------------------------------------ Meshroom, Bundler


def meshroom_focals(scene: dict[str, Any], version: tuple[int, int, int]) -> None:
    """The lens as that version of the format has it."""
    c, lens = programs.OFF_CENTRE, scene["intrinsics"][0]
    if version < (1, 2, 2):
        del lens["focalLength"], lens["pixelRatio"]
        lens["pxFocalLength"] = [str(c.fx), str(c.fy)] if version >= (1, 2, 0) else str(c.fx)
    elif version < (1, 2, 5):
        lens["pixelRatio"] = str(c.fx / c.fy)
    elif version >= (1, 2, 11):
        lens["focalLength"], lens["pixelRatio"] = str(c.fy / 80 * 8), str(c.fy / c.fx)
    if version < (1, 2, 1):
        lens["principalPoint"] = [str(c.cx), str(c.cy)]
    if version >= (1, 2, 8):
        lens |= {"type": "pinhole", "distortionType": "radialk3", "undistortionType": "none"}


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 3), (1, 2, 7), (1, 2, 8), (1, 2, 11)])
def test_meshroom_in_all_versions(tmp_path: Path, version: tuple[int, int, int]) -> None:
    c = programs.OFF_CENTRE
    scene = programs.meshroom_scene(c, programs.pictures(tmp_path, c), version)
    meshroom_focals(scene, version)
    (tmp_path / "sfm.sfm").write_text(json.dumps(scene))
    capture = open_capture(tmp_path)
    assert pixel_error(capture, eyes(), replace(c, fy=c.fx) if version < (1, 2, 0) else c) < 1e-6
    np.testing.assert_allclose(capture.points, programs.POINTS)


@pytest.mark.parametrize(
    ("kind", "factors", "expected", "pixels"),
    [
        ("radial3", [-0.2, 0.11, -0.05], brown([-0.2, 0.11, -0.05], 0, 0), 1e-6),
        ("brown", [-0.2, 0.11, -0.05, 0.004, -0.007], brown([-0.2, 0.11, -0.05], -0.007, 0.004), 1e-6),
        ("fisheye4", [-0.04, 0.02, -0.01, 0.003], by_angle([-0.04, 0.02, -0.01, 0.003]), 1e-6),
        ("fisheye1", [0.9], field_of_view(0.9), 0.02),
    ],
)
def test_meshroom_lenses(tmp_path: Path, kind: str, factors: list[float], expected: Lens, pixels: float) -> None:
    c = programs.write_meshroom(tmp_path)
    file = next(tmp_path.rglob("cameras.sfm"))
    scene = json.loads(file.read_text())
    scene["intrinsics"][0] |= {"type": kind, "distortionParams": [str(factor) for factor in factors]}
    file.write_text(json.dumps(scene))
    capture = open_capture(tmp_path)
    assert lens_error(capture, c, expected) < pixels
    assert "1 view of cameras.sfm without a pose is not used" in capture.warnings
    scene["intrinsics"][0] |= {"type": "3deanamorphic4", "distortionParams": ["1"]}
    file.write_text(json.dumps(scene))
    with pytest.raises(InputError, match=r"lens '3deanamorphic4' .*is not supported"):
        open_capture(tmp_path)


def test_an_alembic_file_alone_is_refused_with_advice(tmp_path: Path) -> None:
    (tmp_path / "sfm.abc").write_bytes(b"Ogawa")
    with pytest.raises(InputError, match="ConvertSfMFormat"):
        open_capture(tmp_path)
    programs.pictures(tmp_path, programs.CENTRED)
    assert "1 file with poses (sfm.abc)" in said(open_capture(tmp_path))


def test_bundler_lens_and_lists(tmp_path: Path) -> None:
    c = programs.write_bundler(tmp_path)
    bundle = tmp_path / "bundle.out"
    bundle.write_text(bundle.read_text().replace(f"{c.fx} 0 0\n", f"{c.fx} -0.2 0.11\n"))
    capture = open_capture(tmp_path)
    assert lens_error(capture, c, brown([-0.2, 0.11], 0, 0)) < 1e-6
    np.testing.assert_allclose(capture.points, programs.POINTS)
    assert "1 of 6 images were not registered by Bundler" in capture.warnings
    (tmp_path / "list.txt").write_text("images/IMG_00.png\n")
    with pytest.raises(InputError, match=r"has 6 cameras and its list 1 image"):
        open_capture(tmp_path)
    (tmp_path / "list.txt").unlink()
    with pytest.raises(InputError, match=r"add list\.txt"):
        open_capture(tmp_path)


# ------------------------------------------------------------------------------------------------ data sets


def test_scannetpp_has_masks_and_the_published_split(tmp_path: Path) -> None:
    c = programs.write_scannetpp(tmp_path)
    capture = open_capture(tmp_path / "dslr")
    assert pixel_error(capture, eyes(), c) < 1e-6
    assert [frame.split for frame in capture.frames] == ["train"] * 3 + ["test"] * 2
    assert capture.metric and all(load_mask(frame) is not None for frame in capture.frames)
    (tmp_path / "dslr/resized_undistorted_images").rename(tmp_path / "dslr/resized_images")
    json_path = tmp_path / "dslr/nerfstudio/transforms_undistorted.json"
    data = {**json.loads(json_path.read_text()), "camera_model": "OPENCV_FISHEYE", "k1": -0.04, "k2": 0.02}
    json_path.unlink()
    (tmp_path / "dslr/nerfstudio/transforms.json").write_text(json.dumps(data))
    assert lens_error(open_capture(tmp_path), c, by_angle([-0.04, 0.02])) < 1e-6


def test_arkitscenes_have_depth_and_confidence(tmp_path: Path) -> None:
    c = programs.write_arkitscenes(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.metric and capture.ordered and capture.up == (0, 0, 1)
    for frame, eye in zip(capture.frames, eyes(), strict=True):
        np.testing.assert_allclose(load_depth(frame, capture), render(eye, c)[1], atol=1e-3)
        assert frame.confidence is not None
    next((tmp_path / "lowres_wide_intrinsics").iterdir()).unlink()
    capture = open_capture(tmp_path)
    assert len(capture.frames) == 4 and "1 of 5 images have no pose or camera of their time" in said(capture)


# ------------------------------------------------------------------------------------------------ several in one folder


def test_of_several_the_first_is_used_and_the_others_are_named(tmp_path: Path) -> None:
    programs.write_metashape(tmp_path)
    programs.write_opensfm(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.kind == "metashape"
    assert "the folder also holds poses of opensfm (5 images); those of metashape are used" in capture.warnings


def test_what_has_poses_for_many_more_images_goes_first(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    data = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps({**data, "frames": data["frames"][:3]}))
    write_colmap_bin(tmp_path)
    capture = open_capture(tmp_path)
    assert (capture.kind, len(capture.frames)) == ("colmap", 5)
    assert "the folder also holds poses of transforms (3 images); those of colmap are used" in capture.warnings
    (tmp_path / "transforms.json").write_text(json.dumps({**data, "frames": data["frames"][:4]}))
    assert open_capture(tmp_path).kind == "transforms"


def test_one_that_is_broken_does_not_stop_another(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    programs.write_bundler(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    capture = open_capture(tmp_path)
    assert capture.kind == "bundler"
    assert "the poses of transforms in the folder cannot be used" in said(capture)
