"""Which images are taken for 360° panoramas: by their metadata, by what they show, and as the user says."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from fieldfuse.camera import EQUIRECTANGULAR, Array, Intrinsics, opengl_from_world
from fieldfuse.capture import Capture, open_capture
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.panorama import shows_sphere, twice_as_wide, video_tag
from fieldfuse.capture.sphere import to_cut
from fieldfuse.capture.types import CUT
from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.steps import needs_frames, write_frames
from tests.capture.spheres import room, walk

CAMERA = Intrinsics.equirectangular(256, 128)
GPANO = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    b'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="%d" '
    b'GPano:CroppedAreaImageWidthPixels="%d"/></rdf:RDF></x:xmpmeta>'
)


def panoramas(count: int = 4, width: int = 256) -> list[Array]:
    return [room(Intrinsics.equirectangular(width, width // 2), pose, soft=3)[0] for pose in walk(count)]


def photos(folder: Path, images: list[Array], xmp: bytes = b"") -> Path:
    folder.mkdir()
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{number}.jpg", quality=90, **({"xmp": xmp} if xmp else {}))
    return folder


def lenses(capture: Capture) -> set[str | None]:
    return {None if frame.intrinsics is None else frame.intrinsics.lens for frame in capture.frames}


def warned(capture: Capture, text: str) -> bool:
    return any(text in warning for warning in capture.warnings)


def test_panoramas_are_recognised_by_what_they_show(tmp_path: Path) -> None:
    capture = open_capture(photos(tmp_path / "p", panoramas()))
    assert lenses(capture) == {EQUIRECTANGULAR} and not capture.posed
    assert warned(capture, "4 images are taken for 360° panoramas by what they show; --set capture.projection=perspective")
    assert capture.extra[CUT] == "each of 4 360° images is cut into 7 views; 84% of what it shows is kept"
    assert lenses(open_capture(tmp_path / "p", projection="perspective")) == {None}


def test_photos_that_were_cropped_to_their_shape_are_not(tmp_path: Path) -> None:
    plain = Intrinsics(256, 128, 170.0, 170.0, 128.0, 64.0)
    capture = open_capture(photos(tmp_path / "p", [room(plain, pose)[0] for pose in walk(4)]))
    assert lenses(capture) == {None} and CUT not in capture.extra
    assert warned(capture, "4 images are twice as wide as high and no panorama: the edges do not continue each other")
    assert lenses(open_capture(tmp_path / "p", projection="equirectangular")) == {EQUIRECTANGULAR}


def test_metadata_decides_without_a_look_at_the_pixels(tmp_path: Path) -> None:
    plain = Intrinsics(256, 128, 170.0, 170.0, 128.0, 64.0)
    images = [room(plain, pose)[0] for pose in walk(4)]
    assert lenses(open_capture(photos(tmp_path / "whole", images, GPANO % (8192, 8192)))) == {EQUIRECTANGULAR}
    with pytest.raises(InputError, match=r"part of a 360° panorama, by its XMP; only whole ones .* export it whole"):
        open_capture(photos(tmp_path / "part", images, GPANO % (8192, 4096)))


def test_what_cannot_be_a_panorama_is_refused_as_one(tmp_path: Path) -> None:
    plain = [room(Intrinsics(80, 60, 60.0, 60.0, 40.0, 30.0), pose)[0] for pose in walk(3)]
    with pytest.raises(InputError, match=r"is 80×60, and a 360° panorama is twice as wide as high; leave --set capture.projection at auto"):
        open_capture(photos(tmp_path / "p", plain), projection="equirectangular")


def test_what_shows_a_sphere() -> None:
    image = panoramas(1, 1024)[0]
    assert shows_sphere(image)
    assert shows_sphere(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])[1], cv2.IMREAD_COLOR))
    assert not shows_sphere(image[:, 30:])  # a part of it: the edges are apart
    assert not shows_sphere(image[64:-64])  # without its poles
    assert not shows_sphere(np.full((64, 128, 3), 200, np.uint8))
    cut_out = np.full((256, 512, 3), 255, np.uint8)
    cut_out[60:200, 150:400] = image[60:200, 150:400]
    assert not shows_sphere(cut_out)  # before white: the edges agree, and show nothing
    assert twice_as_wide((3840, 1920)) and twice_as_wide((640, 322)) and not twice_as_wide((1920, 1080)) and not twice_as_wide((0, 0))


def test_a_360_degree_video_becomes_views(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 5.0, (512, 256))
    for pose in walk(10, step=0.3):
        writer.write(cv2.cvtColor(room(Intrinsics.equirectangular(512, 256), pose, soft=2)[0], cv2.COLOR_RGB2BGR))
    writer.release()
    capture = open_capture(path)
    assert lenses(capture) == {EQUIRECTANGULAR} and warned(capture, "the video is taken for a 360° panorama by what it shows")
    assert needs_frames(capture) and not video_tag(path)
    settings = Settings(threads=2)
    cut = write_frames(capture, tmp_path / "run", settings)
    instants = {frame.instant for frame in cut.frames}
    assert len(cut.frames) == 7 * len(instants) and 6 <= len(instants) <= 10 and cut.ordered
    assert [frame.name for frame in cut.frames[:2]] == [f"{cut.frames[0].instant}_view0", f"{cut.frames[0].instant}_view1"]
    with path.open("ab") as file:
        file.write(b"\0\0\0\x30free<GSpherical:ProjectionType>equirectangular</GSpherical:Pro>")
    assert video_tag(path)


def test_posed_panoramas_are_read_with_the_middle_along_the_camera(tmp_path: Path) -> None:
    poses = walk(5)
    frames = []
    for number, (image, pose) in enumerate(zip(panoramas(5), poses, strict=True)):
        Image.fromarray(image).save(tmp_path / f"{number}.png")
        frames.append({"file_path": f"{number}.png", "transform_matrix": opengl_from_world(pose).tolist()})
    data = {"camera_model": "EQUIRECTANGULAR", "w": 512, "h": 256, "fl_x": 256, "fl_y": 256, "cx": 256, "cy": 128, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    capture = check_capture(open_capture(tmp_path))
    assert lenses(capture) == {EQUIRECTANGULAR} and capture.posed and len(to_cut(capture)) == 5
    assert capture.frames[0].intrinsics == CAMERA
    cut = write_frames(capture, tmp_path / "run", Settings(threads=1))
    assert cut.posed and len(cut.frames) == 35
    np.testing.assert_allclose(cut.frames[7].world_from_camera, poses[1], atol=1e-12)  # the first view looks along the camera
    with pytest.raises(InputError, match="comes with cameras of 360° panoramas; leave"):
        open_capture(tmp_path, projection="perspective")
    (tmp_path / "transforms.json").write_text(json.dumps({**data, "h": 300}))
    with pytest.raises(InputError, match="a 360° panorama is twice as wide as high, this one is 512×300"):
        open_capture(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps({**data, "camera_model": "VR180_L"}))
    with pytest.raises(InputError, match="half of a stereo pair"):
        open_capture(tmp_path)
