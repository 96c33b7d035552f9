"""`fieldfuse bench SUITE DATA --out DIR`: a published protocol on data that the user brings; and its tables put into a page."""

from __future__ import annotations

import json as writer
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse.pipelines.options import Device, ImageSize, Json, Out, Pairs, Preset, Quiet, Seed, Threads, gather

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.evaluation.suites.base import Suite, Variant
    from fieldfuse.pipelines.job import Job
    from fieldfuse.pipelines.rendered import Pictures
    from fieldfuse.poses.scene import Scene

HELP = {
    "nerf-synthetic": "NeRF-synthetic with the splits of its Blender files.",
    "dtu": "DTU: 3 views direct and fitted, 16 views fitted, 4 test views.",
    "scannet": "ScanNet: the eight scenes of NerfingMVS.",
    "llff": "LLFF: every eighth picture held out.",
    "posed": "Any posed captures: their own split, else every eighth picture held out.",
}
RESULTS = "results"
SUFFIXES = (".json", ".md")

Data = Annotated[Path, typer.Argument(help="Folder with one subfolder a scene, or one scene.", show_default=False)]
Scenes = Annotated[str | None, typer.Option(help="Names of scenes, separated by commas; default: all that are there.", show_default=False)]
Variants = Annotated[str | None, typer.Option(help="Keys of variants, separated by commas; default: all.", show_default=False)]
FitBudget = Annotated[float | None, typer.Option("--budget", help="Seconds of optimisation of each scene.", show_default=False)]


def add_suites(app: typer.Typer) -> None:
    """One command a suite, and `table`."""
    from fieldfuse.pipelines.bench_table import table

    for name, text in HELP.items():
        app.command(name, help=text)(_command(name))
    app.command("table")(table)


def _command(name: str) -> Any:
    def command(
        data: Data,
        out: Out,
        scenes: Scenes = None,
        variants: Variants = None,
        budget: FitBudget = None,
        image_size: ImageSize = None,
        preset: Preset = None,
        device: Device = None,
        threads: Threads = None,
        seed: Seed = None,
        pairs: Pairs = None,
        quiet: Quiet = False,
        json: Json = False,
    ) -> None:
        from fieldfuse.pipelines.thread_limits import bound_threads

        flags = {"budget": budget, "image_size": image_size, "device": device, "threads": threads, "seed": seed}
        options = gather(preset, None, pairs, **flags)
        bound_threads(options)
        from fieldfuse.pipelines.console import make_progress

        found = bench_suite(name, data, out, options, _names(scenes), _names(variants), make_progress(quiet))
        if json:
            sys.stdout.write(writer.dumps(found, indent=1) + "\n")
        elif not quiet:
            sys.stdout.write((out / f"{RESULTS}.md").read_text(encoding="utf-8"))

    return command


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


def bench_suite(
    name: str, data: Path, out: Path, options: dict[str, Any], scenes: list[str] | None, variants: list[str] | None, progress: Any
) -> dict[str, Any]:
    """Run the protocol, write `results.json` and `results.md` into `out` after every scene; answers the former.

    Raises:
        InputError: no such scene or variant.
    """
    from fieldfuse.errors import FieldfuseError, Interrupted, OutputError
    from fieldfuse.evaluation.suites import suite_of

    suite = suite_of(name)
    if options["flags"].get("image_size") is None:
        options["flags"]["image_size"] = suite.long_side
    chosen = [suite.variant(key) for key in variants] if variants is not None else list(suite.variants)
    rows: list[dict[str, Any]] = []
    for scene, source in suite.find(data, scenes):
        for variant in chosen:
            place = out / scene / variant.key
            progress.say(f"{scene}, {variant.title}")
            try:
                row = run_variant(suite, variant, source, place, options, progress)
            except (Interrupted, OutputError):
                raise
            except FieldfuseError as error:  # one scene that cannot be placed does not keep the others from being measured
                row = {"error": " ".join(str(error).split())}
            rows.append({"scene": scene, "variant": variant.key, "error": None, **row})
            found = put(suite, rows, out, options)
    return found


