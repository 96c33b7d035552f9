"""`fieldfuse compare SOURCE --out DIR`: the field and TSDF fusion on the same frames, poses and test views, side by side."""

from __future__ import annotations

import sys
import time
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
    from fieldfuse.pipelines.console import make_progress

    data = compare_run(place, settings, depth, make_progress(options.quiet))
    show(data, options, lambda: lines(data, place.folder))


def compare_run(place: Place, options: dict[str, Any], depth: str, progress: Any) -> dict[str, Any]:
    """Make what is missing and write the comparison; answers `compare.json`.

    Raises:
        InputError: no test views, or depth that the capture does not bring.
    """
    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.compare_truth import find_truth
    from fieldfuse.pipelines.comparison import put_comparison
    from fieldfuse.pipelines.exports import Wish, export_results
    from fieldfuse.pipelines.fields import fit_radiance_field, render_test_views, starting_field
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.prepare import prepare
    from fieldfuse.pipelines.reconstruct import FOR_FIELD, RESULTS
    from fieldfuse.pipelines.stages import BEFORE
    from fieldfuse.pipelines.steps_compare import SURFACES, Compared, choose_surfaces, measure, not_fitted
    from fieldfuse.pipelines.surfaces import fuse_tsdf

    start = time.monotonic()
    with open_job(place, options, progress, (*BEFORE, *FOR_FIELD, *RESULTS, *SURFACES.values())) as job:
        ready = prepare(job)
        if not ready.views.test.any():
            raise InputError("a comparison needs pictures that were kept for testing; give --holdout 8")
        truth = find_truth(ready.posed) if ready.poses.source == "given" else None
        surfaces = {SURFACES[kind]: kind for kind in choose_surfaces(depth, ready.posed, truth)}
        pictures = {name: fuse_tsdf(job, ready, name, kind) for name, kind in surfaces.items()}
        network = starting_field(job, ready)
        fitted = fit_radiance_field(job, ready, network)
        pictures = {"field": render_test_views(job, ready, fitted.field), **not_fitted(job, ready, network), **pictures}
        facts = export_results(job, ready, fitted, Wish())
        everything = Compared(ready, fitted, pictures, truth)
        found = measure(job, everything)
        return put_comparison(job, everything, found, facts.get("mesh"), time.monotonic() - start)


def lines(data: dict[str, Any], folder: Path) -> Iterator[str]:
    """The table, remarks, and where the page is."""
    from fieldfuse.evaluation.compare_text import comparison_text
    from fieldfuse.pipelines.console import columns

    yield comparison_text(data, columns(sys.stdout)).removesuffix("\n")
    yield from (f"note: {warning}" for warning in data["warnings"])
    yield str(folder / "compare.html")
