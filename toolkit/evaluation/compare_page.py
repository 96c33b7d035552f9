"""The page of a comparison: one file, no script, nothing loaded from anywhere; and `compare.json` beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from fieldfuse.camera import Array
from fieldfuse.evaluation import words
from fieldfuse.evaluation.compare import compare_data, matching_line, table
from fieldfuse.evaluation.compare_meshes import ERROR_VOXELS, MeshPictures
from fieldfuse.evaluation.page import data_uri, flat, short_name, subtitle
from fieldfuse.evaluation.pictures import DEPTH_COLOURS, ERROR_COLOURS, ERROR_TOP, Pictures, ViewPictures, colour_bar
from fieldfuse.evaluation.plots import stage_bars
from fieldfuse.evaluation.templates import template
from fieldfuse.files import atomic_path, write_json

JSON = "compare.json"
HTML = "compare.html"
TEMPLATE = "compare.html.j2"
OPEN_VIEWS = 3
KIND_TITLES = {"coloured": "mesh", "shape": "shape", "distance": "distance from truth"}

Tile = dict[str, str] | None


def write_comparison(
    folder: Path | str,
    data: dict[str, Any],
    pictures: Pictures | None = None,
    meshes: Sequence[MeshPictures] = (),
    depth_error_top: float | None = None,
) -> tuple[Path, Path]:
    """Write `compare.json` and `compare.html` into `folder`.

    Args:
        data: as for `compare_data`.
        pictures: of the test views, as `method_pictures` answers, by the keys of the methods.
        meshes: as `mesh_pictures` answers.
        depth_error_top: what the brightest colour of a depth error means, in the unit of `pictures`.

    Returns:
        the paths of the JSON and of the HTML file.

    Raises:
        InputError: the data has another form.
        OutputError: the folder is not writable or the disk is full.
    """
    folder = Path(folder)
    whole = compare_data(data)
    html = render_comparison(whole, pictures or Pictures(), meshes, depth_error_top)
    write_json(folder / JSON, whole)
    with atomic_path(folder / HTML) as temporary:
        temporary.write_text(html, encoding="utf-8")
    return folder / JSON, folder / HTML


def render_comparison(data: dict[str, Any], pictures: Pictures, meshes: Sequence[MeshPictures], depth_error_top: float | None) -> str:
    """The page as text. `data` as `compare_data` answers it."""
    methods = [(method["key"], method["title"]) for method in data["methods"]]
    stage_plot = stage_bars(data["stages"])
    near, far = pictures.depth_range or (None, None)
    return template(TEMPLATE).render(
        data=data,
        title=short_name(data["source"]) or "Comparison",
        subtitle=subtitle(data),
        headline=headline(data),
        groups=table(data),
        matching=matching_line(data),
        views=[
            view_block(view, methods, "True depth" if data["truth"]["depth"] == "exact" else "Depth of the sensor")
            for view in pictures.views
        ],
        open_views=OPEN_VIEWS,
        left_out=pictures.left_out,
        meshes=[block for view in meshes for block in mesh_blocks(view, methods)],
        error_top=ERROR_TOP,
        error_bar=data_uri(colour_bar(128, 1, ERROR_COLOURS), lossless=True),
        depth_bar=data_uri(colour_bar(128, 1, DEPTH_COLOURS), lossless=True),
        near=near,
        far=far,
        depth_unit=pictures.unit,
        depth_error_top=depth_error_top,
        mesh_error_top=mesh_error_top(data),
        stage_plot=None if stage_plot is None else Markup(stage_plot),
        settings=flat(data["settings"]),
    )


def headline(data: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The large numbers on top: (value, unit beside it, what it is)."""
    out = []
    for method in data["methods"]:
        score, geometry = method["score"] or {}, method["geometry"] or {}
        if score.get("psnr") is not None:
            out.append(
                (words.decimal(score["psnr"], 1), f"dB in {words.duration(method['seconds'])}", f"{method['title']}: whole test views")
            )
        elif geometry.get("f_score_2") is not None:
            out.append((words.share(geometry["f_score_2"]), "", f"{method['title']}: F-score at 2 voxels"))
    return out


def mesh_error_top(data: dict[str, Any]) -> str | None:
    """What the brightest colour of a mesh's distance means, in words."""
    voxel = next((m["geometry"]["voxel_size"] for m in data["methods"] if m["geometry"] and m["geometry"].get("voxel_size")), None)
    return (
        None if voxel is None else f"{words.significant(ERROR_VOXELS * voxel)} {data['truth']['unit'] or 'units'} ({ERROR_VOXELS:g} voxels)"
    )


def tile(picture: Array | None, caption: str) -> Tile:
    return None if picture is None else {"caption": caption, "uri": data_uri(picture)}


def view_block(view: ViewPictures, methods: Sequence[tuple[str, str]], measured: str = "True depth") -> dict[str, Any]:
    """Rows of tiles of one test view: the truth in the first column, then the methods; empty places are None."""
    shown = [(title, view.methods.get(key)) for key, title in methods]
    rows = [
        [tile(view.truth, "Photo"), *(tile(getattr(one, "render", None), title) for title, one in shown)],
        [None, *(tile(getattr(one, "error", None), f"{title}: error") for title, one in shown)],
        [tile(view.measured, measured), *(tile(getattr(one, "depth", None), f"{title}: depth") for title, one in shown)],
        [None, *(tile(getattr(one, "depth_error", None), f"{title}: depth error") for title, one in shown)],
    ]
    kept = [row for row in rows if any(place is not None for place in row[1:])]
    return {"name": view.name, "rows": kept, "tall": view.truth.shape[0] / view.truth.shape[1]}


def mesh_blocks(view: MeshPictures, methods: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Rows of tiles of one view of the meshes, one row a kind."""
    columns = [("truth", "Truth"), *methods] if any("truth" in by_name for by_name in view.kinds.values()) else list(methods)
    rows = []
    for kind, by_name in view.kinds.items():
        row = [tile(by_name.get(key), f"{title}: {KIND_TITLES[kind]}" if key != "truth" else "True shape") for key, title in columns]
        if any(place is not None for place in row):
            rows.append(row)
    if not rows:
        return []
    height, width = next(iter(next(iter(view.kinds.values())).values())).shape[:2]
    return [{"name": view.title, "rows": rows, "tall": height / width}]
