"""The page of a batch of runs, and `batch.json` beside it."""

from __future__ import annotations

import urllib.parse
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from fieldfuse.evaluation import words
from fieldfuse.evaluation.page import data_uri, render
from fieldfuse.evaluation.report import parts, plain, whole, write_page

RUN = ("name", "source", "options", "state", "error", "node", "seconds", "psnr", "ssim", "lpips", "nearest_image", "report", "key")
STATES = ("done", "running", "waiting", "stopped", "failed")


def batch_data(data: dict[str, Any]) -> dict[str, Any]:
    """`data` in the fixed form of `batch.json`: what reports share, and `runs`, each with the entries `RUN` and `warnings`.

    Raises:
        InputError: a part is of another form.
    """
    runs = [{**run, "warnings": [str(text) for text in run.get("warnings") or []]} for run in parts(plain(data.get("runs")), RUN, "runs")]
    return whole(plain({key: value for key, value in data.items() if key != "runs"}), runs=runs)


def write_batch(folder: Path, data: dict[str, Any], thumbnails: Mapping[str, str]) -> tuple[Path, Path]:
    """Write `batch.json` and `batch.html` into `folder`.

    Args:
        data: as for `batch_data`. thumbnails: `data:` addresses of images by the names of runs.

    Returns:
        the paths of the JSON and of the HTML file.

    Raises:
        OutputError: the folder is not writable or the disk is full.
    """
    data = batch_data(data)
    tiles = [({**run, "link": urllib.parse.quote(run["report"] or "")}, thumbnails.get(run["name"])) for run in data["runs"]]
    html = render("batch.html.j2", data, "Batch", warnings=data["warnings"], headline=headline(data["runs"]), tiles=tiles)
    return write_page(folder, "batch", data, html)


def headline(runs: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """The large numbers on top: (value, unit beside it, what it is)."""
    counts = {state: sum(run["state"] == state for run in runs) for state in STATES}
    out = [(words.whole(count), "", state) for state, count in counts.items() if count or state == "done"]
    scores = [run["psnr"] for run in runs if run["psnr"] is not None]
    return [*out, *([(words.decimal(median(scores), 1), "dB", "PSNR, median of runs")] if scores else [])]


def thumbnail(folder: Path) -> str | None:
    """A render of a held-out view of the run in `folder`, as a `data:` address; None where there is none."""
    import cv2

    found = sorted(path for path in (folder / "renders").glob("field_*.png") if not path.stem.endswith("_depth"))
    image = cv2.imread(str(found[len(found) // 2]), cv2.IMREAD_COLOR) if found else None
    return None if image is None else data_uri(image[..., ::-1])
