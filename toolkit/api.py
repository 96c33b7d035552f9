"""Fieldfuse from Python: what `import fieldfuse` offers.

    import fieldfuse as ff

    scene = ff.load("fox/")                         # images, poses, corrections
    field = ff.fit(scene, budget=30)                # a radiance field, 30 seconds of fitting
    image = field.render(scene.test.cameras[0])     # .rgb .depth .opacity as NumPy
    scores = ff.evaluate(field, scene)              # at the held-out views
    field.to_mesh().save("mesh.glb")

Cameras, depth, meshes and points are in the source's own frame and unit of length (in metres with `scale`, `marker` or GPS), with
OpenCV's axes (x right, y down, z forward). Nothing here prints, or changes the threads or random generators of the caller; remarks go to
the logger "fieldfuse". Functions take settings by the names that `--set` has: the short ones as keywords (`image_size=320`), all of them in
`settings={"field.channels": 8}`.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import steps
from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.results import (
    OF_FIT,
    OF_SURFACE,
    Field,
    Listener,
    Scene,
    Scores,
    Splats,
    Surface,
    changed_settings,
    chosen_settings,
    listening,
)
from fieldfuse.tone import exposed, unexposed

log = logging.getLogger("fieldfuse")


def load(
    source: Path | str,
    *,
    workdir: Path | str | None = None,
    progress: Listener = None,
    **options: Any,
) -> Scene:
    """Read a capture, find or check its poses, estimate what camera and light did to its images, and prepare them.

    Args:
        source: a video, a folder of images, or a capture of any known layout.
        workdir: where frames of a video and structure from motion's database go; None: a temporary folder that goes with the scene.
        progress: called with stage, done, total and a remark, and asks to stop by returning False; or True for a bar on the terminal.
        options: `image_size`, `holdout`, `poses` ("auto", "given", "sfm"), `effects` ("auto", "off"), `seed`, `threads`, `preset`, `scale`,
            `marker`, `depth_scale` (docs/scale.md), …, and `settings` for those with full names.

    Raises:
        InputError: the source or a setting is not usable.
        PoseError: poses cannot be estimated, or those given do not fit the images.
        Interrupted: the listener asked to stop.
    """
    from fieldfuse.capture.photos import with_unposed
    from fieldfuse.capture.prepare import limited
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.poses.points import Features
    from fieldfuse.poses.scene import describe_scene

    path = Path(source)
    if not path.exists():
        raise InputError(f"{path} does not exist; give a video, a folder of images, or a capture folder")
    chosen = chosen_settings(options)
    chosen.device = steps.choose_device(chosen.device, chosen.engine)
    files = tempfile.TemporaryDirectory(prefix="fieldfuse-") if workdir is None else None
    folder = Path(files.name if files is not None else workdir or ".")

    with steps.seeded(chosen.seed):
        capture = steps.read_capture(path.absolute(), folder, chosen, listening(progress, "capture"))
        if chosen.poses.source == "sfm":
            capture = with_unposed(capture)
        if steps.needs_frames(capture):
            capture = steps.write_frames(capture, folder, chosen, listening(progress, "frames"))
        features: dict[str, Features] = {}
        poses = steps.camera_poses(capture, folder, chosen, listening(progress, "poses"), features)
        if (scaling := steps.find_scaling(capture, poses, chosen, listening(progress, "scaling"))) is not None:
            capture, poses = scaling.apply(capture, poses)
        posed = limited(poses.apply(capture), chosen.capture.holdout, chosen.views.limit)
        corrections, effects = Corrections(), []
        if steps.looks_for_effects(chosen):
            found = steps.find_effects(posed, chosen, listening(progress, "effects"))
            corrections, effects = steps.apply_effects(found, chosen), found["effects"]
        poses, posed = steps.refined(poses, corrections), corrections.on_capture(posed)
        steps.set_seeds(chosen.seed)
        geometry = describe_scene(posed, listening(progress, "scene"), features)
        views = steps.prepared(posed, geometry, chosen, listening(progress, "views"), corrections)
    scene = Scene(posed, poses, views, geometry, corrections, effects, chosen, files)
    for warning in scene.warnings:
        log.warning("%s: %s", path, warning)
    return scene


def fit(scene: Scene, budget: float | None = None, *, progress: Listener = None, start: Field | None = None, **options: Any) -> Field:
    """Fit a field to the training views. With `finetune=False` nothing is fitted: the result is what `infer` gives.

    Args:
        budget: seconds; None: as the preset has it.
        progress: as in `load`; asked to stop, the field as far as it came is returned.
        start: a field to go on from, of the same scene; None: chosen by `init` ("classical", "network", "auto").
        options: settings of the field and the fit (`init`, `decoder`, `engine`, `seed`, …).

    Raises:
        InputError: a setting is not usable, or there are no training views.
    """
    from fieldfuse.training.fit import Begin
    from fieldfuse.training.guided import fit_guided
    from fieldfuse.training.network_start import network_start
    from fieldfuse.volume.grid import host_for

    settings = changed_settings(scene.settings, {**options, **({} if budget is None else {"budget": budget})}, OF_FIT)
    if settings.fit.cells != "off":
        raise InputError("a scene is fitted in cells on disk, by `fieldfuse run SOURCE --out DIR --cells N`; leave cells out here")
    if not settings.fit.finetune:
        if start is not None or settings.field.init == "classical":
            raise InputError("without fine-tuning the networks' field is the result, so it has no start; leave out start or finetune=False")
        return infer(scene, progress=progress, **options)
    with steps.seeded(settings.seed):
        first = None if start is None else start.sparse
        if first is None and steps.starts_from_networks(scene.views, settings):
            made = _inferred(scene, settings, progress).field()
            first = network_start(made, scene.views, scene.geometry, settings)
        result = fit_guided(
            scene.views,
            scene.geometry,
            settings,
            listening(progress, "fit"),
            Begin(host_for(settings.device), first, coarse=first is not None and start is None),
        )
    for note in result.notes:
        log.warning("%s", note)
    exposure = scene.views.exposure
    return Field(result.field, scene.working_from_input, exposure, scene, tuple(result.timeline), tuple(result.notes))


def infer(scene: Scene, *, progress: Listener = None, **options: Any) -> Field:
    """The field that trained networks give without any fitting: key frames fused one after the other.

    Raises:
        InputError: there are no training views, or no trained networks.
        Interrupted: the listener asked to stop.
    """
    settings = changed_settings(scene.settings, options, OF_FIT)
    with steps.seeded(settings.seed):
        made = _inferred(scene, settings, progress).result(listening(progress, "colours"), settings.engine)
    return Field(made, scene.working_from_input, scene.views.exposure, scene)


def fuse_tsdf(scene: Scene, *, depth_from: str = "auto", progress: Listener = None, **options: Any) -> Surface:
    """Fuse the training frames' depth into a surface.

    Args:
        depth_from: "sensor", "matching" (depth by matching the images with each other), or "auto": the sensor's where there is one.
        options: `voxel_size` and `depth_max` in working units.

    Raises:
        InputError: there is no depth, or the voxels are too fine for the memory.
        Interrupted: the listener asked to stop.
    """
    from fieldfuse.stereo.match import stereo_depths
    from fieldfuse.stereo.plane_completion import continued
    from fieldfuse.tsdf.fuse import fuse_capture, fuse_stereo

    if depth_from not in ("auto", "sensor", "matching"):
        raise InputError(f"depth_from is {depth_from!r}; it must be auto, sensor or matching")
    settings = changed_settings(scene.settings, {f"tsdf.{name}": value for name, value in options.items()}, OF_SURFACE)
    views, geometry, listener = scene.views, scene.geometry, listening(progress, "tsdf")
    train = np.flatnonzero(~np.asarray(views.test))
    if depth_from == "sensor" or (depth_from == "auto" and scene.capture.has_depth):
        measured = [int(index) for index in train if scene.capture.frames[index].depth is not None]
        volume = fuse_capture(scene.capture, scene.working_from_input, measured, settings.tsdf, listener, views.toned())
    else:
        shown = views.subset(train)
        found = stereo_depths(shown, geometry.near, geometry.far, geometry.median_depth, progress=listener)
        found = continued(found, shown, geometry.median_depth, listener)
        volume = fuse_stereo(shown, found, settings.tsdf.voxel_size, settings.tsdf.depth_max, progress=listener)
    return Surface(volume, scene.working_from_input, views.exposure, settings.export.smooth)


def evaluate(result: Field | Surface | Splats, scene: Scene, *, progress: Listener = None) -> Scores:
    """Scores of a field, surface or splats at the scene's test views. Splats are in the scene's own frame; what they do not cover is the
    background of its images, where that is known.

    Raises:
        Interrupted: the listener asked to stop.
    """
    from fieldfuse.evaluation.score import nearest_image_scores, score_views

    listener, views, indices = listening(progress, "evaluate"), scene.views, np.flatnonzero(scene.views.test)
    if isinstance(result, Splats) and views.background is not None:
        red, green, blue = exposed(np.round(255 * np.array(views.background)).astype(np.uint8), views.exposure).tolist()
        result = replace(result, background=(red, green, blue))
    onto = result.working_from_input.after(scene.working_from_input.inverse())  # the same, unless it was made from another scene

    def shown() -> Iterator[Any]:
        for count, index in enumerate(indices):
            listener.check()
            listener.update(count, len(indices), views.names[index])
            made = result.working(views.intrinsics[index], onto.poses(views.world_from_camera[index]))
            if isinstance(result, Splats):
                made = replace(made, rgb=unexposed(made.rgb, views.exposure))
            yield made if onto.scale == 1 else replace(made, depth=made.depth / onto.scale)

    scores = score_views(shown(), views, indices)
    floor = nearest_image_scores(views, indices)["psnr"]
    return Scores(scores["psnr"], scores["ssim"], scores["lpips"], scores["depth"], floor, scores["per_view"])


def _inferred(scene: Scene, settings: Settings, progress: Listener) -> Any:
    """The networks with all key frames fused."""
    keys = steps.key_frames(scene.views, scene.geometry, settings)
    inference = steps.direct_inference(scene.views, scene.geometry, keys, settings)
    for _ in inference.frames(listening(progress, "networks")):
        pass
    return inference
