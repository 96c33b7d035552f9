"""Colours of a field whose shape is known, looked up again in the pictures: one back-projection of what its own pictures lack.

A voxel of a fused volume has the mean of what key frames showed at its corner. Corners lie up to a voxel before or behind the surface,
where pictures from different sides show different things of it, so the mean is blurred by more than the voxel. Once the shape is there,
every pixel's light is known to come from the samples of its ray, each by its weight; hidden ones get nothing of it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import torch

from toolkit.camera import Intrinsics, pixel_grid, rays
from toolkit.capture.types import Views
from toolkit.progress import SILENT, Progress
from toolkit.render.composite import SOLID, THRESHOLD
from toolkit.render.differentiable import render_with_gradients
from toolkit.render.field import Field
from toolkit.volume.lookup import corners, scatter

Tensor = torch.Tensor
COLOURS = 3  # the first features are logits of the colour
CHUNK = 2048  # rays at a time
PER_VOXEL = 1.2  # rays along a voxel's side: 1.7 give 0.1 dB more for twice the time
MOST_RAYS = 300_000  # pictures are left out evenly until there are no more
STEEPEST = 0.05  # least slope of colour over logit that is divided by
MOST = 2.0  # logits that a ray may ask for
OPAQUE, VALID = 250, 0.99


@torch.no_grad()
def recoloured(field: Field, views: Views, depth: float, progress: Progress = SILENT) -> Field:
    """A field like `field`, sharing everything but its features, whose colours were looked up again.

    For every corner n, over the rays r of the pictures, with a_rn the part of the ray's light that comes from it by the field's densities:

        logit_n ← logit_n + Σ_r a_rn (c_r − ĉ_r) / ĉ'_r / Σ_r a_rn

    c_r is what the picture shows, ĉ_r what the field shows there, ĉ'_r = ĉ (1 − ĉ) the slope of a colour over its logit. So what pictures
    agree on is right after one pass, and corners that no ray reaches keep every bit. Densities and decoder stay as they are.

    Args:
        views: held-out ones are not looked at, nor masked pixels or those where alpha is not opaque.
        depth: at which a voxel's size in pixels tells how densely rays are taken, working units.

    Raises:
        Interrupted: the user asked to stop.
    """
    device, size = field.device, len(field.density_rows)
    wanted, weight = torch.zeros(size, COLOURS, device=device), torch.zeros(size, device=device)
    train = [int(index) for index in np.flatnonzero(~np.asarray(views.test))]
    cameras = [_smaller(views.intrinsics[index], PER_VOXEL * depth / field.voxel_size) for index in train]
    every = max(1, math.ceil(sum(camera.width * camera.height for camera in cameras) / MOST_RAYS))
    chosen = list(zip(train, cameras, strict=True))[::every]
    for count, (index, camera) in enumerate(chosen):
        progress.update(count, len(chosen), "colours")
        progress.check()
        origins, directions, colours = _pixels(views, index, camera)
        for some in torch.arange(len(origins)).split(CHUNK):
            _project_back(field, origins[some].to(device), directions[some].to(device), colours[some].to(device), wanted, weight)
    features = field.feature_rows.clone()
    features[:-1, :COLOURS] += (wanted / weight.clamp_min(THRESHOLD)[:, None])[:-1]
    return replace(field, feature_rows=features)


def _project_back(field: Field, origins: Tensor, directions: Tensor, colours: Tensor, wanted: Tensor, weight: Tensor) -> None:
    """Add Σ a (c − ĉ) / ĉ' and Σ a of these rays (B, 3) to `wanted` (M · 512 + 1, 3) and `weight` (M · 512 + 1,)."""
    # Rays that are not stopped (SOLID) say more of what is behind the field, and weak samples (THRESHOLD) show nothing.
    shown = render_with_gradients(field, origins, directions, threshold=THRESHOLD)
    opacity = shown.opacity[:, None]
    own = ((shown.colour - (1 - opacity) * field.background) / opacity.clamp_min(SOLID)).clamp(0, 1)
    asked = ((colours - own) / (own * (1 - own)).clamp_min(STEEPEST)).clamp(-MOST, MOST)
    samples = shown.samples
    kept = ((shown.weight > THRESHOLD) & (shown.opacity >= SOLID)[samples.ray]).nonzero().view(-1)
    if len(kept) == 0:
        return
    light, ray = shown.weight[kept], samples.ray[kept]
    rows, corner_weights = corners(field.topology, samples.cell[kept], samples.inside[kept])
    touched, (more, part) = scatter(rows, corner_weights, (light[:, None] * asked[ray], light))
    wanted[touched] += more
    weight[touched] += part


def _smaller(full: Intrinsics, focal: float) -> Intrinsics:
    """The same camera with pictures of about this focal length in pixels, or its own if that is less."""
    shrink = min(1.0, focal / full.fx)
    return full.scaled(max(1, round(shrink * full.width)), max(1, round(shrink * full.height)))


def _pixels(views: Views, index: int, camera: Intrinsics) -> tuple[Tensor, Tensor, Tensor]:
    """Origins, directions and colours (B, 3) of a picture made as small as `camera`, without what is masked or see-through."""
    shape = (camera.width, camera.height)
    picture = cv2.resize(views.images[index], shape, interpolation=cv2.INTER_AREA).reshape(-1, COLOURS)
    kept = np.ones(len(picture), bool)
    mask, alpha = views.valid[index] if views.valid else None, views.alpha[index] if views.alpha else None
    if mask is not None:
        kept &= cv2.resize(np.asarray(mask, np.float32), shape, interpolation=cv2.INTER_AREA).ravel() > VALID
    if alpha is not None:
        kept &= cv2.resize(alpha, shape, interpolation=cv2.INTER_AREA).ravel() >= OPAQUE
    origins, directions, _ = rays(camera, views.world_from_camera[index], pixel_grid(*shape)[kept])
    return origins, directions, torch.from_numpy(picture[kept].astype(np.float32) / 255)
