"""The second half of a run: TSDF surface, radiance field, pictures of the held-out views, exports, scores."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.files import write_json
from fieldfuse.memory_limits import require_pictures, require_scores
from fieldfuse.pipelines.fit_files import FIT_MATCHED, FIT_NOTES, LEFT_OUT
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.kept import EVALUATION, MATCHED, TIMELINE, read_export_facts, read_kept
from fieldfuse.pipelines.rendered import Pictures, depth_steps, load_pictures, save_pictures, to_picture, write_pngs
from fieldfuse.pipelines.source_state import pixel_state
from fieldfuse.pipelines.steps_capture import last_of
from fieldfuse.steps import set_seeds

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.config import FitSettings
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.stereo.transients import LeftOut
    from fieldfuse.training.fit import FitResult


def wants_tsdf(job: Job, capture: Capture) -> bool:
    """Whether this run makes the TSDF surface: when the capture has depth or it is asked for; then pictures alone are matched for depth."""
    wanted = job.settings.tsdf.enabled
    return wanted == "on" or (wanted == "auto" and capture.has_depth)


def fuse_tsdf(job: Job, posed: Capture, scene: Scene, views: Views, name: str = "tsdf", depth_from: str | None = None) -> Pictures:
    """Fuse the training frames' depth into a surface; its pictures at the held-out views are the result.

    Args:
        name: of the stage, its folder and its pictures.
        depth_from: "sensor", "matching" (pictures with each other) or "exact" (the truth that a simulated capture brings); None: the
            sensor's when the capture has depth, else by matching.
    """
    from fieldfuse.pipelines.steps_stereo import exact_depths, match_pictures

    folder = job.folder / name
    kept = job.folder / "renders" / f"{name}.safetensors"
    made: list[Path] = []
    depth_from = depth_from or ("sensor" if posed.has_depth else "matching")
    matched = match_pictures(job, scene, views) if depth_from == "matching" else None

    def make() -> Pictures:
        from fieldfuse.pipelines.surface import fuse_training_frames

        depths = exact_depths(posed, scene, views) if depth_from == "exact" else matched
        pictures, paths = fuse_training_frames(job, folder, posed, scene, views, depths, depth_from == "exact")
        pictures.facts["depth_from"] = depth_from
        made.extend(paths)
        return pictures

    def save(pictures: Pictures) -> list[Path]:
        save_pictures(kept, pictures)
        return [kept, *made, *write_pngs(kept.parent, name, pictures, views.exposure, depth_steps(scene))]

    return job.stages.run(
        name,
        make=make,
        save=save,
        load=lambda: load_pictures(kept),
        uses=[asdict(job.settings.tsdf), pixel_state(posed), depth_from, job.settings.export.smooth],
        version=3,
        after=["scene", "views", *(["stereo"] if matched is not None else [])],
    )


GONE = "of an earlier field, and removed: {}; `fieldfuse export {} --formats …` makes of this one what the run is not asked for"
NO_MATCHING = {"auto": "sensor", "any": "any", "sensor": "sensor"}  # `fit.depth_from` of a fit that goes on
GENTLE, GENTLEST = 30.0, 0.3  # seconds from which on it begins with steps as large as any fit's, and the least share of them
Fitted = tuple["Field", list[dict[str, Any]]]


def fit_radiance_field(job: Job, views: Views, scene: Scene, go_on: bool = False) -> Fitted:
    """Optimise the field on the training views; held-out views only measure the timeline.

    The start is classical, or the networks' field, which is the result itself without fine-tuning. With `go_on` the field that the folder
    has is the start, and the budget is for what is added.
    """
    from fieldfuse.pipelines.steps_network import direct_result, make_network_field, uses_network
    from fieldfuse.pipelines.steps_stereo import views_for_fit
    from fieldfuse.render.field import Field
    from fieldfuse.stereo.transients import load_left_out, save_left_out
    from fieldfuse.training.guided import fit_guided
    from fieldfuse.training.network_start import network_start
    from fieldfuse.volume.grid_host import host_for

    settings = job.settings
    path, times = job.folder / "field.safetensors", job.folder / "timeline.json"
    told: dict[str, Any] = {}  # file → what it is to hold
    found: list[LeftOut] = []
    made = make_network_field(job, views, scene) if uses_network(job, views) else None
    views, known = views_for_fit(job, scene, views)
    start = job.stages.record("field") if go_on and job.stages.usable("field") and not job.other_field else None

    def tell(result: FitResult) -> None:
        told.update({FIT_NOTES: result.notes} if result.notes else {})
        told.update({FIT_MATCHED: result.matched} if result.matched else {})
        found.extend([] if result.left_out is None else [result.left_out])

    def load() -> Fitted:
        return Field.load(path).to(settings.device), read_kept(times, TIMELINE)

    def make() -> Fitted:
        set_seeds(settings.seed)
        if start is None and made is not None and not settings.fit.finetune:
            return direct_result(job, made, views, scene), []
        if start is None:
            first = None if made is None else network_start(made.field, views, scene, settings)
            coarse = first is not None
            result = fit_guided(views, scene, settings, job.progress, host=host_for(settings.device), start=first, coarse=coarse)
            tell(result)
            return result.field, result.timeline
        field, timeline = load()
        # It knows where its surfaces are, and what moves was found: to match the pictures again takes a third of a short fit for nothing.
        masks = load_left_out(job.folder / LEFT_OUT) if LEFT_OUT in start.outputs else None
        alone = replace(settings, fit=going_on(settings.fit))
        shown = views if masks is None else masks.without(views)
        result = fit_guided(shown, scene, alone, job.progress, host=host_for(settings.device), start=field)
        matched = read_kept(job.folder / FIT_MATCHED, MATCHED) if FIT_MATCHED in start.outputs else None
        tell(replace(result, matched=matched, left_out=masks))
        spent = timeline[-1]["seconds"] if timeline else 0.0
        return result.field, timeline + result.after(spent)

    def save(value: Fitted) -> list[Path]:
        field, timeline = value
        field.save(path, scene.working_from_input, {"budget": settings.fit.budget, "seed": settings.seed})
        write_json(times, timeline)
        for name, content in told.items():
            write_json(job.folder / name, content)
        for left_out in found:
            save_left_out(job.folder / LEFT_OUT, left_out)
        return [path, times, *(job.folder / name for name in [*told, *([LEFT_OUT] if found else [])])]

    uses = [
        asdict(settings.field),
        asdict(settings.fit),
        settings.preset,
        settings.engine,
        settings.device,
        settings.seed,
        start and start.made,
    ]
    after = ["scene", "views", *known, *(["network"] if made is not None else [])]
    value = job.stages.run("field", make, save, load, uses=uses, after=after, keeps=True)
    if job.stages.cached["field"]:
        return value
    del value  # the file holds less precision than memory: what is shown and scored is what everybody can load
    return load()


def going_on(fit: FitSettings) -> FitSettings:
    """Settings of a fit that goes on from a fitted field: nothing is matched or looked for again, and a short one takes smaller steps, as
    large ones undo more of what is there than it has time to mend."""
    share = min(1.0, max(GENTLEST, (fit.budget or GENTLE) / GENTLE))
    rates = {name: share * getattr(fit, name) for name in ("rate_density", "rate_feature", "rate_decoder")}
    return replace(fit, depth_from=NO_MATCHING.get(fit.depth_from, "off"), moving="off", **rates)


def render_test_views(job: Job, field: Field, views: Views, scene: Scene) -> Pictures:
    """The field's pictures at the held-out views."""
    from fieldfuse.evaluation.score import training_psnr
    from fieldfuse.render.image import make_renderer, render_view

    kept = job.folder / "renders" / "field.safetensors"

    def make() -> Pictures:
        pictures = Pictures()
        view = make_renderer(field, job.settings.engine)
        indices = np.flatnonzero(views.test)
        require_pictures([views.intrinsics[index] for index in indices], kept=True, advice="run again with a lower --image-size")
        for count, index in enumerate(indices):
            job.progress.update(count, len(indices), views.names[index])
            job.progress.check()
            start = time.monotonic()
            picture = to_picture(render_view(field, views.intrinsics[index], views.world_from_camera[index], view))
            pictures.add(views.names[index], picture, time.monotonic() - start)
        if len(indices):
            pictures.facts = {"training_psnr": training_psnr(lambda camera, pose: render_view(field, camera, pose, view).rgb, views)}
        return pictures

    def save(pictures: Pictures) -> list[Path]:
        save_pictures(kept, pictures)
        return [kept, *write_pngs(kept.parent, "field", pictures, views.exposure, depth_steps(scene))]

    return job.stages.run("render", make=make, save=save, load=lambda: load_pictures(kept), after=["field", "views"], version=4)


