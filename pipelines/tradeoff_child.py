"""The process that makes and measures one point of a sweep: `python -m fieldfuse.pipelines.tradeoff_child JOB.json`.

A process of its own, so that its peak memory is its own, and so that running out of memory ends this point and not the sweep.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fieldfuse.pipelines.tradeoff_make import Ground

KEPT = ("psnr", "ssim", "lpips", "coverage", "psnr_masked", "acc_1", "acc_5")


def load_average() -> float | None:
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def measure(spec: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of one job: the result, and its variants.

    Raises:
        InputError: the point cannot be made (a voxel too fine for the memory, say).
    """
    from fieldfuse.pipelines.job import read_settings, set_threads
    from fieldfuse.pipelines.tradeoff_make import make_direct, make_field, make_surface, open_ground

    settings = read_settings({}, spec["settings"])
    settings.seed = spec["seed"]
    set_threads(settings.threads)
    settings.field.decoder = spec["wanted"].get("decoder", settings.field.decoder)  # its kernels are compiled before clocks run
    before = load_average()
    ground = open_ground(Path(spec["folder"]), settings, spec["views"])
    makers = {"direct": make_direct, "tsdf": make_surface, "tsdf_stereo": make_surface}
    make = makers.get(spec["method"], make_field)
    with tempfile.TemporaryDirectory(prefix="fieldfuse-") as scratch:
        made = make(ground, spec, Path(scratch))
        rows = [row_of(ground, spec, one) for one in made]
    load = [before, load_average()]
    stamp = datetime.now(UTC).isoformat(timespec="seconds")
    return [{**row, "seed": spec["seed"], "load": load, "measured": stamp, "error": None} for row in rows]


def row_of(ground: Ground, spec: dict[str, Any], one: dict[str, Any]) -> dict[str, Any]:
    """Scores of one result at the test views, beside what it cost."""
    import numpy as np

    from fieldfuse.evaluation.compare_score import compare_views

    indices = np.flatnonzero(ground.views.test)
    pictures, seconds = [], []
    for index in indices:
        start = time.monotonic()
        pictures.append(one["show"](ground.views.intrinsics[index], ground.views.world_from_camera[index]))
        seconds.append(time.monotonic() - start)
    score = compare_views({"it": pictures}, ground.views, indices, {"it": seconds}, ground.test_depths)["it"]
    return {
        "method": spec["method"],
        "wanted": {**spec["wanted"], **one.get("changed", {})},
        "variant": one.get("variant"),
        "setting": one["setting"],
        "stages": {name: round(value, 3) for name, value in one["stages"].items()},
        "seconds": round(sum(one["stages"].values()), 3),
        "peak_memory_mb": one.get("peak_memory_mb"),
        "memory_mb": one.get("memory_mb"),
        "disk_bytes": one.get("disk_bytes"),
        "seconds_per_view": score["seconds_per_view"],
        **{key: score[key] for key in KEPT},
        "depth_error": score["abs_err"],
        "depth_median_rel": (score["depth"] or {}).get("median_rel"),
    }


def main(path: str) -> int:
    """Measure the job in the file, write its answer beside it; 0 when there is one."""
    from fieldfuse.errors import FieldfuseError
    from fieldfuse.evaluation.report import plain
    from fieldfuse.files import read_json, write_json
    from fieldfuse.poses.child import die_with_parent

    die_with_parent()
    spec = read_json(path)
    try:
        answer = {"rows": plain(measure(spec))}
    except FieldfuseError as error:
        answer = {"error": " ".join(str(error).split())}
    except MemoryError:
        answer = {"error": "there is not enough memory for this"}
    write_json(spec["answer"], answer)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
