"""Samples of what stages and measurements leave as JSON in a run's folder, and what later commands do with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.files import write_json
from fieldfuse.pipelines.summary import describe_matching
from tests.stability.fuzz.watch import all_of

FILES = (
    "evaluation.json", "timeline.json", "exports/facts.json", "fit_notes.json", "fit_matched.json", "effects.json", "effects.json",
    "network.json",
)  # fmt: skip
MEASURED = (
    "tradeoff.json",
    "tradeoff.json",
    "tradeoff.csv",
    "tradeoff/points/point.json",
    "compare/scores.json",
    "compare/compare.json",
    "results.json",
    "report.json",
    "few_views.json",
)
KEPT = (("scores", "score"), ("geometry", "geometry"))  # a part of what a comparison has, and its name in each method
PAGE_EVERY = 25  # the whole page takes a hundred times as long as its numbers


def make_results(root: Path) -> None:
    """What the stages leave, with every part that there can be."""
    from fieldfuse.effects.correct import Corrections

    depth = {"abs_err": 0.01, "rmse": 0.02, "coverage": 0.9, "pixels": 70}
    views = [{"index": i, "name": f"{i:03d}", "psnr": 21.5 + i, "ssim": 0.8, "lpips": None, "depth": dict(depth)} for i in (0, 4)]
    means = {"views": 2, "psnr": 23.5, "ssim": 0.8, "lpips": 0.2, "depth_abs_err": 0.01, "seconds_per_view": 0.1}
    scores = {**means, "depth": depth, "per_view": views}
    mesh = {"vertices": 3, "triangles": 1, "watertight": False, "components": 1, "area": 0.5, "bounds": [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]}
    fused = {"voxel_size": 0.02, "depth_max": 4.0, "frames": 6, "blocks": 50, "bytes": 9000, "depth_from": "sensor", "mesh": mesh}
    nearest = {"views": 2, "psnr": 15.0, "per_view": [{"index": 0, "name": "000", "nearest": "001", "psnr": 15.0}]}
    seconds = {"seconds": 0.3, "fusion_seconds": 0.2, "encode_seconds": 0.1, "first_preview_seconds": 0.2}
    held = {"before": 2.0, "after": 1.0, "unit": "%"}
    names = ("exposure", "vignetting", "distortion", "rolling_shutter", "background", "motion_blur", "poses")
    found = [
        {"effect": name, "number": 0.4, "threshold": 0.1, "there": index % 2 == 0, "reason": "shared points differ", "held_out": held,
         "wish": "auto", "on": index % 3 == 0, "note": ""}
        for index, name in enumerate(names)
    ]  # fmt: skip
    corrections = Corrections(
        {"a": (1.1, 0.9, 1.0)}, corner=0.8, dimmed=1.2, lens=(0.01, -0.001), poses={"a": np.eye(4)}, weight={"b": 0.5}
    )
    looked_at = {"frames": 8, "points": 300}
    files = {
        "evaluation.json": {"field": scores, "tsdf": {**scores, **fused}, "nearest_image": nearest},
        "timeline.json": [{"seconds": 1.0 + i, "psnr": 20.0 + i} for i in range(4)],
        "exports/facts.json": {"mesh": mesh, "notes": ["points and meshes were left out"]},
        "fit_notes.json": ["step 3 of the fit was not finite", "the field stayed at 64³"],
        "fit_matched.json": {"views": 7, "pixels": 128, "share": 0.31, "bare": 0.12, "seconds": 0.4},
        "network.json": {"key_frames": 4, **seconds, "resolution": 48},
        "effects.json": {"effects": found, "seconds": 1.0, "looked_at": looked_at, "corrections": corrections.to_dict()},
        "run.json": {},  # so that it counts as the folder of a run
    }
    for name, content in files.items():
        write_json(root / name, content)


def _report(root: Path) -> dict[str, Any]:
    """What `fieldfuse.pipelines.summary` gathers of the files in `root`."""
    from fieldfuse.evaluation.report import report_data
    from fieldfuse.pipelines import schemas

    scores = schemas.read_checked(root / "evaluation.json", schemas.EVALUATION)
    effects = schemas.read_checked(root / "effects.json", schemas.Effects)
    network = schemas.read_checked(root / "network.json", schemas.Network)
    return report_data(
        {
            "capture": {"kind": "transforms", "frames": 8, "width": 48, "height": 36},
            "poses": {"source": "given", "registered": 8, "total": 8, "models": [8], "missing": []},
            "warnings": schemas.read_checked(root / "fit_notes.json", schemas.NOTES),
            "notes": [describe_matching(schemas.read_checked(root / "fit_matched.json", schemas.Matched))],
            "evaluation": {name: scores.get(name) for name in ("field", "tsdf")} | {"network": {**(scores.get("field") or {}), **network}},
            "effects": {name: effects[name] for name in ("effects", "seconds", "looked_at")},
            "baseline": scores.get("nearest_image"),
            "timeline": schemas.read_checked(root / "timeline.json", schemas.TIMELINE),
            "export_facts": schemas.read_export_facts(root / "exports" / "facts.json"),
            "exports": [{"path": "mesh.ply", "bytes": 10}],
            "stages": [{"name": "field", "seconds": 1.0, "peak_memory_mb": 100.0, "cached": False}],
            "field": {"voxel_size": 0.1, "blocks": 4, "voxels": 100, "bytes": 1000},
        },
        root,
    )


def read_results(root: Path, number: int) -> None:
    """What the report and `info` make of them."""
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.evaluation.pictures import Pictures
    from fieldfuse.evaluation.report_page import render_page
    from fieldfuse.evaluation.terminal import report_text
    from fieldfuse.pipelines.info import effects_facts

    data = _report(root)
    str(report_text(data))
    json.dumps(data, allow_nan=False)
    effects_facts(root, True)
    Corrections.from_dict(json.loads((root / "effects.json").read_text(encoding="utf-8"))["corrections"])
    if number % PAGE_EVERY == 0:
        render_page(data, Pictures())


def make_measured(root: Path) -> None:
    """What `tradeoff`, `compare`, the benchmarks and runs of a total budget leave."""
    from benchmarks.protocols import SUITES
    from fieldfuse.evaluation.compare import compare_data
    from fieldfuse.evaluation.tradeoff import tradeoff_data
    from fieldfuse.evaluation.tradeoff_page import csv_text
    from tests.evaluation.test_compare_page import made
    from tests.evaluation.test_tradeoff import ladder

    machine = {"system": "Linux", "cores": 2, "threads": 1, "device": "cpu", "load": 0.5, "measured": "today"}
    measured = {"command": "fieldfuse …", "machine": machine}
    rows = ladder()
    tradeoff = tradeoff_data({**measured, "rows": rows, "unit": "m"})
    whole = {**made(), **measured, "matching": None}
    scored = {name: {part["key"]: part[of] for part in whole["methods"] if of in part} for name, of in KEPT}
    choice = {"image_size": 240, "fit_seconds": 12.5, "resolution": 256, "video_frames": 9, "effects": True}
    told = {"asked_seconds": 60, "predicted_seconds": 58.0, "real_seconds": 63.0, "stages": {"effects": {"real": 5.0}}, "choice": choice}
    suite = next(iter(SUITES.values()))
    row = {"scene": "lego", "variant": suite.variants[0].key, "width": 9, "height": 9, "train": 8, "test": 2, "psnr": 20.0, "ssim": 0.8,
           "lpips": 0.2, "fit_seconds": 1.0, "seconds": 2.0, "voxels": 10, "error": None}  # fmt: skip
    few = [{"views": 3, "start": start, "budget": 5, "psnr": 20.0, "ssim": 0.5, "seconds": 1.0} for start in ("direct", "network")]
    files = {
        "tradeoff.json": tradeoff,
        "tradeoff/points/point.json": {"key": "abc", "crashed": False, "wall_seconds": 12.0, "rows": rows[:2]},
        "compare/scores.json": {**scored, "seen_share": 0.8, "matching": None},
        "compare/compare.json": compare_data(whole),
        "report.json": {"source": "/data/lego", "budget": told, "evaluation": {"field": {"psnr": 27.25}}, **measured},
        "results.json": {"experiment": "suites", "suite": suite.name, **measured, "rows": [row, row]},
        "few_views.json": {"experiment": "few_views", **measured, "rows": few},
    }
    for name, content in files.items():
        write_json(root / name, content)
    (root / "tradeoff.csv").write_text(csv_text(tradeoff["rows"]), encoding="utf-8")


def read_measured(root: Path, number: int) -> None:
    """What the commands that go on from them, or show them, make of each."""
    from benchmarks.table import sections
    from fieldfuse.evaluation.compare import compare_data
    from fieldfuse.evaluation.terminal import comparison_text
    from fieldfuse.evaluation.tradeoff import tradeoff_data
    from fieldfuse.pipelines import schemas
    from fieldfuse.pipelines.tradeoff_sweep import rows_at

    def compared() -> None:
        found = schemas.read_checked(root / "compare" / "scores.json", schemas.CompareScores)
        methods = [
            {"key": key, "title": key, "score": found["scores"].get(key), "geometry": (found["geometry"] or {}).get(key)}
            for key in ("field", "tsdf")
        ]
        comparison_text(compare_data({"methods": methods, "truth": {"seen_share": found["seen_share"]}, "matching": found["matching"]}))

    all_of(
        lambda: sections([root / "tradeoff.json"], None, None),
        lambda: sections([root / "results.json"], None, None),
        lambda: sections([root / "compare" / "compare.json"], None, None),
        lambda: sections([root / "report.json"], None, None),
        lambda: tradeoff_data({"rows": rows_at(root / "tradeoff" / "points" / "point.json", "abc") or []}),
        lambda: sections([root / "few_views.json"], None, None),
        compared,
    )
