"""GPS in EXIF: as Pillow writes it, of drones, and broken."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from fieldfuse.capture.gps import gps_of, gps_of_images
from fieldfuse.simulate.survey import with_gps

GPS = 0x8825


def photo(path: Path, tags: dict[int, Any], xmp: bytes | None = None) -> Path:
    """A small JPEG, with EXIF by Pillow."""
    exif = Image.Exif()
    exif.get_ifd(GPS).update(tags)
    Image.new("RGB", (32, 24)).save(path, exif=exif, **({} if xmp is None else {"xmp": xmp}))
    return path


def tags(latitude: tuple[Any, ...] = (46, 50, 33.3855), longitude: tuple[Any, ...] = (91, 59, 40.4156)) -> dict[int, Any]:
    north, west = tuple(map(IFDRational, latitude)), tuple(map(IFDRational, longitude))
    return {1: "N", 2: north, 3: "W", 4: west, 5: b"\x00", 6: IFDRational(198.3)}


def test_degrees_minutes_seconds(tmp_path: Path) -> None:
    found = gps_of(photo(tmp_path / "a.jpg", tags()))
    assert found is not None and np.allclose(found[0], [46 + 50 / 60 + 33.3855 / 3600, -(91 + 59 / 60 + 40.4156 / 3600), 198.3], atol=1e-6)
    south = {**tags(), 1: "S", 3: "E", 5: b"\x01"}
    found = gps_of(photo(tmp_path / "b.jpg", south))
    assert found is not None and found[0][0] < 0 < found[0][1] and found[0][2] == pytest.approx(-198.3)


@pytest.mark.parametrize("form", ['drone-dji:RelativeAltitude="{}"', "<drone-dji:RelativeAltitude>{}</drone-dji:RelativeAltitude>"])
def test_heights_of_drones_replace_differences_of_altitude(tmp_path: Path, form: str) -> None:
    paths = [photo(tmp_path / f"{at}.jpg", tags(), f"<x:xmpmeta>{form.format(f'+{20 + at}.50')}".encode()) for at in range(3)]
    paths.append(photo(tmp_path / "none.jpg", {}))
    places = gps_of_images(paths)
    assert np.allclose(places[:3, 2], [197.3, 198.3, 199.3]) and np.isnan(places[3]).all()


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_what_simulated_captures_have(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.new("RGB", (32, 24)).save(path)
    path.write_bytes(with_gps(path.read_bytes(), np.array([-33.8567891, 151.2152345, -4.321])))
    found = gps_of(path)
    assert found is not None and np.allclose(found[0], [-33.8567891, 151.2152345, -4.321], atol=1e-9)
    assert Image.open(path).size == (32, 24)


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {2: (IFDRational(0), IFDRational(0), IFDRational(0)), 4: (IFDRational(0), IFDRational(0), IFDRational(0))},
        tags((91, 0, 0)),
        tags((1, 0, 0), (181, 0, 0)),
        {**tags(), 2: (IFDRational(1, 0), IFDRational(0), IFDRational(0))},
    ],
)
def test_what_is_no_place(tmp_path: Path, wrong: dict[int, Any]) -> None:
    assert gps_of(photo(tmp_path / "a.jpg", wrong)) is None


def test_an_altitude_that_cannot_be_is_missing(tmp_path: Path) -> None:
    found = gps_of(photo(tmp_path / "a.jpg", {**tags(), 6: IFDRational(1e9)}))
    assert found is not None and np.isnan(found[0][2])


def test_damaged_files_have_none(tmp_path: Path) -> None:
    """Every byte of the EXIF part changed, and the file cut: no error, and nothing but a place or none."""
    data = photo(tmp_path / "a.jpg", tags()).read_bytes()
    length = struct.unpack(">H", data[4:6])[0] + 4 if data[2:4] == b"\xff\xe1" else 300
    rng, path = np.random.default_rng(0), tmp_path / "b.jpg"
    for at in range(2, min(length, len(data)), 2):
        changed = bytearray(data)
        changed[at] = int(rng.integers(256))
        path.write_bytes(bytes(changed))
        found = gps_of(path)
        assert found is None or (np.abs(found[0][:2]) <= [90, 180]).all()
    for cut in (0, 1, 20, 60, 120):
        path.write_bytes(data[:cut])
        gps_of(path)
    assert gps_of(tmp_path / "absent.jpg") is None


def test_photos_of_phones(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    exif = Image.Exif()
    exif.get_ifd(GPS).update(tags())
    heif.from_pillow(Image.new("RGB", (64, 48))).save(tmp_path / "a.heic", exif=exif.tobytes())
    found = gps_of(tmp_path / "a.heic")
    assert found is not None and found[0][2] == pytest.approx(198.3)
