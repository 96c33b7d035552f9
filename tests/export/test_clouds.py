"""LAS, LAZ and E57 read back by laspy and pye57: places to the format's precision, colours, normals, reference system."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.clouds import las_steps, write_cloud
from fieldfuse.georeference import Georeference
from fieldfuse.pipelines.surfaces import put_cloud
from fieldfuse.tsdf.volume import Points

laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
pye57 = pytest.importorskip("pye57", reason="the extra `e57` is not installed")
RNG = np.random.default_rng(0)
COLOURS = RNG.integers(0, 256, (700, 3)).astype(np.uint8)
NORMALS = RNG.normal(size=(700, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)


@pytest.mark.parametrize("size", [1e-4, 3.0, 2e4])
@pytest.mark.parametrize("origin", [np.zeros(3), np.array([691_000.25, 5_335_000.5, 520.125])])
@pytest.mark.parametrize("kind", ["las", "laz"])
def test_las(tmp_path: Path, size: float, origin: Array, kind: str) -> None:
    points = size * RNG.uniform(-1, 1, (700, 3)) + origin
    write_cloud(tmp_path / f"a.{kind}", points, COLOURS, NORMALS, "EPSG:32632")
    read = laspy.read(tmp_path / f"a.{kind}")
    scale, _ = las_steps(points)
    assert np.array_equal(read.header.scales, np.full(3, scale))
    assert scale <= max(2e-6 * size, 1e-9 * (1 + np.abs(origin).max()))
    assert np.abs(read.xyz - points).max() <= 0.5 * scale + 4e-16 * np.abs(points).max()
    assert np.array_equal(np.stack([read.red, read.green, read.blue], axis=1), COLOURS.astype(np.uint16) * 257)
    assert np.abs(np.stack([read.NormalX, read.NormalY, read.NormalZ], axis=1) - NORMALS).max() < 1e-7
    assert read.header.parse_crs().to_epsg() == 32632 and read.header.point_format.id == 7
    assert np.abs(read.header.mins - points.min(axis=0)).max() <= scale and (np.asarray(read.return_number) == 1).all()


@pytest.mark.parametrize("with_normals", [True, False])
def test_e57_is_exact(tmp_path: Path, with_normals: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.export.clouds.ROWS_AT_ONCE", 256)
    points = RNG.normal(size=(700, 3)) + np.array([691_000.0, 5_335_000.0, 520.0])
    for name in ("a.e57", "b.e57"):
        write_cloud(tmp_path / name, points, COLOURS, NORMALS if with_normals else None, 32632 if with_normals else None)
    assert (tmp_path / "a.e57").read_bytes() == (tmp_path / "b.e57").read_bytes()
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        header = file.get_header(0)
        read = file.read_scan_raw(0, ignore_unsupported_fields=True)
        assert "32N" in file.root["coordinateMetadata"].value() or not with_normals
        found = [name for name in header.point_fields if name.startswith("nor:")]
        assert (found == [f"nor:normal{axis}" for axis in "XYZ"]) is with_normals
        if with_normals:
            values = np.empty((3, 700), np.float32)
            buffers = pye57.libe57.VectorSourceDestBuffer()
            for name, row in zip(found, values, strict=True):
                buffers.append(pye57.libe57.SourceDestBuffer(file.image_file, name, row, 700, True, True))
            header.points.reader(buffers).read()
            assert np.abs(values.T - NORMALS).max() < 1e-7
        assert header.xMinimum == points[:, 0].min() and header.zMaximum == points[:, 2].max()
    assert np.array_equal(np.stack([read[f"cartesian{axis}"] for axis in "XYZ"], axis=1), points)
    assert np.array_equal(np.stack([read[f"color{hue}"] for hue in ("Red", "Green", "Blue")], axis=1), COLOURS)


def test_a_place_on_earth_becomes_utm_coordinates(tmp_path: Path) -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    place = Georeference(48.137, 11.575, 520.0, Similarity(2.0, turn, np.array([5.0, 6.0, 7.0])))
    points = Points(RNG.normal(size=(700, 3)) * 20, COLOURS, NORMALS)
    assert put_cloud(tmp_path / "a.laz", points, place) is None
    read = laspy.read(tmp_path / "a.laz")
    assert np.abs(read.xyz - place.to_utm(points.points)).max() < 1e-4 and read.header.parse_crs().to_epsg() == 32632
    ahead = place.to_utm(points.points + 1e-2 * NORMALS) - place.to_utm(points.points)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    assert np.abs(np.stack([read.NormalX, read.NormalY, read.NormalZ], axis=1) - ahead).max() < 2e-3
    note = put_cloud(tmp_path / "pole.e57", points, Georeference(89.0, 0.0, 0.0))
    assert note is not None and "no UTM" in note and (tmp_path / "pole.e57").is_file()


def test_what_cannot_be_written_is_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"\.las, \.laz or \.e57, not \.xyz"):
        write_cloud(tmp_path / "a.xyz", NORMALS, COLOURS)
    with pytest.raises(InputError, match="here are 0"):
        write_cloud(tmp_path / "a.las", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    with pytest.raises(InputError, match="finite"):
        write_cloud(tmp_path / "a.las", np.where(NORMALS > 0.9, np.nan, NORMALS), COLOURS)
    with pytest.raises(InputError, match="a colour"):
        write_cloud(tmp_path / "a.e57", NORMALS, COLOURS[:5])
    with pytest.raises(InputError, match="no coordinate reference system"):
        write_cloud(tmp_path / "a.e57", NORMALS, COLOURS, crs="nowhere")
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(InputError, match=r'the format laz needs the package l.* .pip install "fieldfuse\[las\]"'):
        write_cloud(tmp_path / "a.laz", NORMALS, COLOURS)
    assert not list(tmp_path.iterdir())
