"""Radiance fields: the networks' (direct inference), fused key frame by key frame, and the one that is fitted per scene; their renders."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import steps
from fieldfuse.config import FitSettings
from fieldfuse.errors import InputError
from fieldfuse.evaluation.pictures import depth_picture, depth_range
from fieldfuse.evaluation.score import nearest_image_scores, score_views, seen_share, training_psnr
from fieldfuse.files import fingerprint, write_json
from fieldfuse.memory import require_scores
from fieldfuse.pipelines.cells import fit_in_cells
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.prepare import Prepared
from fieldfuse.pipelines.rendered import Pictures, to_picture, write_png
from fieldfuse.pipelines.schemas import EVALUATION, NOTES, TIMELINE, Matched, Network, read_checked
from fieldfuse.pipelines.stages import EndlessStage, Stage, StoredStage
from fieldfuse.pipelines.surfaces import pictures_stage, render_views, views_for_fit
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.stereo.transients import LeftOut, load_left_out, save_left_out
from fieldfuse.tone import exposed
from fieldfuse.training.cells.scene import cell_count
from fieldfuse.training.finer_colours import finer_colours
from fieldfuse.training.fit import Begin, FitResult
from fieldfuse.training.from_network import Inference
from fieldfuse.training.guided import fit_guided
from fieldfuse.training.network_start import network_start

PREVIEW = "preview.png"
DIRECT = "direct.safetensors"  # the finished field of direct inference where another one is the result
PREVIEW_SIDE = 160  # pixels of the preview's images
FIRST_PREVIEW = 3  # key frames after which there is one; with fewer in all, after the last
# What a fit leaves beside its field, where there is something.
FIT_NOTES = "fit_notes.json"  # what a reader of the numbers has to be aware of
FIT_MATCHED = "fit_matched.json"  # what the fit's quick matching found
LEFT_OUT = "left_out.safetensors"  # pixels that were masked out, since they show what moves
DEPTH_GOING_ON = {"auto": "sensor", "any": "any", "sensor": "sensor"}  # `fit.depth_from` of a fit that goes on: nothing is matched
GENTLE, GENTLEST = 30.0, 0.3  # seconds from which on it begins with steps as large as any fit's, and the least share of them


@dataclass
class NetworkField:
    """The networks' field and how it came to be (plain data)."""

    field: Field
    facts: dict[str, Any]


@dataclass
class Fitted:
    """The field of a run.

    Attributes:
        timeline: seconds and validation PSNR while it was fitted; empty of direct inference.
        notes: what a reader of the numbers has to be aware of.
        matched: what the fit's quick matching found: images, long side, share of pixels with depth, seconds; None: nothing was matched.
        left_out: pixels that were masked out, since they show what moves; None: they were not looked for.
    """

    field: Field
    timeline: list[dict[str, Any]]
    notes: Sequence[str] = ()
    matched: dict[str, Any] | None = None
    left_out: LeftOut | None = None

    @classmethod
    def of(cls, result: FitResult) -> Fitted:
        return cls(result.field, result.timeline, result.notes, result.matched, result.left_out)


def uses_network(job: Job, ready: Prepared, planned: bool = False) -> bool:
    """Whether this run starts from the networks (or ends with them). Where the seconds of the whole run are `planned`, a fit does so only
    by its settings: the networks' are not among them.

    Raises:
        InputError: the settings contradict each other.
    """
    settings = job.settings
    if settings.field.init == "classical" and not settings.fit.finetune:
        raise InputError("without fine-tuning the networks' field is the result, so init cannot be 'classical'; drop one of the two")
    if settings.field.init != "auto":
        return settings.field.init == "network"
    field = job.stages.record("field") if job.again else None
    if field is not None and ("network" in field.after or "field" not in job.changed):
        return "network" in field.after  # as what the folder has, be it --no-finetune or fitted from there
    if planned and settings.fit.finetune:
        return False
    return not settings.fit.finetune or steps.starts_from_networks(ready.views, settings)


def starting_field(job: Job, ready: Prepared) -> NetworkField | None:
    """What the networks give, where the run starts from it or ends with it."""
    return make_network_field(job, ready) if uses_network(job, ready) else None


