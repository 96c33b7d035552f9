"""The networks' field (direct inference): fused key frame by key frame, with a picture of it that is renewed as key frames come in."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.files import fingerprint, write_json
from fieldfuse.memory_limits import require_pictures
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.kept import NETWORK, read_kept
from fieldfuse.pipelines.rendered import Pictures, depth_steps, load_pictures, save_pictures, to_picture, write_png, write_pngs
from fieldfuse.pipelines.steps_capture import choose_keyframes
from fieldfuse.steps import direct_inference, require_weights, set_seeds, starts_from_networks
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.training.from_network import Inference

PREVIEW = "preview.png"
DIRECT = "direct.safetensors"  # the finished field of direct inference where another one is the result
PREVIEW_SIDE = 160  # pixels of the preview's pictures
FIRST_PREVIEW = 3  # key frames after which there is one; with fewer in all, after the last


@dataclass
class NetworkField:
    """The field and how it came to be (plain data)."""

    field: Field
    facts: dict[str, Any]


def uses_network(job: Job, views: Views) -> bool:
    """Whether this run starts from the networks (or ends with them).

    Raises:
        InputError: the settings contradict each other.
    """
    settings = job.settings
    if settings.field.init == "classical" and not settings.fit.finetune:
        raise InputError("without fine-tuning the networks' field is the result, so init cannot be 'classical'; drop one of the two")
    if settings.field.init != "auto":
        return settings.field.init == "network"
    field = job.stages.record("field") if job.again else None
    if field is not None and ("network" in field.after or not job.other_field):
        return "network" in field.after  # as what the folder has, be it --no-finetune or fitted from there
    if job.plan is not None and settings.fit.finetune:
        return False  # the seconds of the whole run are planned, and the networks' are not among them
    if not settings.fit.finetune:
        return True
    return starts_from_networks(views, settings)


def make_network_field(job: Job, views: Views, scene: Scene) -> NetworkField:
    """The stage `network`: what a fit can start from; made once a command."""
    from fieldfuse.render.field import Field

    if job.network is not None:
        return job.network
    keys = choose_keyframes(job, scene, views)
    settings = job.settings
    path, about = job.folder / "network.safetensors", job.folder / "network.json"
    weights = require_weights(settings)

    def make() -> NetworkField:
        set_seeds(settings.seed)
        start = time.monotonic()
        inference = direct_inference(views, scene, keys, settings)
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

    def load() -> NetworkField:
        return NetworkField(Field.load(path).to(settings.device), read_kept(about, NETWORK))

    uses = [asdict(settings.network), fingerprint(weights), settings.field.background, settings.device, settings.seed]
    value = job.stages.run("network", make, save, load, uses=uses, after=["scene", "views", "keyframes"])
    # As with a fitted field, what is used is what everybody can load.
    job.network = value if job.stages.cached["network"] else load()
    return job.network


def _stream(job: Job, inference: Inference, start: float) -> float:
    """Fuse all key frames, the preview renewed after each; answers the seconds from the third key frame to the first picture."""
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

    from fieldfuse.evaluation.pictures import depth_picture, depth_range
    from fieldfuse.render.image import make_renderer, render_view

    camera, photo = inference.train.intrinsics[frame], inference.train.images[frame]
    shrink = min(1.0, PREVIEW_SIDE / max(camera.width, camera.height))
    camera = camera.scaled(max(1, round(shrink * camera.width)), max(1, round(shrink * camera.height)))
    field = inference.field(finished=False)
    # The compiled renderer is faster, but the first picture must not wait for a compiler.
    shown = to_picture(render_view(field, camera, inference.train.world_from_camera[frame], make_renderer(field, "torch")))
    small = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    seen = exposed(np.concatenate([small, shown.rgb], axis=1), inference.train.exposure)
    return np.concatenate([seen, depth_picture(shown.depth, depth_range([shown.depth]))], axis=1)


def direct_result(job: Job, made: NetworkField, views: Views, scene: Scene) -> Field:
    """What direct inference gives, made of what the stage `network` left: colours are looked up again if the settings say so."""
    from fieldfuse.training.finer_colours import finer_colours

    if not job.settings.network.recolour:
        return made.field
    return finer_colours(made.field, views, scene.median_depth, job.progress, job.settings.engine)


def render_network_views(job: Job, made: NetworkField, views: Views, scene: Scene, keep: bool = False) -> Pictures:
    """What direct inference gives at the held-out views, before anything was fitted.

    Args:
        keep: the field becomes a file, `DIRECT`, beside its pictures.
    """
    from fieldfuse.render.image import make_renderer, render_view

    kept = job.folder / "renders" / "network.safetensors"

    def make() -> Pictures:
        begin = time.monotonic()
        field = direct_result(job, made, views, scene)
        seconds = round(made.facts["seconds"] + time.monotonic() - begin, 3)
        pictures = Pictures(facts={**made.facts, "seconds": seconds, "bytes": field.bytes})
        if keep:
            field.save(job.folder / DIRECT, scene.working_from_input, pictures.facts)
        view = make_renderer(field, job.settings.engine)
        indices = np.flatnonzero(views.test)
        require_pictures([views.intrinsics[index] for index in indices], kept=True, advice="run again with a lower --image-size")
        for count, index in enumerate(indices):
            job.progress.update(count, len(indices), views.names[index])
            job.progress.check()
            start = time.monotonic()
            picture = to_picture(render_view(field, views.intrinsics[index], views.world_from_camera[index], view))
            pictures.add(views.names[index], picture, time.monotonic() - start)
        return pictures

    def save(pictures: Pictures) -> list[Path]:
        save_pictures(kept, pictures)
        shown = write_pngs(kept.parent, "network", pictures, views.exposure, depth_steps(scene))
        return [kept, *([job.folder / DIRECT] if keep else []), *shown]

    uses = [job.settings.engine, keep]
    return job.stages.run("direct", make, save, load=lambda: load_pictures(kept), uses=uses, after=["network", "views", "scene"], version=3)
