"""`report.html`: what the page of a run shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from fieldfuse.evaluation import words
from fieldfuse.evaluation.page import data_uri, render, tile, view_values
from fieldfuse.evaluation.pictures import Pictures, ViewPictures
from fieldfuse.evaluation.plots import psnr_over_time, stage_bars
from fieldfuse.evaluation.report import METHODS, report_data, score_rows, write_page

WALK = "/field.html"  # the export that is linked at the top


def render_page(data: dict[str, Any], pictures: Pictures) -> str:
    """The page as text. `data` as `report_data` answers it."""
    evaluation = data["evaluation"]
    levels = {"TSDF": (evaluation["tsdf"] or {}).get("psnr"), "nearest photo": (evaluation["nearest_image"] or {}).get("psnr")}
    # The plots are our own text but for stage names, which matplotlib escapes.
    time_plot, stage_plot = psnr_over_time(data["timeline"], levels), stage_bars(data["stages"])
    rows, exports = score_rows(data), export_rows(data)
    return render(
        "report.html.j2",
        data,
        "Report",
        warnings=data["warnings"],
        unit=words.unit_of(data),
        headline=headline(data),
        rows=rows,
        depth=any(row.get("depth_abs_err") is not None for row in rows),
        page=view_values(pictures, [view_block(data, view) for view in pictures.views]),
        moving=[{"caption": name, "uri": data_uri(image)} for name, image in pictures.moving],
        time_plot=None if time_plot is None else Markup(time_plot),
        stage_plot=None if stage_plot is None else Markup(stage_plot),
        exports=exports,
        walk=next((row["href"] for row in exports if row["path"].endswith(WALK)), ""),
    )


def view_block(data: dict[str, Any], view: ViewPictures) -> dict[str, Any]:
    """What the template shows of a view: its name, the scores of each method, and a row of four captioned tiles for each."""
    rows: list[Any] = []
    scores: list[Any] = []
    for key, title in METHODS:
        if key not in view.methods:
            continue
        tiles, score = view.methods[key], data["evaluation"].get(key) or {}
        first = ("Photo", view.truth)
        if rows and view.measured is not None:  # the photo stands above already
            first = ("Measured depth", view.measured)
        rows.append([tile(image, text) for text, image in (first, (title, tiles.render), ("Error", tiles.error), ("Depth", tiles.depth))])
        for one in score.get("per_view") or []:
            if str(one.get("name")) == view.name:
                one = {**dict.fromkeys(words.SCORE), **one}
                text = f"{title} {words.decimal(one['psnr'])} dB · SSIM {words.decimal(one['ssim'], 3)}"
                if one["depth_abs_err"] is not None:
                    text += f" · depth error {words.significant(one['depth_abs_err'])} {words.unit_of(data)}"
                scores.append(text if len(view.methods) > 1 else text.removeprefix(f"{title} "))
    return {"name": view.name, "scores": scores, "rows": rows, "tall": view.truth.shape[0] / view.truth.shape[1]}


def headline(data: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The large numbers on top: (value, unit or remark beside it, what it is)."""
    poses, field = data["poses"], data["field"]
    out = []
    for key, title in METHODS:
        score = data["evaluation"].get(key)
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


def write_report(folder: Path | str, data: dict[str, Any], pictures: Pictures | None = None) -> tuple[Path, Path]:
    """Write `report.json` and `report.html` into `folder`.

    Args:
        folder: the run's folder; exports are linked relative to it.
        data: all parts are optional, extra keys are kept in the JSON. `version`, `command`, `source`, `created` (text), `seconds_total`;
            `warnings`, `notes` (lists of sentences); `capture` {kind, frames, width, height}; `poses` {source, registered, total, models,
            missing}; `scene` {metric, …}; `field` {voxel_size, blocks, voxels, bytes}; `evaluation` {field, tsdf} as `score_views` answers;
            `baseline` as `nearest_image_scores` answers (in the JSON it is `evaluation.nearest_image`); `timeline` [{seconds, psnr}];
            `stages` [{name, seconds, peak_memory_mb, cached}]; `exports` [{path, bytes, facts}] or paths; `settings` (nested plain data).
        pictures: as `method_pictures` answers; None: none.

    Returns:
        the paths of the JSON and of the HTML file.

    Raises:
        InputError: a part has another form.
        OutputError: the folder is not writable or the disk is full.
    """
    data = report_data(data, Path(folder))
    return write_page(Path(folder), "report", data, render_page(data, pictures or Pictures()))