def make_network_field(job: Job, ready: Prepared) -> NetworkField:
    """The stage `network`: direct inference, with a preview that is renewed as key frames come in."""
    settings, views, scene = job.settings, ready.views, ready.scene
    path, about = job.folder / "network.safetensors", job.folder / "network.json"
    weights = steps.require_weights(settings)

    def make() -> NetworkField:
        steps.set_seeds(settings.seed)
        start = time.monotonic()
        inference = steps.direct_inference(views, scene, ready.keys, settings)
        first = _stream(job, inference, start)
        field = inference.field()
        facts = {
            "key_frames": inference.done,
            "seconds": round(inference.seconds, 3),
            "fusion_seconds": round(inference.fusion_seconds, 3),  # of these, without making fields for previews
            "encode_seconds": round(inference.encode_seconds, 3),
            "first_preview_seconds": first,
            "resolution": inference.lattice.resolution,
        }
        return NetworkField(field, facts)

    def save(value: NetworkField) -> list[Path]:
        value.field.save(path, scene.working_from_input, value.facts)
        write_json(about, value.facts)
        return [path, about, job.folder / PREVIEW]

    return job.run(
        StoredStage(
            "network",
            make=make,
            save=save,
            load=lambda: NetworkField(Field.load(path).to(settings.device), read_checked(about, Network)),
            inputs=["scene", "views", "keyframes"],
            settings=[asdict(settings.network), fingerprint(weights), settings.field.background, settings.device, settings.seed],
        )
    )


def _stream(job: Job, inference: Inference, start: float) -> float:
    """Fuse all key frames, the preview renewed after each; answers the seconds from the third key frame to the first preview."""
    path, total = job.folder / PREVIEW, len(inference.keys.indices)
    first: float | None = None
    for frame in inference.frames(job.progress):
        if inference.done < min(FIRST_PREVIEW, total):
            continue
        begin = time.monotonic()
        write_png(path, preview(inference, frame))
        if first is None:
            first = round(time.monotonic() - begin, 3)
            when = f"{inference.done} key frames, {begin - start + first:.1f} s"
            job.progress.say(f"network: {path} shows what {when} have given; it is renewed at each key frame")
    assert first is not None
    return first


def preview(inference: Inference, frame: int) -> Any:
    """(H, 3 · W, 3) uint8: the newest key frame's photo, the field of all key frames so far from there, and its depth."""
    import cv2

    camera, photo = inference.train.intrinsics[frame], inference.train.images[frame]
    shrink = min(1.0, PREVIEW_SIDE / max(camera.width, camera.height))
    camera = camera.scaled(max(1, round(shrink * camera.width)), max(1, round(shrink * camera.height)))
    field = inference.field(finished=False)
    # The compiled renderer is faster, but the first preview must not wait for a compiler.
    shown = to_picture(render_view(field, camera, inference.train.world_from_camera[frame], make_renderer(field, "torch")))
    small = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    seen = exposed(np.concatenate([small, shown.rgb], axis=1), inference.train.exposure)
    return np.concatenate([seen, depth_picture(shown.depth, depth_range([shown.depth]))], axis=1)


def direct_result(job: Job, ready: Prepared, network: NetworkField) -> Field:
    """What direct inference gives, made of the stage `network`: colours are looked up again if the settings have it so."""
    if not job.settings.network.recolour:
        return network.field
    return finer_colours(network.field, ready.views, ready.scene.median_depth, job.progress, job.settings.engine)


