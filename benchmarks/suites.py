"""`python -m benchmarks.suites NAME DATA --out DIR`: a published protocol (see `protocols`) on your data, beside the paper's numbers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.experiment import MEASURES, Experiment, Row, application, markdown, program, section, show
from benchmarks.protocols import PAPER, SUITES, Suite, Variant, suite_of
from fieldfuse.capture.types import Views
from fieldfuse.config import settings_dict
from fieldfuse.effects.correct import Corrections
from fieldfuse.errors import FieldfuseError, Interrupted, OutputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.report import plain
from fieldfuse.evaluation.score import compare_views
from fieldfuse.pipelines.console import ConsoleProgress, make_progress
from fieldfuse.pipelines.direct_field import direct_field, weights_state
from fieldfuse.pipelines.fields import finished_field, render_test_views
from fieldfuse.pipelines.job import Job, open_job, read_settings
from fieldfuse.pipelines.options import Device, ImageSize, Out, Pairs, Place, Preset, Quiet, Seed, Threads, gather
from fieldfuse.pipelines.prepare import Prepared, choose_keyframes, find_camera_poses, find_capture, make_views, measure_scene
from fieldfuse.pipelines.rendered import Pictures, load_pictures, save_pictures, to_picture
from fieldfuse.pipelines.stages import Stage
from fieldfuse.poses.scene import Scene
from fieldfuse.render.image import render_view

COLUMNS = ("scene", "PSNR", "SSIM", "LPIPS", "training / test views", "pixels", "fit", "whole", "voxels")
SCORES = (*MEASURES, "abs_err", "acc_1", "acc_5", "seconds_per_view")


def suites(
    name: Annotated[str, typer.Argument(help=f"One of {', '.join(SUITES)}.", show_default=False)],
    data: Annotated[Path, typer.Argument(help="Folder with one subfolder a scene, or one scene.", show_default=False)],
    out: Out,
    scenes: Annotated[str | None, typer.Option(help="Names of scenes, separated by commas; default: all.", show_default=False)] = None,
    variants: Annotated[str | None, typer.Option(help="Keys of variants, separated by commas; default: all.", show_default=False)] = None,
    budget: Annotated[float | None, typer.Option(help="Seconds of optimisation of each scene.", show_default=False)] = None,
    image_size: ImageSize = None,
    preset: Preset = None,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Run a published protocol on your data and write a table with the paper's numbers: results.json and results.md. Finished stages are
    reused."""
    suite = suite_of(name)
    flags = {"budget": budget, "device": device, "threads": threads, "seed": seed}
    flags["image_size"] = suite.long_side if image_size is None else image_size
    options, progress = gather(preset, None, pairs, **flags), make_progress(quiet)
    settings = read_settings(options)
    keys = _names(variants)
    picked = suite.variants if keys is None else [suite.variant(key) for key in keys]
    sources = dict(suite.find(data, _names(scenes)))
    plan = [{"scene": scene, "variant": variant.key} for scene in sources for variant in picked]

    def run(entry: Row) -> Row:
        place = out / entry["scene"] / entry["variant"]
        try:
            return run_variant(suite.variant(entry["variant"]), sources[entry["scene"]], place, options, progress)
        except (Interrupted, OutputError):
            raise
        except FieldfuseError as error:  # one scene that cannot be placed does not keep the others from being measured
            return {"error": " ".join(str(error).split())}

    reported = {"source": PAPER, "values": {variant.key: variant.reported for variant in suite.variants if variant.reported}}
    about: Row = {"title": suite.title, "suite": suite.name, "protocol": suite.protocol, "differs": suite.differs}
    about |= {"reported_not_measured": reported, "settings": settings_dict(settings)}
    experiment = Experiment("suites", plan, run, table, about=about, file="results")
    show(section(experiment.conduct(out, progress, settings.threads, settings.device), table), quiet)


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


