"""What a run consists of, in order: plain functions from values to values.

    capture → frames → poses → corrections → scene → views → key frames → field or surface

`fieldfuse.api` strings them together in memory, the command line with a folder that keeps every result.
"""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress

if TYPE_CHECKING:
    from fieldfuse.camera import Array
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.nerfusion.keyframes import KeyFrames
    from fieldfuse.poses.points import Features
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scaling import Scaling
    from fieldfuse.poses.scene import Scene
    from fieldfuse.training.from_network import Inference


def set_seeds(seed: int) -> None:
    """Seed every generator in use."""
    import cv2
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)
    cv2.setRNGSeed(seed % 2**31)


class _Generators:
    """The state of the global random generators before the first of several threads seeded them, given back by the last."""

    lock, inside = threading.Lock(), 0
    before: tuple[Any, ...] = ()


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Generators seeded inside, and as they were afterwards (but OpenCV's, whose state cannot be read)."""
    import torch

    with _Generators.lock:
        _Generators.inside += 1
        if _Generators.inside == 1:
            _Generators.before = random.getstate(), np.random.get_state(), torch.get_rng_state()
        set_seeds(seed)
    try:
        yield
    finally:
        with _Generators.lock:
            _Generators.inside -= 1
            if _Generators.inside == 0:
                python, numbers, tensors = _Generators.before
                random.setstate(python)
                np.random.set_state(numbers)
                torch.set_rng_state(tensors)


def choose_device(wanted: str, engine: str = "auto") -> str:
    """`auto` → `cuda` when there is one, else `cpu`.

    Raises:
        InputError: `cuda` is wanted and there is none, or an engine that cannot run on the device.
    """
    import torch

    from fieldfuse.backends.dispatch import triton_runs_on

    there = torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise InputError("device is 'cuda' but torch finds no CUDA device here; use --device cpu or install torch with CUDA")
    device = wanted if wanted != "auto" else "cuda" if there else "cpu"
    if engine == "triton" and not triton_runs_on(torch.device(device)):
        why = "Triton for it is not installed, or it is too old" if device == "cuda" else f"the device is {device!r}"
        raise InputError(f"engine is 'triton', which runs on CUDA alone, and {why}; leave --engine at auto")
    return device


def read_capture(source: Path, folder: Path, settings: Settings, progress: Progress = SILENT) -> Capture:
    """What the source is detected to be, every image of it looked at once (those that `write_frames` writes, then). A zip file is unpacked
    into `folder/unpacked`.

    Raises:
        InputError: it is not readable as any known layout, or too little of it is usable.
    """
    from fieldfuse.capture import open_capture
    from fieldfuse.capture.checks import check_capture
    from fieldfuse.capture.convert import to_convert
    from fieldfuse.capture.depth_checks import with_depth_scale
    from fieldfuse.capture.light import LIGHT
    from fieldfuse.capture.unpack import UNPACKED, unpacked
    from fieldfuse.poses.check_given import best_fitting

    with unpacked(source, folder / UNPACKED, progress) as place:
        capture = open_capture(place, settings.capture.masks, best_fitting, settings.capture.projection)
        capture = with_depth_scale(capture, settings.capture.depth_scale)
        if settings.capture.light != "auto":
            capture = replace(capture, extra={**capture.extra, LIGHT: settings.capture.light})
        return capture if to_convert(capture) else check_capture(capture, progress)


def needs_frames(capture: Capture) -> bool:
    """Whether images have to be written before they can be used: those of a video or film, HEIF, mirrored ones, views of panoramas and
    fisheye images."""
    from fieldfuse.capture.convert import to_convert
    from fieldfuse.capture.sphere import to_cut

    return capture.filmed or bool(to_convert(capture)) or bool(to_cut(capture))


def write_frames(capture: Capture, folder: Path, settings: Settings, progress: Progress = SILENT) -> Capture:
    """The capture with images in `folder/frames`: chosen from a video or film, converted from HEIF and mirrored ones, or cut into views."""
    from fieldfuse.capture.convert import convert_images, to_convert
    from fieldfuse.capture.select import select_frames
    from fieldfuse.capture.sphere import SIDE, cut_images, to_cut

    threads = settings.threads or os.cpu_count() or 1
    if capture.filmed:
        capture = select_frames(capture, folder, settings.capture, progress)
    if to_convert(capture):
        capture = convert_images(capture, folder, threads, progress)
    return cut_images(capture, folder, threads, progress, max(SIDE, settings.capture.image_size or 0)) if to_cut(capture) else capture


def uses_given_poses(capture: Capture, settings: Settings) -> bool:
    """Whether poses that the capture brings are used, not estimated ones."""
    return settings.poses.source == "given" or (settings.poses.source == "auto" and capture.posed)


def camera_poses(
    capture: Capture, folder: Path, settings: Settings, progress: Progress = SILENT, features: dict[str, Features] | None = None
) -> PoseResult:
    """Poses that the capture brings, as its images confirm them, or structure from motion, whose database and log lie in `folder/sparse`.

    Args:
        features: of images by name; gets those that are extracted on the way.

    Raises:
        PoseError: poses cannot be estimated, or those given do not fit the images.
    """
    from fieldfuse.poses.check_given import check_given
    from fieldfuse.poses.result import given_poses
    from fieldfuse.poses.scaling import check_measures
    from fieldfuse.poses.sfm import find_poses

    check_measures(capture, settings.poses)
    if uses_given_poses(capture, settings):
        return check_given(capture, given_poses(capture), settings.poses.convention, progress, {} if features is None else features)
    return find_poses(capture, folder, settings.poses, settings.seed, settings.threads, progress, settings.address)


def find_scaling(capture: Capture, poses: PoseResult, settings: Settings, progress: Progress = SILENT) -> Scaling | None:
    """What makes the poses metric and places them on earth: measured distances, markers, the images' GPS. None: there is none of it.

    Raises:
        InputError: what the settings name cannot be found in the images.
    """
    from fieldfuse.poses import scaling

    if not scaling.wanted(capture, settings.poses, poses.source == "sfm"):
        return None
    return scaling.find_scaling(capture, poses, settings.poses, progress)


def find_effects(posed: Capture, settings: Settings, progress: Progress = SILENT) -> dict[str, Any]:
    """Evidence, decisions and corrections of camera and light, as `effects.json` has them; see `apply_effects`."""
    from fieldfuse.capture.prepare import held_out
    from fieldfuse.effects.decide import decide
    from fieldfuse.training.trial import Trial

    def trials(capture: Capture, validation: Array) -> Trial:
        progress.update(0, 1, "trying what was found in short fits")
        set_seeds(settings.seed)
        return Trial(capture, validation, settings, progress)

    return decide(posed, held_out(posed, settings.capture.holdout), settings.effects, progress, trials=trials).to_dict()


def looks_for_effects(settings: Settings) -> bool:
    """Whether there is anything to look for. A background that is switched by name is switched in `settings.field` here."""
    from fieldfuse.effects.decide import asleep

    for wish, names in (("on", settings.effects.on), ("off", settings.effects.off)):
        if "background" in names and settings.field.background == "auto":
            settings.field.background = wish
    return not asleep(settings.effects)


def apply_effects(found: dict[str, Any], settings: Settings) -> Corrections:
    """The corrections that were decided; what they say of the field (its background, colours by direction) is set in `settings.field`."""
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.effects.decide import choose_field

    choose_field(settings.field, found["effects"], settings.effects.off)
    return Corrections.from_dict(found.get("corrections", {}))


def refined(poses: PoseResult, corrections: Corrections) -> PoseResult:
    """The poses with what was refined; they are what is exported."""
    from fieldfuse.effects.correct import bent

    if not corrections.geometric:
        return poses
    cameras = poses.intrinsics if corrections.lens is None else [bent(camera, corrections.lens) for camera in poses.intrinsics]
    moved = [corrections.poses.get(name, pose) for name, pose in zip(poses.names, poses.world_from_camera, strict=True)]
    return replace(poses, intrinsics=cameras, world_from_camera=np.array(moved))


def prepared(
    posed: Capture, scene: Scene, settings: Settings, progress: Progress = SILENT, corrections: Corrections | None = None
) -> Views:
    """Images undistorted and resized once, in the working frame, test views marked, colours corrected."""
    from fieldfuse.capture.prepare import prepare_views

    views = prepare_views(posed, scene.working_from_input, settings.capture, progress)
    return views if corrections is None else corrections.on_views(views)


def key_frames(views: Views, scene: Scene, settings: Settings, sharp: bool = True) -> KeyFrames:
    """Key frames among the training views and their neighbours, as indices into the training views; `sharp`: blurred images give way."""
    from fieldfuse.capture.select import sharpness
    from fieldfuse.nerfusion.keyframes import KeyFrames, select_keyframes

    train = np.flatnonzero(~np.asarray(views.test))
    if len(train) == 0:
        return KeyFrames(np.zeros(0, np.int64), np.zeros((0, 0), np.int64))
    return select_keyframes(
        views.world_from_camera[train],
        [views.intrinsics[int(index)] for index in train],
        scene.median_depth,
        settings.keyframes,
        sharpness=np.array([sharpness(views.images[int(index)]) for index in train]) if sharp else None,
    )


def network_weights(settings: Settings) -> Path:
    """The file of trained networks that the settings name, else the shipped one."""
    from fieldfuse.training.from_network import SHIPPED

    return Path(settings.network.weights) if settings.network.weights else SHIPPED


def require_weights(settings: Settings) -> Path:
    """The file of trained networks.

    Raises:
        InputError: it does not exist.
    """
    weights = network_weights(settings)
    if not weights.is_file():
        raise InputError(f"there are no trained networks at {weights}; leave network.weights out for the shipped ones")
    return weights


def direct_inference(views: Views, scene: Scene, keys: KeyFrames, settings: Settings) -> Inference:
    """The networks, ready to fuse key frame after key frame."""
    from fieldfuse.training.from_network import Inference, load_networks

    model = load_networks(require_weights(settings), settings.device)
    return Inference(model, views, scene, keys, settings.field.background, settings.network)


def starts_from_networks(views: Views, settings: Settings) -> bool:
    """Whether a fit starts from the networks' field.

    With few views that start won by up to 3 dB on validation captures, with many it is not needed (docs/measured/few_views.md).
    """
    from fieldfuse.training.start import FEW_VIEWS

    if settings.field.init != "auto":
        return settings.field.init == "network"
    return int(np.count_nonzero(~np.asarray(views.test))) < FEW_VIEWS