def export_results(job: Job, field: Field, poses: PoseResult, posed: Capture, scene: Scene, views: Views) -> dict[str, Any]:
    """Points, meshes, cameras, the page and video, in the input's own frame; answers the mesh's facts. Files of the same field that were
    made before, in other formats, stay.

    Raises:
        InputError: nothing else was asked for, and none of it could be made.
    """
    facts_path = job.folder / "exports" / "facts.json"
    made: list[Path] = []
    old, whole = job.stages.record("export"), True

    def make() -> dict[str, Any]:
        from fieldfuse.pipelines.surface import export_field

        nonlocal whole
        fits = job.stages.usable("export")
        before = read_export_facts(facts_path) if fits else None
        exported = export_field(job, job.folder / "exports", field, poses, posed, scene, views)
        facts, whole = exported.facts, exported.whole
        if job.alone and not exported.made:
            raise InputError(f"nothing was exported: {'; '.join(facts['notes'])}")
        made.extend(exported.files)
        if before is not None and facts["mesh"] is None:
            facts["mesh"] = before["mesh"]
        if old is not None and not fits:
            kept = {path.relative_to(job.folder.path).as_posix() for path in made}
            gone = sorted({Path(path).name for path in set(old.outputs) - kept if path.startswith("exports/")} - {facts_path.name})
            facts["notes"] += [GONE.format(", ".join(gone), job.folder.path)] if gone else []
        return facts

    def save(facts: dict[str, Any]) -> list[Path]:
        write_json(facts_path, facts)
        return [facts_path, *made]

    return job.stages.run(
        "export",
        make=make,
        save=save,
        load=lambda: read_export_facts(facts_path),
        uses=asdict(job.settings.export),
        adds=True,
        part=job.formats is not None,
        whole=lambda: whole,
        version=3,
        after=["field", "poses", "scene", "views"],
    )


