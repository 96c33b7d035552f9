"""`fieldfuse compare SOURCE --out DIR`: the field and TSDF fusion on the same frames, poses and test views, side by side."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.options import Options, Place, bound_threads, show, takes

Depth = Annotated[
    str,
    typer.Option(
        help="Depth that the TSDF is made of: sensor, matching (of the pictures), exact (of a simulated capture), separated by commas;"
        " auto: the sensor's, else by matching, and all there is where the truth is known."
    ),
]
FORMATS = "export.formats=[ply]"  # the mesh alone: what is compared
DEPTH_FROM = "fit.depth_from=any"  # where pictures are matched for a surface, the field may know that depth, too


@takes("preset budget image_size holdout device threads seed poses config pairs quiet json")
def compare(place: Place, depth: Depth = "auto", *, options: Options) -> None:
    """Make the field, fitted and not, and the TSDF surface, score all on the same test views, and put them side by side on one page.

    With the folder of an earlier run its results are used as they are. A capture with `ground_truth/mesh.ply` has its meshes measured.
    """
    added = [] if place.out is None else [FORMATS]
    if place.out is not None and (depth == "auto" or "matching" in depth):
        added.append(DEPTH_FROM)
    settings = options.settings(*added)  # what --set says comes later, and wins
    bound_threads(settings)
    from fieldfuse.pipelines.comparison import compare_run
    from fieldfuse.pipelines.console import make_progress

    data = compare_run(place, settings, depth, make_progress(options.quiet))
    show(data, options, lambda: lines(data, place.folder))


def lines(data: dict[str, Any], folder: Path) -> Iterator[str]:
    """The table, remarks, and where the page is."""
    from fieldfuse.evaluation.terminal import comparison_text
    from fieldfuse.pipelines.console import columns

    yield comparison_text(data, columns(sys.stdout)).removesuffix("\n")
    yield from (f"note: {warning}" for warning in data["warnings"])
    yield str(folder / "compare.html")
