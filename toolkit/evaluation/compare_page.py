"""The page of a comparison, and `compare.json` beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from fieldfuse.evaluation import words
from fieldfuse.evaluation.compare import compare_data, matching_line, table
from fieldfuse.evaluation.compare_meshes import ERROR_VOXELS, MeshPictures
from fieldfuse.evaluation.page import render, tile, view_values
from fieldfuse.evaluation.pictures import Pictures, ViewPictures
from fieldfuse.evaluation.plots import stage_bars
from fieldfuse.evaluation.report import write_page

KIND_TITLES = {"coloured": "mesh", "shape": "shape", "distance": "distance from truth"}


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
    data, pictures = compare_data(data), pictures or Pictures()
    methods = [(method["key"], method["title"]) for method in data["methods"]]
    stage_plot = stage_bars(data["stages"])
    html = render(
        "compare.html.j2",
        data,
        "Comparison",
        warnings=data["warnings"],
        headline=headline(data),
        groups=table(data),
        matching=matching_line(data),
        page=view_values(pictures, [view_block(view, methods, data["truth"]["depth"] == "exact") for view in pictures.views]),
        meshes=[block for view in meshes for block in mesh_blocks(view, methods)],
        depth_error_top=depth_error_top,
        mesh_error_top=mesh_error_top(data),
        stage_plot=None if stage_plot is None else Markup(stage_plot),
    )
    return write_page(Path(folder), "compare", data, html)


def headline(data: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The large numbers on top: (value, unit beside it, what it is)."""
    out = []
    for method in data["methods"]:
        score, geometry, title = method["score"] or {}, method["geometry"] or {}, method["title"]
        if score.get("psnr") is not None:
            out.append((words.decimal(score["psnr"], 1), f"dB in {words.duration(method['seconds'])}", f"{title}: whole test views"))
        elif geometry.get("f_score_2") is not None:
            out.append((words.share(geometry["f_score_2"]), "", f"{title}: F-score at 2 voxels"))
    return out


def mesh_error_top(data: dict[str, Any]) -> str | None:
    """What the brightest colour of a mesh's distance means, in words."""
    voxel = next((m["geometry"]["voxel_size"] for m in data["methods"] if m["geometry"] and m["geometry"].get("voxel_size")), None)
    if voxel is None:
        return None
    return f"{words.significant(ERROR_VOXELS * voxel)} {data['truth']['unit'] or 'units'} ({ERROR_VOXELS:g} voxels)"


def view_block(view: ViewPictures, methods: Sequence[tuple[str, str]], exact: bool) -> dict[str, Any]:
    """Rows of tiles of one test view: the truth in the first column, then the methods; empty places are None."""
    rows = []
    for kind, suffix, first in (
        ("render", "", tile(view.truth, "Photo")),
        ("error", ": error", None),
        ("depth", ": depth", tile(view.measured, "True depth" if exact else "Depth of the sensor")),
        ("depth_error", ": depth error", None),
    ):
        tiles = [tile(getattr(view.methods.get(key), kind, None), title + suffix) for key, title in methods]
        if any(tiles):
            rows.append([first, *tiles])
    return {"name": view.name, "scores": [], "rows": rows, "tall": view.truth.shape[0] / view.truth.shape[1]}


def mesh_blocks(view: MeshPictures, methods: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Rows of tiles of one view of the meshes, one row a kind."""
    columns = [("truth", "Truth"), *methods] if any("truth" in by_name for by_name in view.kinds.values()) else list(methods)
    rows = []
    for kind, by_name in view.kinds.items():
        row = [tile(by_name.get(key), f"{title}: {KIND_TITLES[kind]}" if key != "truth" else "True shape") for key, title in columns]
        if any(row):
            rows.append(row)
    if not rows:
        return []
    height, width = next(iter(next(iter(view.kinds.values())).values())).shape[:2]
    return [{"name": view.title, "scores": [], "rows": rows, "tall": height / width}]
