"""Validation on real captures: held-out images rendered from the nearest key frame alone and from all fused, and a sheet of them.

The held-out convention is the project's: frames by name, every 8th is a test view. Working frame, depth range and key frames are found
just as for a run of `fieldfuse`. Nothing here trains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from fieldfuse.camera import Array
from fieldfuse.capture.detect import read_source
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.config import CaptureSettings, KeyframesSettings
from fieldfuse.errors import InputError, OutputError
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.keyframes import select_keyframes
from fieldfuse.nerfusion.lattice import LatentVolume
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.rendering import background_of, decibels, depth_likelihood, picture_rays, relative_depth_error, trace
from fieldfuse.nerfusion.training.samples import Pictures, Sample, keyframe_distributions, lattice_resolution, view_distance
from fieldfuse.nerfusion.training.settings import TrainSettings
from fieldfuse.nerfusion.training.step import Recurrence, volume_field
from fieldfuse.poses.scene import describe_scene
from fieldfuse.training.start import make_space

MOST_KEY_FRAMES = 40
CHUNK = 4096  # rays at a time
SHOWN = 2  # images a capture on the sheet


@dataclass(frozen=True)
class Case:
    """One held-out image: `sample.targets` is it in every row; key frames from the farthest to the nearest one."""

    capture: str
    picture: str
    sample: Sample
    nearest: int  # the image in `sample.pictures` that is nearest to the target, for the simplest baseline


def load_cases(folder: Path | str, settings: TrainSettings) -> list[Case]:
    """Evenly spread held-out images of one capture.

    Raises:
        InputError: the capture cannot be read, has no poses, or too few images.
        PoseError: its scene cannot be found from poses and images.
    """
    capture, name = read_source(Path(folder)), Path(folder).name
    scene = describe_scene(capture)
    views = prepare_views(capture, scene.working_from_input, CaptureSettings(image_size=settings.record.validation_side))
    if len({image.shape for image in views.images}) != 1:
        raise InputError(f"the images of {folder} differ in size; validation needs one size a capture")
    train, held = np.flatnonzero(~np.asarray(views.test)), np.flatnonzero(np.asarray(views.test))
    if len(train) < settings.pictures.views or len(held) == 0:
        raise InputError(f"{folder} has {len(train)} training and {len(held)} held-out images; too few to validate on")
    intrinsics = [views.intrinsics[i] for i in train]
    given = views.world_from_camera[train], intrinsics, scene.median_depth
    keys = select_keyframes(*given, KeyframesSettings(most=MOST_KEY_FRAMES), settings.pictures.views)
    distances = view_distance(views.world_from_camera, scene.median_depth)
    groups = np.concatenate([train[keys.indices][:, None], train[keys.neighbours]], axis=1)  # (M, K)
    space = make_space(scene, scene.has_background)
    voxel = scene.median_depth / math.sqrt(math.prod(settings.volume.voxels_to_median))
    resolution = lattice_resolution(space, voxel, settings.volume.most)
    cases = []
    for target in held[np.unique(np.linspace(0, len(held) - 1, settings.record.validation_views).round().astype(int))]:
        apart = distances[target]
        order = np.argsort(apart[groups[:, 0]], kind="stable")[: settings.pictures.key_frames][::-1]
        chosen = groups[order]  # (F, K), nearest last
        nearest = int(train[np.argmin(apart[train])])
        used, places = np.unique(np.concatenate([chosen.ravel(), [target, nearest]]), return_inverse=True)
        pictures = Pictures.of(
            [torch.from_numpy(views.images[i]) for i in used],
            [views.intrinsics[i] for i in used],
            views.world_from_camera[used],
            [views.depths[i] if views.depths else None for i in used],
            views.background,
        )
        references = torch.from_numpy(places[: chosen.size].reshape(chosen.shape)).long()
        targets = torch.full((len(chosen), 1), int(places[-2]), dtype=torch.int64)
        label = f"{name}/{views.names[target]}"
        sample = Sample(label, pictures, references, targets, space, resolution, scene.near, scene.far)
        cases.append(Case(name, views.names[target], sample, int(places[-1])))
    return cases


@dataclass(frozen=True)
class Predicted:
    """One held-out image as predicted."""

    case: Case
    colour: Tensor  # (H, W, 3)
    depth: Tensor  # (H, W) along z, 0 = nothing
    numbers: dict[str, float]


@torch.no_grad()
def predict(model: NerfusionModel, case: Case, device: torch.device, prune: bool, levels: int = 1, checked: bool = False) -> Predicted:
    """Direct inference of one case: the local volume of the nearest key frame, and the volumes of all key frames fused.

    With `checked`, key frames' depth is checked against each other. Numbers are `psnr_local`, `psnr_fused` (coarsest level), `psnr_fused_1`
    (half its voxel size), `psnr_nearest` (the nearest training image shown unchanged), and with true depth `depth_error` (median,
    relative) and `depth_likelihood` of the finest one.
    """
    sample = case.sample.to(device)
    target = int(sample.targets[0, 0])
    rays = picture_rays(sample.pictures, target)
    state = Recurrence(model, sample, levels)
    local: LatentVolume = state.volumes[0]
    distributions = keyframe_distributions(sample) if checked else [None] * len(sample.references)
    for indices, distribution in zip(sample.references, distributions, strict=True):
        cameras = sample.pictures.cameras(indices)
        local = state.add(model.encode(sample.pictures.images[indices], cameras), cameras, distribution)
    background = background_of(sample.pictures, 1, None)
    truth = sample.pictures.images[target].permute(1, 2, 0)
    numbers = {"psnr_nearest": _psnr(sample.pictures.images[case.nearest].permute(1, 2, 0), truth)}
    colour = distance = torch.zeros(0)
    fused = [("fused" if level == 0 else f"fused_{level}", volume, level) for level, volume in enumerate(state.volumes)]
    for name, volume, level in [("local", local, 0), *fused]:
        allowed = state.allowed(level) if name != "local" else None
        field = volume_field(model, volume, background, sample, prune and name != "local", allowed)
        starts = range(0, len(rays), CHUNK)
        parts = [trace(field, rays[start : start + CHUNK], background, None) for start in starts]
        colour = torch.cat([part.colour for part in parts]).clamp(0, 1).view_as(truth)
        distance = torch.cat([part.median_distance() for part in parts])
        numbers[f"psnr_{name}"] = _psnr(colour, truth)
        error = float(relative_depth_error(distance, rays.distance))
        if math.isfinite(error):  # of the last one, the finest
            likelihoods = [depth_likelihood(part, rays.distance[start : start + CHUNK]) for part, start in zip(parts, starts, strict=True)]
            numbers["depth_error"], numbers["depth_likelihood"] = error, float(torch.cat(likelihoods).nanmean())
    depth = (distance * rays.cosine).view(truth.shape[:2])
    return Predicted(case, colour.cpu(), depth.cpu(), numbers)


def _psnr(shown: Tensor, truth: Tensor) -> float:
    return float(decibels((shown - truth).square().mean()))


@dataclass(frozen=True)
class Validation:
    """How validation predicts, as training does at the time: see `predict`."""

    prune: bool = False
    levels: int = 1
    checked: bool = False


def validate(
    model: NerfusionModel, cases: Sequence[Case], device: torch.device, how: Validation, sheet: Path | None = None
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Means over the captures (each counts the same) with names `val_…`, and means of each capture.

    Args:
        sheet: where to draw true image | prediction | depth of some cases, as PNG.

    Raises:
        OutputError: the sheet cannot be written.
    """
    was = model.training
    model.eval()
    by_capture: dict[str, list[Predicted]] = {}
    for case in cases:
        by_capture.setdefault(case.capture, []).append(predict(model, case, device, how.prune, how.levels, how.checked))
    model.train(was)
    each = {name: _means([one.numbers for one in found]) for name, found in by_capture.items()}
    if sheet is not None:
        _write_sheet(sheet, [one for found in by_capture.values() for one in found[:: max(1, len(found) // SHOWN)][:SHOWN]])
    return {f"val_{name}": value for name, value in _means(list(each.values())).items()}, each


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}


def _write_sheet(path: Path, rows: Sequence[Predicted]) -> None:
    """True image, prediction and predicted depth side by side, one row a case."""
    strips = [_strip(one) for one in rows]
    width = max(strip.shape[1] for strip in strips)
    whole = np.concatenate([np.pad(strip, ((0, 2), (0, width - strip.shape[1]), (0, 0)), constant_values=255) for strip in strips])
    done, data = cv2.imencode(".png", whole[:, :, ::-1])
    if not done:
        raise OutputError(f"cannot make a PNG for {path}; the sheet has shape {whole.shape}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def _strip(one: Predicted) -> Array:
    """(H, 3 · W, 3) uint8 RGB."""
    truth = one.case.sample.pictures.images[int(one.case.sample.targets[0, 0])].permute(1, 2, 0).cpu().numpy()
    depth = one.depth.numpy()
    known = depth[depth > 0]
    low, high = np.quantile(known, [0.02, 0.98]) if len(known) else (0.0, 1.0)
    grey = np.clip((depth - low) / max(float(high - low), 1e-6), 0, 1) * (depth > 0)
    shown = cv2.applyColorMap((255 - 255 * grey).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[:, :, ::-1]
    images = np.concatenate([truth, one.colour.numpy()], axis=1)
    return np.concatenate([np.round(images * 255).astype(np.uint8), shown], axis=1)
