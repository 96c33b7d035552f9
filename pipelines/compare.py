"""`fieldfuse compare SOURCE --out DIR`: the field and TSDF fusion on the same frames, poses and test views, side by side."""

from __future__ import annotations

import json as writer
import sys
from typing import Annotated

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
    from fieldfuse.evaluation.terminal import comparison_text
    from fieldfuse.pipelines.comparison import compare_run
    from fieldfuse.pipelines.console import columns, make_progress

    data = compare_run(target, out, options, depth, make_progress(quiet))
    if json:
        sys.stdout.write(writer.dumps(data, indent=1) + "\n")
    elif not quiet:
        notes = "".join(f"note: {warning}\n" for warning in data["warnings"])
        sys.stdout.write(f"{comparison_text(data, columns(sys.stdout))}{notes}{(out or target) / 'compare.html'}\n")
