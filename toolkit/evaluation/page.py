"""The HTML page of a report: one file, no script, nothing loaded from anywhere, all text from users escaped by the template."""

from __future__ import annotations

import base64
from datetime import datetime
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
from markupsafe import Markup

from fieldfuse.camera import Array
from fieldfuse.errors import OutputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.pictures import DEPTH_COLOURS, ERROR_COLOURS, ERROR_TOP, Pictures, colour_bar
from fieldfuse.evaluation.plots import psnr_over_time, stage_bars
from fieldfuse.evaluation.templates import template

TEMPLATE = "report.html.j2"
LONGEST = 480  # pixels of an embedded tile's long side: sharp at the size it is shown, small in bytes
QUALITY = 86
TILE_HEIGHT = 380  # CSS pixels at most, so that upright pictures do not fill the screen
WALK = "/field.html"  # the export that is linked at the top
OPEN_VIEWS = 3  # views shown at once; the others are one click away
METHODS = (("field", "Field"), ("network", "Networks alone"), ("tsdf", "TSDF"))


def data_uri(picture: Array, lossless: bool = False) -> str:
    """(H, W, 3) uint8 RGB as a `data:` address, shrunk to `LONGEST` pixels: JPEG, or PNG when `lossless`."""
    height, width = picture.shape[:2]
    if max(height, width) > LONGEST:
        shrink = LONGEST / max(height, width)
        picture = cv2.resize(picture, (max(1, round(width * shrink)), max(1, round(height * shrink))), interpolation=cv2.INTER_AREA)
    suffix, parameters = (".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]) if lossless else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    done, data = cv2.imencode(suffix, np.ascontiguousarray(picture[..., ::-1]), parameters)
    if not done:
        raise OutputError(f"cannot encode a picture of shape {picture.shape} for the report")
    return f"data:image/{'png' if lossless else 'jpeg'};base64," + base64.b64encode(data.tobytes()).decode("ascii")


def scores_by_name(score: dict[str, Any] | None) -> dict[str, dict[str, Any]]:
    """Name of the view → its scores."""
    return {str(view.get("name")): {**dict.fromkeys(words.SCORE), **view} for view in (score or {}).get("per_view") or []}


def view_rows(data: dict[str, Any], pictures: Pictures) -> list[dict[str, Any]]:
    """What the template shows of each view: its name, and for each method a row of four captioned tiles."""
    scores = {key: scores_by_name(data["evaluation"].get(key)) for key, _ in METHODS}
    out = []
    for view in pictures.views:
        rows: list[dict[str, Any]] = []
        for key, title in METHODS:
            if key not in view.methods:
                continue
            tiles, score = view.methods[key], scores[key].get(view.name, {})
            first = ("Photo", view.truth)
            if rows:  # the photo stands above already
                first = ("Measured depth", view.measured) if view.measured is not None else ("Photo", view.truth)
            shown = [first, (title, tiles.render), ("Error", tiles.error), ("Depth", tiles.depth)]
            rows.append({"title": title, "score": score, "tiles": [{"caption": text, "uri": data_uri(tile)} for text, tile in shown]})
        out.append({"name": view.name, "rows": rows, "tall": view.truth.shape[0] / view.truth.shape[1]})
    return out


def comparison(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of the table of headline numbers, and for each measure whether a row is the best (when there are two to compare)."""
    rows = []
    for key, title in METHODS:
        score = data["evaluation"].get(key)
        if score is None:
            continue
        frames = score.get("key_frames")
        note = (
            ""
            if frames is None
            else f"{words.counted(frames, 'key frame')} fused in {words.duration(score.get('seconds'))}, nothing fitted"
        )
        rows.append({**score, "title": title, "note": note, "part": False})
        if score.get("psnr_masked") is not None:
            note = f"where it has surface: {words.share(score.get('coverage'))} of the pixels"
            rows.append({"title": title, "note": note, "psnr": score["psnr_masked"], "part": True})
    floor = data["evaluation"]["nearest_image"]
    if floor is not None and floor["psnr"] is not None:
        rows.append({"title": "Nearest training photo", "note": "shown unchanged: the floor", "psnr": floor["psnr"], "part": True})
    rivals = [row for row in rows if not row.get("part")]
    for measure, better in (("psnr", max), ("ssim", max), ("lpips", min), ("depth_abs_err", min), ("seconds_per_view", min)):
        known = [row[measure] for row in rivals if row.get(measure) is not None]
        for row in rivals:
            row.setdefault("best", {})[measure] = len(known) > 1 and row.get(measure) == better(known)
    return rows


def flat(settings: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value) pairs."""
    if not isinstance(settings, dict):
        return [
            (prefix, "automatic" if settings is None else ", ".join(map(str, settings)) if isinstance(settings, list) else str(settings))
        ]
    return [pair for key, value in settings.items() for pair in flat(value, f"{prefix}.{key}" if prefix else str(key))]


def headline(data: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The large numbers on top: (value, unit or remark beside it, what it is)."""
    evaluation, poses, field = data["evaluation"], data["poses"], data["field"]
    out = []
    for key, title in METHODS:
        score = evaluation.get(key)
        if score is not None and score["psnr"] is not None:
            views = words.counted(score["views"], "test view") if score["views"] is not None else "test views"
            out.append((words.decimal(score["psnr"], 1), "dB", f"{title}: PSNR on {views}"))
    if data["seconds_total"] is not None:
        out.append((words.duration(data["seconds_total"]), "", "from capture to report"))
    if poses["registered"] is not None and poses["total"] is not None:
        out.append((f"{poses['registered']} / {poses['total']}", "", "images with a pose"))
    if field["bytes"] is not None:
        note = f"field: {words.whole(field['voxels'])} voxels" if field["voxels"] is not None else "size of the field"
        out.append((words.size(field["bytes"]), "", note))
    return out


def short_name(source: Any) -> str:
    """The last part of a path: what people call their capture."""
    text = str(source or "").rstrip("/")
    return text.rsplit("/", 1)[-1] or text


def moment(created: Any) -> str:
    """An ISO time as date and minute; any other text as it is."""
    try:
        time = datetime.fromisoformat(str(created))
    except ValueError:
        return str(created)
    return f"{time:%Y-%m-%d %H:%M} {time.tzname() or ''}".rstrip()


def subtitle(data: dict[str, Any]) -> list[str]:
    """The line under the title, in parts: what the capture is and when it was made."""
    capture = data["capture"]
    out = [str(capture["kind"])] if capture["kind"] is not None else []
    if capture["frames"] is not None:
        out.append(words.counted(capture["frames"], "frame"))
    if capture["width"] is not None and capture["height"] is not None:
        out.append(f"{capture['width']}×{capture['height']}")
    out += {"sfm": ["poses computed"], "given": ["poses given"]}.get(str(data["poses"]["source"]), [])
    return out + ([moment(data["created"])] if data["created"] else [])


def export_rows(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Exports with an address relative to the page, none for a path that leads elsewhere, and their facts as one line."""
    out = []
    for entry in data["exports"]:
        path = str(entry["path"] or "")
        elsewhere = path.startswith(("/", "\\")) or ".." in path.split("/") or not path
        facts = {**entry, **(entry["facts"] if isinstance(entry.get("facts"), dict) else {})}
        shown = {key: value for key, value in facts.items() if key not in ("path", "bytes", "name", "facts") and value is not None}
        line = ", ".join(_fact(key.replace("_", " "), value) for key, value in shown.items())
        out.append({"path": path, "href": "" if elsewhere else "./" + quote(path), "bytes": entry["bytes"], "facts": line})
    return out


def _fact(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return name if value else f"not {name}"
    if isinstance(value, int):
        return f"{words.whole(value)} {name}"
    return f"{name} {words.significant(value) if isinstance(value, float) else value}"


def render_page(data: dict[str, Any], pictures: Pictures) -> str:
    """The page as text. `data` as `report_data` answers it."""
    evaluation = data["evaluation"]
    levels = {
        "TSDF": (evaluation["tsdf"] or {}).get("psnr"),
        "nearest photo": (evaluation["nearest_image"] or {}).get("psnr"),
    }
    # The plots are our own text but for stage names, which matplotlib escapes.
    time_plot, stage_plot = psnr_over_time(data["timeline"], levels), stage_bars(data["stages"])
    near, far = pictures.depth_range or (None, None)
    rows, exports = comparison(data), export_rows(data)
    return template(TEMPLATE).render(
        data=data,
        title=short_name(data["source"]) or "Report",
        subtitle=subtitle(data),
        unit=words.unit_of(data),
        headline=headline(data),
        rows=rows,
        depth=any(row.get("depth_abs_err") is not None for row in rows),
        views=view_rows(data, pictures),
        open_views=OPEN_VIEWS,
        tile_height=TILE_HEIGHT,
        left_out=pictures.left_out,
        moving=[{"caption": name, "uri": data_uri(tile)} for name, tile in pictures.moving],
        error_top=ERROR_TOP,
        error_bar=data_uri(colour_bar(128, 1, ERROR_COLOURS), lossless=True),
        depth_bar=data_uri(colour_bar(128, 1, DEPTH_COLOURS), lossless=True),
        near=near,
        far=far,
        depth_unit=pictures.unit,
        time_plot=None if time_plot is None else Markup(time_plot),
        stage_plot=None if stage_plot is None else Markup(stage_plot),
        exports=exports,
        walk=next((row["href"] for row in exports if row["path"].endswith(WALK)), ""),
        settings=flat(data["settings"]),
    )
