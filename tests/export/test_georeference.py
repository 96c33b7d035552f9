"""The file beside exports that says where on earth they lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse.export.georeference import write_georeference
from fieldfuse.files import read_json
from fieldfuse.georeference import Georeference


def test_the_sidecar_brings_exports_to_utm(tmp_path: Path) -> None:
    pyproj = pytest.importorskip("pyproj")
    place = Georeference(46.8426, -91.9945, 198.5, error=0.4)
    written = write_georeference(tmp_path, place)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert sorted(path.name for path in written) == names == ["georeference.json", "georeference.prj"]
    data = read_json(tmp_path / "georeference.json")
    assert data["epsg"] == 32615 and data["origin"]["latitude"] == 46.8426 and data["error"] == 0.4
    point = np.array([30.0, -40.0, 5.0])
    utm = (np.array(data["utm_from_exports"]) @ [*point, 1])[:3]
    east, north = pyproj.Proj(32615)(*place.to_geographic(point)[[1, 0]])
    assert np.allclose(utm, [east, north, 203.5], atol=2e-3)
    assert pyproj.CRS.from_wkt((tmp_path / "georeference.prj").read_text()).to_epsg() == 32615


def test_without_utm_the_origin_is_there_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "georeference.prj").write_text("of an earlier place")
    assert [path.name for path in write_georeference(tmp_path, Georeference(85.0, 0.0, 0.0))] == ["georeference.json"]
    data = read_json(tmp_path / "georeference.json")
    assert data["epsg"] is None and data["utm_from_exports"] is None and data["origin"]["latitude"] == 85.0
    assert not (tmp_path / "georeference.prj").exists()