def run_variant(variant: Variant, source: Path, place: Path, options: dict[str, Any], progress: ConsoleProgress) -> Row:
    """One scene in one variant: a run's own stages on the frames that the protocol picks."""
    start = time.monotonic()
    with open_job(Place(source, place), options, progress) as job:
        capture = variant.pick(find_capture(job))
        poses = find_camera_poses(job, capture)
        posed = poses.apply(capture)
        scene = measure_scene(job, posed)
        views = make_views(job, posed, scene)
        if variant.fitted:
            ready = Prepared(capture, poses, posed, Corrections(), scene, views, choose_keyframes(job, scene, views))
            field = finished_field(job, ready).field
            voxels, renders = field.voxels, render_test_views(job, ready, field)
        else:
            renders = render_directly(job, views, scene)
            voxels = renders.facts["voxels"]
        indices = np.flatnonzero(views.test)
        score = compare_views({"it": renders.pictures}, views, indices, {"it": renders.seconds})["it"]
        made = job.stages.records["field" if variant.fitted else "direct"]
        row = plain(
            {
                **{key: score[key] for key in SCORES},
                "train": int(np.sum(~views.test)),
                "test": len(indices),
                "width": views.intrinsics[0].width,
                "height": views.intrinsics[0].height,
                "fit_seconds": made.seconds,
                "peak_memory_mb": made.peak_memory_mb,
                "seconds": round(time.monotonic() - start + job.stages.reused_seconds(), 3),
                "voxels": voxels,
                "stages": job.stages.summary(),
                "error": None,
            }
        )
        assert isinstance(row, dict)
        return row


def render_directly(job: Job, views: Views, scene: Scene) -> Pictures:
    """The stage `direct`: the networks' field, not fitted, at the test views."""
    path, settings = job.folder / "renders" / "direct.safetensors", job.settings

    def make() -> Pictures:
        made = direct_field(settings, views, scene, job.progress)
        renders = Pictures()
        for index in np.flatnonzero(views.test):
            job.progress.check()
            start = time.monotonic()
            render = to_picture(render_view(made.field, views.intrinsics[index], views.world_from_camera[index]))
            renders.add(views.names[index], render, time.monotonic() - start)
        renders.facts = {"voxels": made.field.voxels, "key_frames": made.key_frames}
        return renders

    def save(renders: Pictures) -> list[Path]:
        save_pictures(path, renders)
        return [path]

    uses = [asdict(settings.network), asdict(settings.keyframes), weights_state(settings), settings.field.background, settings.device]
    return job.run(Stage("direct", make, save, lambda: load_pictures(path), ["scene", "views"], uses))


def table(data: Row) -> str:
    """Markdown: the protocol, and a table for each variant."""
    suite = suite_of(data["suite"])
    lines = [f"Protocol: {suite.protocol}.{f' Not as in the paper: {suite.differs}.' if suite.differs else ''}", ""]
    for variant in suite.variants:
        rows = [row for row in data["rows"] if row["variant"] == variant.key]
        if rows:
            lines += [f"**{variant.title[:1].upper()}{variant.title[1:]}**", "", variant_table(suite, variant, rows)]
    return "\n".join(lines)


def variant_table(suite: Suite, variant: Variant, rows: Sequence[Row]) -> str:
    """A row a scene, their mean when there are several, and what the paper reports."""
    lines: list[list[str]] = []
    empty = [""] * (len(COLUMNS) - 1 - len(MEASURES))
    made = [row for row in rows if not row.get("error")]
    for row in rows:
        if row.get("error"):
            lines.append([row["scene"], f"not made: {row['error']}", *[""] * (len(COLUMNS) - 2)])
            continue
        facts = [f"{row['train']} / {row['test']}", f"{row['width']}×{row['height']}"]
        facts += [*(words.duration(row[key]) for key in ("fit_seconds", "seconds")), words.whole(row["voxels"])]
        lines.append([row["scene"], *_scores(row), *facts])
    if len(made) > 1:
        lines.append([f"mean of {len(made)}", *_scores({key: _mean(made, key) for key in MEASURES}), *empty])
    if variant.reported:
        whose = f"{PAPER}, mean of {len(suite.scenes) or 'all its scenes'}: reported, not measured"
        cells = [text if text == words.NONE else f"*{text}*" for text in _scores(variant.reported)]
        lines.append([f"*{whose}*", *cells, *empty])
    return markdown(COLUMNS, lines)


def _scores(row: dict[str, Any]) -> list[str]:
    return [words.decimal(row.get(key), digits) for key, digits in MEASURES.items()]


def _mean(rows: Sequence[Row], key: str) -> float | None:
    """Over the scenes that have it."""
    values = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(values)) if values else None


app = application(suites)
if __name__ == "__main__":
    program(app)
