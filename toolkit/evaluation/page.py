"""What all pages share: templates, embedded images, and the lines on what a run was made from.

A page is one file without scripts that loads nothing, and the templates escape every text from users.
"""

from __future__ import annotations

import base64
from datetime import datetime
from importlib import resources
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined

from fieldfuse.camera import Array
from fieldfuse.errors import OutputError
from fieldfuse.evaluation import words

if TYPE_CHECKING:
    from fieldfuse.evaluation.pictures import Pictures

LONGEST = 480  # pixels of an embedded image's long side: sharp at the size it is shown, small in bytes
QUALITY = 86
OPEN_VIEWS = 3  # views shown at once; the others are one click away
FILTERS = (words.decimal, words.significant, words.whole, words.size, words.memory, words.duration, words.share, words.held)

Tile = dict[str, str] | None


def render(name: str, data: dict[str, Any], title: str, **values: Any) -> str:
    """The page of the template `name` as text. `data` is in the fixed form of its JSON file; `title` stands for a source without a name."""

    def source(template: str) -> str:
        return resources.files("fieldfuse.evaluation").joinpath(template).read_text(encoding="utf-8")

    environment = Environment(
        loader=FunctionLoader(source), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {show.__name__: show for show in FILTERS}
    shared = {"title": short_name(data["source"]) or title, "subtitle": subtitle(data), "settings": flat(data["settings"])}
    return environment.get_template(name).render(data=data, **shared, **values)


def view_values(pictures: Pictures, views: list[dict[str, Any]]) -> dict[str, Any]:
    """What the section of test views shows: their `views`, the legends of errors and depths."""
    from fieldfuse.evaluation.pictures import DEPTH_COLOURS, ERROR_COLOURS, ERROR_TOP, coloured  # with torch

    bar = np.broadcast_to(np.linspace(0, 1, 128), (1, 128))  # the colour map from low to high
    near, far = pictures.depth_range or (None, None)
    return {
        "views": views,
        "open_views": OPEN_VIEWS,
        "left_out": pictures.left_out,
        "error_top": ERROR_TOP,
        "error_bar": data_uri(coloured(bar, ERROR_COLOURS), lossless=True),
        "depth_bar": data_uri(coloured(bar, DEPTH_COLOURS), lossless=True),
        "near": near,
        "far": far,
        "depth_unit": pictures.unit,
    }


def tile(image: Array | None, caption: str) -> Tile:
    """An image with a caption, None where there is no image."""
    return None if image is None else {"caption": caption, "uri": data_uri(image)}


def data_uri(image: Array, lossless: bool = False) -> str:
    """(H, W, 3) uint8 RGB as a `data:` address, shrunk to `LONGEST` pixels: JPEG, or PNG when `lossless`."""
    height, width = image.shape[:2]
    if max(height, width) > LONGEST:
        shrink = LONGEST / max(height, width)
        image = cv2.resize(image, (max(1, round(width * shrink)), max(1, round(height * shrink))), interpolation=cv2.INTER_AREA)
    suffix, parameters = (".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]) if lossless else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]), parameters)
    if not done:
        raise OutputError(f"cannot encode an image of shape {image.shape} for the report")
    return uri("png" if lossless else "jpeg", data.tobytes())


def uri(kind: str, data: bytes) -> str:
    """An encoded image as a `data:` address."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def flat(settings: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value) pairs."""
    if not isinstance(settings, dict):
        return [
            (prefix, "automatic" if settings is None else ", ".join(map(str, settings)) if isinstance(settings, list) else str(settings))
        ]
    return [pair for key, value in settings.items() for pair in flat(value, f"{prefix}.{key}" if prefix else str(key))]


def short_name(source: Any) -> str:
    """The last part of a path: what people call their capture."""
    text = str(source or "").rstrip("/")
    return text.rsplit("/", 1)[-1] or text


def subtitle(data: dict[str, Any]) -> list[str]:
    """The line under the title, in parts: what the capture is and when the page was made."""
    capture, created = data["capture"], str(data["created"] or "")
    out = [str(capture["kind"])] if capture["kind"] is not None else []
    if capture["frames"] is not None:
        out.append(words.counted(capture["frames"], "frame"))
    if capture["width"] is not None and capture["height"] is not None:
        out.append(f"{capture['width']}×{capture['height']}")
    out += {"sfm": ["poses computed"], "given": ["poses given"]}.get(str(data["poses"]["source"]), [])
    try:
        time = datetime.fromisoformat(created)
        created = f"{time:%Y-%m-%d %H:%M} {time.tzname() or ''}".rstrip()
    except ValueError:
        pass  # another text than a time is shown as it is
    return [*out, created] if created else out