def score_pictures(job: Job, views: Views, pictures: dict[str, Pictures]) -> dict[str, Any]:
    """The same metrics for field and TSDF, beside those of the nearest training picture."""
    from fieldfuse.evaluation.score import nearest_image_scores, score_views, seen_share

    path = job.folder / "evaluation.json"

    def make() -> dict[str, Any]:
        indices = np.flatnonzero(views.test)
        require_scores(views, len(pictures))
        out: dict[str, Any] = {}
        for count, (what, shown) in enumerate(pictures.items()):
            job.progress.update(count, len(pictures), what)
            out[what] = {**score_views(shown.pictures, views, indices, shown.seconds), **shown.facts}
        if "field" in pictures:
            for view, picture in zip(out["field"]["per_view"], pictures["field"].pictures, strict=True):
                view["seen"] = seen_share(picture.depth, views, view["index"])
        out["nearest_image"] = nearest_image_scores(views, indices)
        return out

    def save(scores: dict[str, Any]) -> list[Path]:
        write_json(path, scores)
        return [path]

    return job.stages.run(
        "evaluate",
        make=make,
        save=save,
        load=lambda: read_kept(path, EVALUATION),
        uses=sorted(pictures),
        version=2,
        after=["views", *last_of(job, "tsdf", "render", "direct")],
    )