def fit_radiance_field(job: Job, ready: Prepared, network: NetworkField | None, go_on: bool = False) -> Fitted:
    """Optimise the field on the training views; held-out views only measure the timeline.

    Args:
        network: the start of the fit, and the result itself without fine-tuning; None: the start is classical.
        go_on: the field that the folder has is the start, and the budget is for what is added.
    """
    from fieldfuse.volume.grid import host_for

    settings, scene, folder = job.settings, ready.scene, job.folder
    path, times = folder / "field.safetensors", folder / "timeline.json"
    views, depth_stages = views_for_fit(job, ready)
    ready = replace(ready, views=views)
    start = job.stages.record("field") if go_on and job.stages.usable("field") and "field" not in job.changed else None

    def load() -> Fitted:
        record = job.stages.record("field")
        there = () if record is None else record.outputs
        return Fitted(
            Field.load(path).to(settings.device),
            read_checked(times, TIMELINE),
            read_checked(folder / FIT_NOTES, NOTES) if FIT_NOTES in there else (),
            read_checked(folder / FIT_MATCHED, Matched) if FIT_MATCHED in there else None,
            load_left_out(folder / LEFT_OUT) if LEFT_OUT in there else None,
        )

    def make() -> Fitted:
        steps.set_seeds(settings.seed)
        fit, host = partial(fit_guided, scene=scene, progress=job.progress), host_for(settings.device)
        if start is not None:
            # It has its surfaces, and what moves was found: to match the images again takes a third of a short fit for nothing.
            before = load()
            shown = views if before.left_out is None else before.left_out.without(views)
            result = fit(shown, settings=replace(settings, fit=going_on(settings.fit)), begin=Begin(host, before.field))
            spent = before.timeline[-1]["seconds"] if before.timeline else 0.0
            return replace(before, field=result.field, timeline=before.timeline + result.after(spent), notes=result.notes)
        if network is not None and not settings.fit.finetune:
            return Fitted(direct_result(job, ready, network), [])
        first = None if network is None else network_start(network.field, views, scene, settings)
        begin = Begin(host, first, coarse=first is not None)
        if cell_count(views, settings) > 1:
            return Fitted.of(fit_in_cells(job, views, scene, begin))
        result = fit(views, settings=settings, begin=begin)
        if settings.fit.cells == "auto":
            result.notes.append("the scene is small enough to be fitted in one piece, so it was not cut into cells")
        return Fitted.of(result)

    def save(value: Fitted) -> list[Path]:
        value.field.save(path, scene.working_from_input, {"budget": settings.fit.budget, "seed": settings.seed})
        write_json(times, value.timeline)
        written = [path, times]
        for name, content in ((FIT_NOTES, value.notes), (FIT_MATCHED, value.matched)):
            if content:
                write_json(folder / name, content)
                written.append(folder / name)
        if value.left_out is not None:
            save_left_out(folder / LEFT_OUT, value.left_out)
            written.append(folder / LEFT_OUT)
        return written

    fitting = [asdict(settings.field), asdict(settings.fit), settings.preset, settings.engine, settings.device, settings.seed]
    return job.run(
        EndlessStage(
            "field",
            make=make,
            save=save,
            load=load,
            inputs=["scene", "views", *depth_stages, *(["network"] if network is not None else [])],
            settings=[*fitting, start and start.made],
        )
    )


def going_on(fit: FitSettings) -> FitSettings:
    """Settings of a fit that goes on from a fitted field: nothing is matched or looked for again, and a short one takes smaller steps, as
    large ones undo more of what is there than it has time to mend."""
    share = min(1.0, max(GENTLEST, (fit.budget or GENTLE) / GENTLE))
    rates = {name: share * getattr(fit, name) for name in ("rate_density", "rate_feature", "rate_decoder")}
    return replace(fit, depth_from=DEPTH_GOING_ON.get(fit.depth_from, "off"), moving="off", **rates)


def finished_field(job: Job, ready: Prepared) -> Fitted:
    """The field of a run's folder as it is; of a source, it is fitted first."""
    return fit_radiance_field(job, ready, starting_field(job, ready))


def render_test_views(job: Job, ready: Prepared, field: Field) -> Pictures:
    """The field's renders at the held-out views."""
    views = ready.views

    def make() -> Pictures:
        render = partial(render_view, field, view=make_renderer(field, job.settings.engine))
        pictures = render_views(job, views, render)
        if views.test.any():
            pictures.facts = {"training_psnr": training_psnr(lambda camera, pose: render(camera, pose).rgb, views)}
        return pictures

    return job.run(pictures_stage(job, ready, Stage("render", make, lambda _: [], Pictures, ["field", "views"], version=4), "field"))


def render_network_views(job: Job, ready: Prepared, network: NetworkField, keep: bool = False) -> Pictures:
    """What direct inference gives at the held-out views, before anything was fitted; `keep`: its field becomes the file `DIRECT`."""
    def make() -> Pictures:
        begin = time.monotonic()
        field = direct_result(job, ready, network)
        seconds = round(network.facts["seconds"] + time.monotonic() - begin, 3)
        facts = {**network.facts, "seconds": seconds, "bytes": field.bytes}
        if keep:
            field.save(job.folder / DIRECT, ready.scene.working_from_input, facts)
        pictures = render_views(job, ready.views, partial(render_view, field, view=make_renderer(field, job.settings.engine)))
        return replace(pictures, facts=facts)

    stage = Stage(
        "direct",
        make=make,
        save=lambda _: [job.folder / DIRECT] if keep else [],
        load=Pictures,
        inputs=["network", "views", "scene"],
        settings=[job.settings.engine, keep],
        version=3,
    )
    return job.run(pictures_stage(job, ready, stage, "network"))


def score_pictures(job: Job, ready: Prepared, pictures: dict[str, Pictures]) -> dict[str, Any]:
    """The same metrics for field and TSDF, beside those of the nearest training image."""
    path, views = job.folder / "evaluation.json", ready.views

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

    return job.run(
        Stage(
            "evaluate",
            make=make,
            save=save,
            load=partial(read_checked, path, EVALUATION),
            inputs=["views", *job.stages.done("tsdf", "render", "direct", "splats_render")],
            settings=sorted(pictures),
            version=2,
        )
    )
