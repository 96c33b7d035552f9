"""What makes the scale of a simulated capture measurable: ArUco markers in the scene, and GPS in its images."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from pydantic import Field

from fieldfuse.camera import Array
from fieldfuse.config import read_by
from fieldfuse.errors import InputError
from fieldfuse.georeference import Georeference
from fieldfuse.measures import parse_marker
from fieldfuse.simulate.materials import Material, Materials
from fieldfuse.simulate.scene import Scene
from fieldfuse.simulate.solids import BOX, Solid, Solids

THICK = 0.002  # metres: of the plate that a marker is printed on
PAPER = (0.7, 0.7, 0.7)  # of light that it reflects: white, and not blown out under the lamps
TEXELS = 512  # about so many on a plate's side
GPS_FOLDER = 0x8825
FINE = 10**6  # seconds of arc are written in such parts: 0.03 mm


@dataclass
class MarkerSettings:
    at: Annotated[list[float], Field(min_length=3, max_length=3)]  # metres from what the scene is looked at for: middle of the plate
    side: Annotated[float, Field(gt=0, le=10)] = 0.1  # metres, black border included; a white rim is added
    number: Annotated[int, Field(ge=0, lt=1000)] = 0
    dictionary: Annotated[str, read_by(lambda name: parse_marker(f"{name}:1"))] = "DICT_4X4_50"
    facing: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None  # None: up
    turn: Annotated[float, Field(ge=-360, le=360)] = 0.0  # degrees about that


@dataclass
class GpsSettings:
    latitude: Annotated[float, Field(ge=-89, le=89)] = 47.0  # degrees, of the scene's origin; x is east, y north
    longitude: Annotated[float, Field(ge=-180, le=180)] = 8.0
    altitude: Annotated[float, Field(ge=-1000, le=9000)] = 400.0  # metres
    noise: Annotated[float, Field(ge=0, le=1000)] = 0.02  # metres: standard deviation to the east and to the north
    noise_up: Annotated[float, Field(ge=0, le=1000)] = 0.03


def with_markers(scene: Scene, markers: list[MarkerSettings]) -> Scene:
    """The scene with plates that have markers on them.

    Raises:
        InputError: a dictionary has no such marker.
    """
    textures, materials, solids = list[Array](), list(scene.materials.items), list(scene.solids.items)
    for marker in markers:
        image, share = marker_image(marker)
        width = marker.side / share
        white = len(materials)
        materials += [Material(tint=PAPER), Material(scene.bank.count + len(textures), width, (0.5, 0.5), PAPER)]
        textures.append(image)
        half = np.array([width / 2, width / 2, THICK / 2])
        axes = _axes(np.array([0.0, 0.0, 1.0] if marker.facing is None else marker.facing), marker.turn)
        place = np.asarray(scene.focus, dtype=np.float64) + marker.at
        solids.append(Solid(BOX, place, half, axes, (white, white, white, white, white + 1, white)))
    return replace(
        scene,
        solids=Solids(solids, scene.device),
        materials=Materials(materials, scene.device),
        bank=scene.bank.with_pictures(textures),
    )


def marker_image(marker: MarkerSettings) -> tuple[Array, float]:
    """(S, S, 3) sRGB float32 of a marker with a white rim, and the marker's share of the side.

    Raises:
        InputError: its dictionary has no such marker.
    """
    name = parse_marker(f"{marker.dictionary}:1").dictionary
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    if marker.number >= len(dictionary.bytesList):
        raise InputError(f"{name} has {len(dictionary.bytesList)} markers, none with the number {marker.number}; choose a smaller number")
    inner = dictionary.markerSize + 2  # with its black border, in modules
    module = TEXELS // (inner + 2)
    bits = np.pad(cv2.aruco.generateImageMarker(dictionary, marker.number, inner * module), module, constant_values=255)
    return np.repeat(bits[..., None].astype(np.float32) / 255, 3, axis=2), inner / (inner + 2)


def _axes(normal: Array, degrees: float) -> Array:
    """(3, 3) columns: a plate's right, up and outward directions."""
    length = float(np.linalg.norm(normal))
    if not length > 0:
        raise InputError("a marker's `facing` has no length; give a direction, as [0, 0, 1]")
    z = normal / length
    x = np.array([1.0, 0, 0]) if abs(z[2]) > 0.99 else np.cross([0.0, 0, 1], z)
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    angle = np.deg2rad(degrees)
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, z], axis=1)


class Receiver:
    """GPS at the cameras' places, with noise: the same for the same seed."""

    def __init__(self, settings: GpsSettings, seed: int) -> None:
        self.settings, self.seed = settings, seed
        self.here = Georeference(settings.latitude, settings.longitude, settings.altitude)

    def place(self, centre: Array, index: int) -> Array:
        """(3,) degrees north, degrees east and metres of a camera's centre (3,)."""
        noise = np.random.default_rng([self.seed, 2, index]).normal(0, 1, 3)
        return self.here.to_geographic(centre + noise * [self.settings.noise, self.settings.noise, self.settings.noise_up])

    def tagged(self, data: bytes, centre: Array, index: int) -> bytes:
        """A PNG or JPEG file with the place in its EXIF."""
        return with_gps(data, self.place(centre, index))


def with_gps(data: bytes, place: Array) -> bytes:
    """A PNG or JPEG file with degrees north, degrees east and metres in its EXIF (which it has none of before)."""
    exif = Image.Exif()
    latitude, longitude, altitude = (float(value) for value in place)
    exif.get_ifd(GPS_FOLDER).update(
        {
            1: "N" if latitude >= 0 else "S",
            2: _parts(latitude),
            3: "E" if longitude >= 0 else "W",
            4: _parts(longitude),
            5: b"\x00" if altitude >= 0 else b"\x01",
            6: IFDRational(round(abs(altitude) * 1000), 1000),
        }
    )
    body = exif.tobytes()
    body = body if body.startswith(b"Exif\x00\x00") else b"Exif\x00\x00" + body
    if data[:2] == b"\xff\xd8":
        return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
    chunk = b"eXIf" + body[6:]
    end = 33  # of the signature and the header chunk
    return data[:end] + struct.pack(">I", len(body) - 6) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[end:]


def _parts(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    seconds = round(abs(degrees) * 3600 * FINE)
    return IFDRational(seconds // (3600 * FINE)), IFDRational(seconds // (60 * FINE) % 60), IFDRational(seconds % (60 * FINE), FINE)
