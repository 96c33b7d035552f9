"""Where exports lie on earth, beside them: `georeference.json`, and for programs that look for one the UTM zone's `.prj`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path, write_json
from fieldfuse.georeference import Georeference

NAME, PROJECTION = "georeference.json", "georeference.prj"


def write_georeference(folder: Path | str, place: Georeference) -> list[Path]:
    """Write `folder/georeference.json` and, with pyproj, `folder/georeference.prj`; answers what was written.

    Coordinates of exports stay small, so that float32 holds them exactly; `utm_from_exports` (4 × 4) brings them to the UTM zone `epsg`, to
    a millimetre within some hundred metres of the origin. Without pyproj, and near the poles, these two are null.

    Raises:
        OutputError: a file cannot be written.
    """
    folder = Path(folder)
    data: dict[str, Any] = {
        "crs": "EPSG:4979",
        "origin": {"latitude": place.latitude, "longitude": place.longitude, "altitude": place.altitude},
        "axes": "metres east, north and up of the origin",
        "enu_from_exports": place.enu_from_input.to_dict(),
        "source": place.source,
        "error": place.error,
        "epsg": None,
        "utm_from_exports": None,
    }
    files = [folder / NAME]
    try:
        data |= {"epsg": place.epsg, "utm_from_exports": place.utm_from_input().tolist()}
        projection = place.wkt(esri=True)
    except InputError:
        (folder / PROJECTION).unlink(missing_ok=True)
    else:
        with atomic_path(folder / PROJECTION) as temporary:
            temporary.write_text(projection + "\n", encoding="utf-8")
        files.append(folder / PROJECTION)
    write_json(folder / NAME, data)
    return files