def run_variant(suite: Suite, variant: Variant, source: Path, place: Path, options: dict[str, Any], progress: Any) -> dict[str, Any]:
    """One scene in one variant: a run's own stages on the frames that the protocol picks."""
    import numpy as np

    from fieldfuse.evaluation.compare_score import compare_views
    from fieldfuse.evaluation.report import plain
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.steps_capture import find_camera_poses, find_capture, make_views, measure_scene
    from fieldfuse.pipelines.steps_results import fit_radiance_field, render_test_views

    start = time.monotonic()
    with open_job(source, place, options, progress) as job:
        capture = variant.pick(find_capture(job))
        poses = find_camera_poses(job, capture)
        posed = poses.apply(capture)
        scene = measure_scene(job, posed)
        views = make_views(job, posed, scene)
        if variant.fitted:
            field, _ = fit_radiance_field(job, views, scene)
            voxels, pictures = field.voxels, render_test_views(job, field, views, scene)
        else:
            pictures = render_directly(job, views, scene)
            voxels = pictures.facts["voxels"]
        indices = np.flatnonzero(views.test)
        score = compare_views({"it": pictures.pictures}, views, indices, {"it": pictures.seconds})["it"]
        made = job.stages.records["field" if variant.fitted else "direct"]
        found = {
            **{key: score[key] for key in ("psnr", "ssim", "lpips", "abs_err", "acc_1", "acc_5", "seconds_per_view")},
            "train": int(np.sum(~views.test)),
            "test": int(np.sum(views.test)),
            "width": views.intrinsics[0].width,
            "height": views.intrinsics[0].height,
            "fit_seconds": made.seconds,
            "peak_memory_mb": made.peak_memory_mb,
            "seconds": round(time.monotonic() - start + job.stages.fresh_seconds(), 3),
            "voxels": voxels,
            "stages": job.stages.summary(),
        }
        out = plain(found)
        assert isinstance(out, dict)
        return out


def render_directly(job: Job, views: Views, scene: Scene) -> Pictures:
    """The stage `direct`: the networks' field, not fitted, at the test views."""
    from fieldfuse.pipelines.direct_field import direct_field, weights_state
    from fieldfuse.pipelines.rendered import Pictures, load_pictures, save_pictures, to_picture
    from fieldfuse.render.image import render_view

    kept, settings = job.folder / "renders" / "direct.safetensors", job.settings

    def make() -> Pictures:
        import numpy as np

        made = direct_field(settings, views, scene, job.progress)
        pictures = Pictures()
        for index in np.flatnonzero(views.test):
            job.progress.check()
            start = time.monotonic()
            picture = to_picture(render_view(made.field, views.intrinsics[index], views.world_from_camera[index]))
            pictures.add(views.names[index], picture, time.monotonic() - start)
        pictures.facts = {"voxels": made.field.voxels, "key_frames": made.key_frames}
        return pictures

    def save(pictures: Pictures) -> list[Path]:
        save_pictures(kept, pictures)
        return [kept]

    uses = [asdict(settings.network), asdict(settings.keyframes), weights_state(settings), settings.field.background, settings.device]
    return job.stages.run("direct", make, save, lambda: load_pictures(kept), uses=uses, after=["scene", "views"])


def put(suite: Suite, rows: list[dict[str, Any]], out: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Write what there is so far."""
    from fieldfuse import __version__
    from fieldfuse.config import settings_dict
    from fieldfuse.evaluation.suites.base import PAPER
    from fieldfuse.evaluation.suites.tables import suite_table
    from fieldfuse.files import atomic_path, write_json
    from fieldfuse.pipelines.folder import command_line
    from fieldfuse.pipelines.job import read_settings

    settings = read_settings(options)
    reported = {variant.key: variant.reported for variant in suite.variants if variant.reported}
    data = {
        "suite": suite.name,
        "version": __version__,
        "command": command_line(),
        "protocol": suite.protocol,
        "differs": suite.differs,
        "reported_not_measured": {"source": PAPER, "values": reported},
        "rows": rows,
        "settings": settings_dict(settings),
        "machine": _machine(settings),
    }
    write_json(out / f"{RESULTS}.json", data)
    with atomic_path(out / f"{RESULTS}.md") as temporary:
        temporary.write_text(suite_table(suite, data), encoding="utf-8")
    return data


def _machine(settings: Any) -> dict[str, Any]:
    import os

    from fieldfuse.evaluation.speed import machine

    about = machine(settings.threads or os.cpu_count() or 1)
    return {**about, "device": settings.device, "measured": time.strftime("%Y-%m-%d %H:%M")}
