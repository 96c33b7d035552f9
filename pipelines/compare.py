"""`fieldfuse compare SOURCE --out DIR`: the field and TSDF fusion on the same frames, poses and test views, side by side."""

from __future__ import annotations

import json as writer
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.options import (
    Budget,
    Config,
    Device,
    Holdout,
    ImageSize,
    Json,
    OptionalOut,
    Pairs,
    PosesFrom,
    Preset,
    Quiet,
    Seed,
    Target,
    Threads,
    gather,
)

Depth = Annotated[
    str,
    typer.Option(
        help="Depth that the TSDF is made of: sensor, matching (of the pictures), exact (of a simulated capture), separated by commas;"
        " auto: the sensor's, else by matching, and all there is where the truth is known."
    ),
]
FORMATS = "export.formats=[ply]"  # the mesh alone: what is compared
DEPTH_FROM = "fit.depth_from=any"  # where pictures are matched for a surface, the field may know that depth, too


def compare(
    target: Target,
    out: OptionalOut = None,
    depth: Depth = "auto",
    preset: Preset = None,
    budget: Budget = None,
    image_size: ImageSize = None,
    holdout: Holdout = None,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    poses: PosesFrom = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Make the field, fitted and not, and the TSDF surface, score all on the same test views, and put them side by side on one page.

    With the folder of an earlier run its results are used as they are. A capture with `ground_truth/mesh.ply` has its meshes measured.
    """
    from fieldfuse.pipelines.thread_limits import bound_threads

    flags = {"budget": budget, "image_size": image_size, "holdout": holdout, "device": device, "threads": threads, "seed": seed}
    wanted = list(pairs or [])
    if out is not None and not any(pair.startswith("export.formats=") for pair in wanted):
        wanted.insert(0, FORMATS)
    if out is not None and (depth == "auto" or "matching" in depth) and not any(pair.startswith("fit.depth_from=") for pair in wanted):
        wanted.insert(0, DEPTH_FROM)
    options = gather(preset, config, wanted, **flags, **{"poses.source": poses})
    bound_threads(options)
    from fieldfuse.pipelines.console import make_progress

    data = compare_run(target, out, options, depth, make_progress(quiet))
    show(data, target if out is None else out, quiet, json)


def compare_run(target: Path, out: Path | None, options: dict[str, Any], depth: str, progress: Any) -> dict[str, Any]:
    """Make what is missing and write the comparison; answers `compare.json`.

    Raises:
        InputError: no test views, or depth that the capture does not bring.
    """
    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.compare_truth import find_truth
    from fieldfuse.pipelines.comparison import put_comparison
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.reconstruct import BEFORE, FOR_FIELD, RESULTS, stand
    from fieldfuse.pipelines.steps_compare import SURFACES, Compared, choose_surfaces, measure, not_fitted
    from fieldfuse.pipelines.steps_results import export_results, fit_radiance_field, fuse_tsdf, render_test_views

    start = time.monotonic()
    with open_job(target, out, options, progress, (*BEFORE, *FOR_FIELD, *RESULTS, *SURFACES.values())) as job:
        capture, poses, posed, scene, views = stand(job)
        if not views.test.any():
            raise InputError("a comparison needs pictures that were kept for testing; give --holdout 8")
        truth = find_truth(posed) if poses.source == "given" else None
        surfaces = {SURFACES[kind]: kind for kind in choose_surfaces(depth, posed, truth)}
        pictures = {name: fuse_tsdf(job, posed, scene, views, name, kind) for name, kind in surfaces.items()}
        field, _ = fit_radiance_field(job, views, scene)
        pictures = {"field": render_test_views(job, field, views, scene), **not_fitted(job, views, scene), **pictures}
        facts = export_results(job, field, poses, posed, scene, views)
        everything = Compared(capture, poses, posed, scene, views, field, pictures, truth)
        found = measure(job, everything)
        return put_comparison(job, everything, found, facts.get("mesh"), time.monotonic() - start)


def show(data: dict[str, Any], folder: Path, quiet: bool, as_json: bool) -> None:
    """The result on stdout: JSON, or the table and where the page is."""
    from fieldfuse.evaluation.compare_text import comparison_text
    from fieldfuse.pipelines.console import columns

    if as_json:
        sys.stdout.write(writer.dumps(data, indent=1) + "\n")
    elif not quiet:
        sys.stdout.write(comparison_text(data, columns(sys.stdout)))
        for warning in data["warnings"]:
            sys.stdout.write(f"note: {warning}\n")
        sys.stdout.write(f"{folder / 'compare.html'}\n")
