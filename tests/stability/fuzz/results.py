"""Samples of what stages and measurements leave as JSON in a run's folder, and what later commands do with them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.files import write_json
from fieldfuse.pipelines.summary import describe_matching

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
PAGE_EVERY = 25  # the whole page takes a hundred times as long as its numbers


def make_results(root: Path) -> None:
    """What the stages leave, with every part that there can be."""
    from fieldfuse.effects.correct import Corrections

    depth = {"abs_err": 0.01, "rmse": 0.02, "coverage": 0.9, "pixels": 70}
    views = [{"index": i, "name": f"{i:03d}", "psnr": 21.5 + i, "ssim": 0.8, "lpips": None, "depth": dict(depth)} for i in (0, 4)]
    scores = {
        "views": 2,
        "psnr": 23.5,
        "ssim": 0.8,
        "lpips": 0.2,
        "depth_abs_err": 0.01,
        "seconds_per_view": 0.1,
        "depth": depth,
        "per_view": views,
    }
    mesh = {"vertices": 3, "triangles": 1, "watertight": False, "components": 1, "area": 0.5, "bounds": [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]}
    surface = {
        **scores,
        "voxel_size": 0.02,
        "depth_max": 4.0,
        "frames": 6,
        "blocks": 50,
        "bytes": 9000,
        "depth_from": "sensor",
        "mesh": mesh,
    }
    nearest = {"views": 2, "psnr": 15.0, "per_view": [{"index": 0, "name": "000", "nearest": "001", "psnr": 15.0}]}
    write_json(root / "evaluation.json", {"field": scores, "tsdf": surface, "nearest_image": nearest})
    write_json(root / "timeline.json", [{"seconds": 1.0 + i, "psnr": 20.0 + i} for i in range(4)])
    write_json(root / "exports" / "facts.json", {"mesh": mesh, "notes": ["points and meshes were left out"]})
    write_json(root / "fit_notes.json", ["step 3 of the fit was not finite", "the field stayed at 64³"])
    write_json(root / "fit_matched.json", {"views": 7, "pixels": 128, "share": 0.31, "bare": 0.12, "seconds": 0.4})
    network = {
        "key_frames": 4,
        "seconds": 0.3,
        "fusion_seconds": 0.2,
        "encode_seconds": 0.1,
        "first_preview_seconds": 0.2,
        "resolution": 48,
    }
    write_json(root / "network.json", network)
    held = {"before": 2.0, "after": 1.0, "unit": "%"}
    names = ("exposure", "vignetting", "distortion", "rolling_shutter", "background", "motion_blur", "poses")
    found = [
        {"effect": name, "number": 0.4, "threshold": 0.1, "there": index % 2 == 0, "reason": "shared points differ", "held_out": held,
         "wish": "auto", "on": index % 3 == 0, "note": ""}
        for index, name in enumerate(names)
    ]  # fmt: skip
    pose = np.eye(4)
    gain, weight = {"a": (1.1, 0.9, 1.0)}, {"b": 0.5}
    corrections = Corrections(gain, corner=0.8, dimmed=1.2, lens=(0.01, -0.001), poses={"a": pose}, weight=weight).to_dict()
    about = {"frames": 8, "points": 300}
    write_json(root / "effects.json", {"effects": found, "seconds": 1.0, "looked_at": about, "corrections": corrections})
    write_json(root / "run.json", {})  # so that it counts as the folder of a run


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

    wanted = {"iterations": 10.0, "voxel_size": 1.0, "views": 1.0, "samples": 4, "precision": "float16", "decoder": "deferred"}
    numbers = {"seconds_per_view": 0.2, "peak_memory_mb": 600.0, "memory_mb": 200.0, "disk_bytes": 2_000_000, "ssim": 0.7, "lpips": 0.3}
    rows = [
        {"id": f"field-{seconds}s", "method": "field", "axes": ["iterations", "views"],
         "setting": {**wanted, "iterations": seconds, "wanted": wanted},
         "wanted": wanted, "variant": None, "seed": 0, "stages": {"fit": seconds, "save": 0.1}, "load": [1.0, None], "seconds": seconds,
         "psnr": 20.0 + seconds, "error": None, "measured": "today", **numbers}
        for seconds in (1.0, 3.0, 10.0)
    ]  # fmt: skip
    rows.append({"method": "tsdf", "setting": {"voxel_size": 0.02, "wanted": {}}, "seed": 0, "error": "no depth", "id": "tsdf"})
    machine = {"system": "Linux", "cores": 2, "threads": 1, "device": "cpu", "load": 0.5, "measured": "today"}
    data = tradeoff_data({"rows": rows, "command": "fieldfuse tradeoff room", "unit": "m", "machine": machine})
    write_json(root / "tradeoff.json", data)
    (root / "tradeoff.csv").write_text(csv_text(data["rows"]), encoding="utf-8")
    write_json(root / "tradeoff" / "points" / "point.json", {"key": "abc", "crashed": False, "wall_seconds": 12.0, "rows": rows[:2]})
    scores = {
        "views": 2,
        "psnr": 23.5,
        "depth_scale": 1.5,
        "on": {"tsdf": {"psnr": 24.0, "ssim": 0.9, "lpips": None}},
        "abs_err": 0.1,
        "acc_1": 0.5,
    }
    geometry = {"accuracy": 0.01, "completeness": 0.02, "f_score_1": 0.7, "voxel_size": 0.02, "accuracy_median": None}
    compared = {
        "scores": {"field": scores, "tsdf": scores},
        "geometry": {"field": geometry, "tsdf": geometry},
        "seen_share": 0.8,
        "matching": None,
    }
    write_json(root / "compare" / "scores.json", compared)
    methods = [
        {"key": key, "title": key, "score": scores, "geometry": geometry, "stages": [{"stage": "fit", "seconds": 1.0}]} for key in "ab"
    ]
    facts = {"methods": methods, "truth": {"seen_share": 0.8}, "matching": None, "machine": machine, "command": "fieldfuse compare room"}
    write_json(root / "compare" / "compare.json", compare_data(facts))
    choice = {"image_size": 240, "fit_seconds": 12.5, "resolution": 256, "video_frames": 9, "effects": True}
    told = {"asked_seconds": 60, "predicted_seconds": 58.0, "real_seconds": 63.0, "stages": {"effects": {"real": 5.0}}, "choice": choice}
    report = {"source": "/data/lego", "budget": told, "evaluation": {"field": {"psnr": 27.25}}, "command": "fieldfuse run lego"}
    write_json(root / "report.json", report)
    suite = next(iter(SUITES.values()))
    row = {"scene": "lego", "variant": suite.variants[0].key, "width": 9, "height": 9, "train": 8, "test": 2, "psnr": 20.0, "ssim": 0.8,
           "lpips": 0.2, "fit_seconds": 1.0, "seconds": 2.0, "voxels": 10, "error": None}  # fmt: skip
    results = {"experiment": "suites", "suite": suite.name, "command": "python", "machine": machine, "rows": [row, row]}
    write_json(root / "results.json", results)
    few = [
        {"views": 3, "start": start, "budget": budget, "psnr": 20.0, "ssim": 0.5, "seconds": 1.0}
        for start, budget in (("direct", 0), ("network", 5))
    ]
    write_json(root / "few_views.json", {"experiment": "few_views", "command": "python", "machine": machine, "rows": few})


def read_measured(root: Path, number: int) -> None:
    """What the commands that go on from them, or show them, make of each; the worker judges the first that fails."""
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

    readers: tuple[Callable[[], Any], ...] = (
        lambda: sections([root / "tradeoff.json"], None, None),
        lambda: sections([root / "results.json"], None, None),
        lambda: sections([root / "compare" / "compare.json"], None, None),
        lambda: sections([root / "report.json"], None, None),
        lambda: tradeoff_data({"rows": rows_at(root / "tradeoff" / "points" / "point.json", "abc") or []}),
        lambda: sections([root / "few_views.json"], None, None),
        compared,
    )
    first: Exception | None = None
    for read in readers:
        try:
            read()
        except Exception as error:
            first = first or error
    if first is not None:
        raise first
