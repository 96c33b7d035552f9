"""Validation on real captures: held-out pictures rendered from the nearest key frame alone and from all fused, and a sheet of them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.errors import OutputError
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.lattice import LatentVolume
from fieldfuse.nerfusion.losses import Traced, depth_likelihood, psnr
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.health import relative_depth_error
from fieldfuse.nerfusion.training.rays import TargetRays, picture_rays
from fieldfuse.nerfusion.training.real import Case
from fieldfuse.nerfusion.training.samples import cameras_of, keyframe_distributions
from fieldfuse.nerfusion.training.step import background_of, begin, render_volume

Tensor = torch.Tensor
CHUNK = 4096  # rays at a time
SHOWN = 2  # pictures a capture on the sheet


@dataclass(frozen=True)
class Predicted:
    """One held-out picture as predicted."""

    case: Case
    colour: Tensor  # (H, W, 3)
    depth: Tensor  # (H, W) along z, 0 = nothing
    numbers: dict[str, float]


@torch.no_grad()
def predict(model: NerfusionModel, case: Case, device: torch.device, prune: bool, levels: int = 1, witnesses: bool = False) -> Predicted:
    """Direct inference of one case: the local volume of the nearest key frame, and the volumes of all key frames fused.

    With `witnesses` key frames are each other's. Numbers are `psnr_local`, `psnr_fused` (coarsest level), `psnr_fused_1` (half its voxel
    size), `psnr_nearest` (the nearest training picture shown unchanged), and with true depth `depth_error` (median, relative) and
    `depth_likelihood` of the finest one.
    """
    sample = case.sample.to(device)
    target = int(sample.targets[0, 0])
    rays = picture_rays(sample.pictures, target)
    state = begin(model, sample, levels)
    local: LatentVolume = state.volumes[0]
    sweeps = keyframe_distributions(sample) if witnesses else [None] * len(sample.references)
    for indices, distribution in zip(sample.references, sweeps, strict=True):
        cameras = cameras_of(sample.pictures, indices)
        state, local = state.add(model, model.encode(sample.pictures.images[indices], cameras), cameras, distribution)
    behind = background_of(sample.pictures, 1, None)
    truth = sample.pictures.images[target].permute(1, 2, 0)
    numbers = {"psnr_nearest": psnr((sample.pictures.images[case.nearest].permute(1, 2, 0) - truth).square().mean())}
    height, width = truth.shape[:2]
    colour = distance = torch.zeros(0)
    fused = [("fused" if level == 0 else f"fused_{level}", volume, level) for level, volume in enumerate(state.volumes)]
    for name, volume, level in [("local", local, 0), *fused]:
        allowed = state.allowed(model, level) if name != "local" else None
        colour, distance, likelihood = _render(model, volume, rays, behind, 0.5 * sample.near, prune and name != "local", allowed)
        numbers[f"psnr_{name}"] = psnr((colour.clamp(0, 1).view(height, width, 3) - truth).square().mean())
        error = float(relative_depth_error(distance, rays.distance))
        if math.isfinite(error):  # of the last one, the finest
            numbers["depth_error"], numbers["depth_likelihood"] = error, likelihood
    depth = (distance * rays.cosine).view(height, width)
    return Predicted(case, colour.clamp(0, 1).view(height, width, 3).cpu(), depth.cpu(), numbers)


def _render(
    model: NerfusionModel, volume: LatentVolume, rays: TargetRays, behind: Tensor, near: float, prune: bool, allowed: Tensor | None
) -> tuple[Tensor, Tensor, float]:
    colours, distances, likelihoods = [], [], []
    for start in range(0, len(rays), CHUNK):
        some = rays[torch.arange(start, min(start + CHUNK, len(rays)), device=rays.origins.device)]
        traced: Traced = render_volume(model, volume, some, behind, near, None, prune, allowed)
        colours.append(traced.colour)
        distances.append(traced.median_distance())
        likelihoods.append(depth_likelihood(traced, some.distance)[0])
    found = torch.cat(likelihoods)
    return torch.cat(colours), torch.cat(distances), float(found.mean()) if len(found) else float("nan")


def validate(
    model: NerfusionModel,
    cases: Sequence[Case],
    device: torch.device,
    sheet: Path | None = None,
    prune: bool = False,
    levels: int = 1,
    witnesses: bool = False,
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Means over the captures (each counts the same) with names `val_…`, and means of each capture.

    Args:
        sheet: where to draw true picture | prediction | depth of some cases, as PNG.

    Raises:
        OutputError: the sheet cannot be written.
    """
    was = model.training
    model.eval()
    by_capture: dict[str, list[Predicted]] = defaultdict(list)
    for case in cases:
        by_capture[case.capture].append(predict(model, case, device, prune, levels, witnesses))
    model.train(was)
    each = {name: _means([one.numbers for one in found]) for name, found in by_capture.items()}
    if sheet is not None:
        rows = [one for found in by_capture.values() for one in found[:: max(1, len(found) // SHOWN)][:SHOWN]]
        write_sheet(sheet, rows)
    return {f"val_{name}": value for name, value in _means(list(each.values())).items()}, each


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}


def write_sheet(path: Path, rows: Sequence[Predicted]) -> None:
    """True picture, prediction and predicted depth side by side, one row a case.

    Raises:
        OutputError: it cannot be written.
    """
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
    pictures = np.concatenate([truth, one.colour.numpy()], axis=1)
    return np.concatenate([np.round(pictures * 255).astype(np.uint8), shown], axis=1)
