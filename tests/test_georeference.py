"""Places on earth against pyproj, an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError
from fieldfuse.georeference import Georeference, ecef, geographic

pyproj = pytest.importorskip("pyproj")
PLACES = np.array([[46.8426, -91.9945, 198.5], [-33.857, 151.215, 20.0], [0.0, 0.0, 0.0], [78.2, 15.6, 500.0], [-54.8, -68.3, 3000.0]])


def test_geocentric_coordinates_are_those_of_pyproj() -> None:
    x, y, z = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(PLACES[:, 1], PLACES[:, 0], PLACES[:, 2])
    assert np.abs(ecef(PLACES) - np.stack([x, y, z], axis=1)).max() < 1e-6
    assert (np.abs(geographic(ecef(PLACES)) - PLACES).max(axis=0) < [1e-11, 1e-11, 1e-8]).all()


@pytest.mark.parametrize("place", PLACES)
def test_local_axes_are_those_of_pyproj(place: np.ndarray) -> None:
    here = Georeference(*place)
    near = place + np.random.default_rng(0).uniform(-1, 1, (20, 3)) * [1e-3, 1e-3, 50]
    chain = f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lon_0={place[1]} +lat_0={place[0]}"
    theirs = pyproj.Transformer.from_pipeline(f"{chain} +h_0={place[2]}").transform(near[:, 1], near[:, 0], near[:, 2])
    assert np.abs(here.enu_of(near) - np.stack(theirs, axis=1)).max() < 1e-6
    assert (np.abs(here.to_geographic(here.enu_of(near)) - near).max(axis=0) < [1e-11, 1e-11, 1e-8]).all()


def test_utm_of_a_turned_and_scaled_frame() -> None:
    turn = Similarity(0.5, Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([3.0, -4.0, 5.0]))
    here = Georeference(*PLACES[0], enu_from_input=turn)
    assert here.epsg == 32615
    points = np.random.default_rng(1).uniform(-200, 200, (50, 3))
    places = here.to_geographic(points)
    east, north = pyproj.Proj(32615)(places[:, 1], places[:, 0])
    assert np.abs(here.to_utm(points) - np.stack([east, north, places[:, 2]], axis=1)).max() < 1e-6
    linear = here.utm_from_input()
    assert np.abs(points @ linear[:3, :3].T + linear[:3, 3] - here.to_utm(points)).max() < 2e-3
    assert Georeference.from_dict(here.to_dict()).to_dict() == here.to_dict()
    assert "UTM" in here.wkt() and here.wkt(esri=True).startswith("PROJCS[")


@pytest.mark.parametrize(("longitude", "zone"), [(-180, 1), (180, 1), (179.9, 60), (0, 31), (-0.1, 30)])
def test_zones(longitude: float, zone: int) -> None:
    assert Georeference(10, longitude, 0).epsg == 32600 + zone
    assert Georeference(-10, longitude, 0).epsg == 32700 + zone


def test_no_place_on_earth_and_no_utm() -> None:
    for wrong in ((91, 0, 0), (0, float("nan"), 0), (0, 0, 1e9)):
        with pytest.raises(InputError, match="no place on earth"):
            Georeference(*wrong)
    with pytest.raises(InputError, match="no UTM"):
        Georeference(85, 0, 0).to_utm(np.zeros(3))
