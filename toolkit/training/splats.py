"""Gaussian splats of a fitted field: a Gaussian for every voxel that training views see, then steps on the training images.

A Gaussian begins with what rays see of its voxel: the centroid and the covariance of their light, colours in harmonics by least squares
over the directions of view, and the opacity that rays are stopped with. Steps of Adam on the squared error follow, a view each, in the
seconds that there are; no Gaussian is added. All of it is in the frame and the colours of the source's images, as other programs show
splats.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch

from fieldfuse import memory
from fieldfuse.backends.numba import splat_start as B
from fieldfuse.backends.numba import splats as G
from fieldfuse.camera import Array, Intrinsics, Similarity, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.bake import seen_weights
from fieldfuse.render.composite import STOP, THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import make_space, make_volume
from fieldfuse.render.sky import sky_colours
from fieldfuse.render.splats import PARTS, SH_0, Drawn, Splats, backward, draw, make_lens
from fieldfuse.threads import share, slices
from fieldfuse.tone import exposed
from fieldfuse.training.fit import Clock
from fieldfuse.volume.topology import BLOCK, VOXELS

Tensor = torch.Tensor
SEEN = 0.05  # largest share of a pixel's light below which a voxel becomes no Gaussian
MOST_VOXELS = 2_000_000
MOST_THREADS = 4  # that have sums of their own: a quarter of a gigabyte each
MOST_SIDE = 2**20  # of a lattice, voxels
MOST_RAYS = 2_000_000  # that voxels' sums are made of; pixels are skipped evenly
SPREAD = 2.2  # standard deviations of a Gaussian over those of the light in its voxel: neighbours overlap
OVERLAP = 1.0  # Gaussians beside each other that a ray meets instead of one voxel
LONGEST = 4.0  # standard deviation over the second longest: contracted space is stretched along the rays
RIDGE = 0.1  # of the light that a voxel was seen with: holds back what directions of view do not say
LEAST_OPACITY, MOST_OPACITY = 0.02, 0.98
SKY_SIDE = 24  # Gaussians along a side of the cube behind all others
SKY_FAR = 20.0  # distance over that of the farthest camera or the region's corner, from the region's centre
SMALL = 0.35  # of the seconds that images of half the size are looked at
# Of Adam, a step: places in sizes of the Gaussian, logarithms of scales, rotations, opacity, constant and other harmonics.
RATES = {"place": 0.1, "scale": 0.03, "rotation": 0.02, "opacity": 0.05, "colour": 0.04, "harmonics": 0.004}
FINAL = 0.1  # of the rates, at the end


@dataclass(frozen=True)
class SplatSettings:
    """`most` Gaussians, harmonics up to `degree`, `seconds` for the steps."""

    most: int = 150_000
    degree: int = 1
    seconds: float = 30.0
    seed: int = 0


def splats_of_field(
    field: Field, views: Views, working_from_input: Similarity, settings: SplatSettings, progress: Progress = SILENT
) -> Splats:
    """Gaussians that show what the field shows, in the input's frame, as bright as the training images were taken.

    Args:
        views: of the working frame; held-out ones are not looked at.

    Raises:
        InputError: another decoder than the deferred one, no training views, or nothing that they see.
        Interrupted: the user asked to stop before the steps; then those that were done are kept.
    """
    if not isinstance(field.decoder, Deferred):
        raise InputError("splats are made of fields with the deferred decoder; fit one with --decoder deferred")
    train = views.subset(np.flatnonzero(~np.asarray(views.test)))
    if len(train) == 0:
        raise InputError("splats are fitted to training views, and there are none; lower --holdout or give more images")
    targets = Targets(train, working_from_input)
    splats = start(field.to("cpu"), targets, settings, progress)
    return polished(splats, targets, settings, progress)


class Targets:
    """Training views as splats are to show them: in the input's frame, and as bright as they were taken."""

    def __init__(self, train: Views, working_from_input: Similarity) -> None:
        self.views, self.input_from_working = train, working_from_input.inverse()
        self.poses = self.input_from_working.poses(train.world_from_camera)
        self.exposure = train.exposure
        # Of an object that is cut out nothing is behind; what shows more than that shows it as Gaussians, so it is black as elsewhere.
        self.background = np.zeros(3) if train.background is None else self.shown(np.asarray(train.background))

    def __len__(self) -> int:
        return len(self.views)

    def shown(self, colours: Array) -> Array:
        """Colours (…, 3) in [0, 1] of the field, as the images were taken."""
        return exposed(np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8), self.exposure).astype(np.float32) / 255

    def image(self, index: int, shrink: int = 1) -> tuple[Intrinsics, Array, Array | None]:
        """Lens, colours (H, W, 3) float32 and valid pixels (H, W) or None of a view made smaller."""
        lens, image = self.views.intrinsics[index], exposed(self.views.images[index], self.exposure)
        valid = self.views.valid[index] if self.views.valid else None
        if shrink > 1:
            lens = lens.scaled(max(1, lens.width // shrink), max(1, lens.height // shrink))
            image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
            if valid is not None:
                valid = cv2.resize(valid.astype(np.float32), (lens.width, lens.height), interpolation=cv2.INTER_AREA) > 0.99
        return lens, image.astype(np.float32) / 255, valid


# ------------------------------------------------------------------------------------------------- what they begin with


def start(field: Field, targets: Targets, settings: SplatSettings, progress: Progress = SILENT) -> Splats:
    """A Gaussian for each of the voxels that hold some of a pixel's light; where these are too many, for eight voxels together."""
    views = targets.views
    threads = min(torch.get_num_threads(), MOST_THREADS)
    memory.require_splats(field, 4 * B.SUMS * min(field.voxels, MOST_VOXELS) * (threads + 1))
    weight = seen_weights(field, views.intrinsics, views.world_from_camera, progress)
    chosen = (weight > SEEN).nonzero().view(-1)
    if len(chosen) > MOST_VOXELS:
        chosen = chosen[weight[chosen].topk(MOST_VOXELS, sorted=False).indices].sort().values
    sums = _gathered(field, targets, chosen, progress)
    kept = sums[:, B.WEIGHT] > THRESHOLD
    if not kept.any():
        raise InputError("the training views see nothing of the field, so there is nothing to make splats of; fit it for longer")
    cells = _at_most(settings.most, _cells(field, chosen[torch.from_numpy(kept)], torch.from_numpy(sums[kept])))
    values, origin = _gaussians(field, cells, targets.input_from_working)
    if views.background is None:
        values = np.concatenate([values, _sky_gaussians(field, targets, origin)])
    wanted = G.HARMONICS + 3 * (settings.degree + 1) ** 2
    values = np.pad(values, ((0, 0), (0, max(0, wanted - values.shape[1]))))[:, :wanted]
    return Splats(np.ascontiguousarray(values, np.float32), origin)


def _gathered(field: Field, targets: Targets, chosen: Tensor, progress: Progress) -> Array:
    """(S, SUMS) sums of the voxels `chosen`."""
    views, threads = targets.views, min(torch.get_num_threads(), MOST_THREADS)
    slots = np.full(len(field.occupied), -1, np.int32)
    slots[chosen.numpy()] = np.arange(len(chosen), dtype=np.int32)
    space, volume, turn = make_space(field), make_volume(field), targets.input_from_working.rotation
    sums = np.zeros((threads, len(chosen), B.SUMS), np.float32)
    limits = np.float32(STOP), np.float32(THRESHOLD)
    pixels = sum(lens.width * lens.height for lens in views.intrinsics)
    stride = max(1, math.ceil(pixels / MOST_RAYS))
    for index in range(len(views)):
        progress.check()
        progress.update(index, len(views), "what training views see")
        lens, image, valid = targets.image(index)
        picked = np.arange(index % stride, lens.width * lens.height, stride)
        if valid is not None:
            picked = picked[valid.reshape(-1)[picked]]
        origins, directions, _ = rays(lens, views.world_from_camera[index], pixel_grid(lens.width, lens.height)[picked])
        seen = np.ascontiguousarray(directions.numpy() @ turn.T.astype(np.float32))
        given = (origins.numpy(), directions.numpy(), seen, image.reshape(-1, 3)[picked])

        def part(thread: int, given: tuple[Array, ...] = given) -> None:
            own = slices(len(given[0]), threads)
            if thread < len(own):
                B.gather_pass(space, volume, slots, *(values[own[thread]] for values in given), limits, sums[thread])

        share(part, range(threads), threads)
    return np.asarray(sums.sum(0) if threads > 1 else sums[0])


class _Cells(NamedTuple):
    """Cubes of voxels and what rays see of them."""

    corner: Tensor  # (S, 3) int64 lattice coordinates of the lowest voxel
    side: Tensor  # (S,) int64 voxels
    sums: Tensor  # (S, SUMS) places from the corner, in voxels

    def take(self, which: Tensor) -> _Cells:
        return _Cells(*(values[which] for values in self))


def _cells(field: Field, voxels: Tensor, sums: Tensor) -> _Cells:
    block, local = voxels.div(VOXELS, rounding_mode="floor"), voxels % VOXELS
    corner = field.topology.keys[block].long() * BLOCK + torch.stack([local % BLOCK, local // BLOCK % BLOCK, local // BLOCK**2], 1)
    return _Cells(corner, torch.ones(len(corner), dtype=torch.int64), sums)


def _at_most(most: int, cells: _Cells) -> _Cells:
    """No more than so many: eight become one where that loses least of what colours differ by, weighted by the light they are seen with."""
    while len(cells.side) > most:
        side = 2 * int(cells.side.max())
        parent = cells.corner.div(side, rounding_mode="floor")
        known, of = torch.unique((parent[:, 2] * MOST_SIDE + parent[:, 1]) * MOST_SIDE + parent[:, 0], return_inverse=True)
        count = torch.bincount(of)
        light, colour = cells.sums[:, B.WEIGHT], cells.sums[:, B.COLOURS : B.COLOURS + 3]
        apart = torch.zeros(len(known)).index_add_(0, of, colour.square().sum(1) / light)
        together = torch.zeros(len(known), 3).index_add_(0, of, colour).square().sum(1) / torch.zeros(len(known)).index_add_(0, of, light)
        order = (apart - together).argsort(descending=True)
        split = torch.zeros(len(known), dtype=torch.bool)
        split[order[: int((len(known) + torch.cumsum(count[order] - 1, 0) <= most).sum())]] = True
        stays, goes = split[of], (~split)[of]
        corner = torch.zeros(len(known), 3, dtype=torch.int64).index_copy_(0, of, parent * side)
        sums = torch.zeros(len(known), B.SUMS).index_add_(0, of[goes], _moved(cells.take(goes), corner[of[goes]]))
        joined = _Cells(corner[~split], torch.full((int((~split).sum()),), side), sums[~split])
        cells = _Cells(*(torch.cat(both) for both in zip(cells.take(stays), joined, strict=True)))
    return cells


def _moved(cells: _Cells, corner: Tensor) -> Tensor:
    """The cells' sums with places counted from other corners."""
    out, shift = cells.sums.clone(), (cells.corner - corner).float()
    light, place = out[:, B.WEIGHT, None], cells.sums[:, B.PLACE : B.PLACE + 3]
    out[:, B.PLACE : B.PLACE + 3] += light * shift
    row, column = torch.triu_indices(3, 3)
    out[:, B.SQUARE : B.SQUARE + 6] += (
        place[:, row] * shift[:, column] + shift[:, row] * place[:, column] + light * shift[:, row] * shift[:, column]
    )
    return out


def _gaussians(field: Field, cells: _Cells, back: Similarity) -> tuple[Array, Array]:
    """(S, 11 + 12) parameters of the cells' Gaussians in the input's frame, and the origin (3,) of their centres."""
    space, given = field.space, cells.sums
    light = given[:, B.WEIGHT]
    place = given[:, B.PLACE : B.PLACE + 3] / light[:, None]
    second = given[:, B.SQUARE : B.SQUARE + 6] / light[:, None]
    xx, xy, xz, yy, yz, zz = second.unbind(1)
    spread = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).view(-1, 3, 3) - place[:, :, None] * place[:, None]
    # Of few rays the spread is too small; an evenly filled voxel counts as one more.
    spread = (light[:, None, None] * spread + torch.eye(3) / 12) / (1 + light[:, None, None])
    contracted = (cells.corner + place.double()) * field.grid.voxel - space.extent
    centre = back.points(space.to_working(contracted).numpy())
    jacobian = _expansion(field, contracted) * (field.grid.voxel * space.half * back.scale)
    jacobian = torch.from_numpy(back.rotation) @ jacobian
    scales, turn = torch.linalg.eigh(jacobian @ spread.double() @ jacobian.transpose(1, 2))
    scales = SPREAD * scales.clamp_min(1e-24).sqrt()
    scales = torch.minimum(scales, LONGEST * scales[:, 1:2])
    opacity = 1 - (1 - (light / given[:, B.ENTERS]).clamp(LEAST_OPACITY, MOST_OPACITY)) ** (1 / OVERLAP)
    origin = back.points(np.asarray(space.centre))
    columns = (centre - origin, scales.log(), _quaternions(turn), torch.logit(opacity)[:, None], _fitted_harmonics(given).flatten(1))
    return np.concatenate([np.asarray(column, np.float32) for column in columns], 1), origin


def _expansion(field: Field, contracted: Tensor) -> Tensor:
    """(N, 3, 3) Jacobian of `Space.expand` at contracted places."""
    space = field.space
    out = torch.eye(3, dtype=contracted.dtype).repeat(len(contracted), 1, 1)
    norm, axis = contracted.abs().max(1)
    far = (norm > 1).nonzero().view(-1) if space.shell > 0 else norm[:0].long()
    n, place = norm[far], contracted[far]
    rest = (1 + space.shell - n).clamp_min(1e-4)
    scale = space.shell / (n * rest)
    slope = -scale * (rest - n) / (n * rest)
    sign = place.gather(1, axis[far, None]).sign().squeeze(1)
    out[far] *= scale[:, None, None]
    out[far] += place[:, :, None] * (slope * sign)[:, None, None] * torch.nn.functional.one_hot(axis[far], 3)[:, None]
    return out


def _quaternions(turn: Tensor) -> Array:
    """(N, 3, 3) orthogonal matrices → (N, 4) quaternions w, x, y, z; mirrored ones get another sign."""
    from scipy.spatial.transform import Rotation

    turn = turn * torch.linalg.det(turn)[:, None, None]
    return Rotation.from_matrix(turn.numpy()).as_quat()[:, [3, 0, 1, 2]]


def _fitted_harmonics(sums: Tensor) -> Tensor:
    """(S, 4, 3) coefficients c of degree 1 and less with Σ w |½ + Σ_k b_k c_k − colour|² and the squares of what depends on directions
    least."""
    rows, columns = torch.triu_indices(4, 4)
    matrix = torch.zeros(len(sums), 4, 4)
    matrix[:, rows, columns] = sums[:, B.BASES : B.BASES + 10]
    matrix[:, columns, rows] = sums[:, B.BASES : B.BASES + 10]
    right = sums[:, B.COLOURS : B.COLOURS + 12].view(-1, 4, 3) - 0.5 / SH_0 * matrix[:, 0, :, None]
    light = sums[:, B.WEIGHT]
    ridge = torch.tensor([1e-4, RIDGE, RIDGE, RIDGE]) * (1 + light[:, None])
    return torch.linalg.solve(matrix + torch.diag_embed(ridge), right)


def _cube_directions() -> Array:
    """(6 · SKY_SIDE², 3) unit vectors to the middles of the cells."""
    face, row, column = np.unravel_index(np.arange(6 * SKY_SIDE**2), (6, SKY_SIDE, SKY_SIDE))
    out, all_of = np.zeros((len(face), 3)), np.arange(len(face))
    out[all_of, face // 2] = np.where(face % 2, 1, -1)
    for step, at in ((1, row), (2, column)):
        out[all_of, (face // 2 + step) % 3] = np.tan(((at + 0.5) / SKY_SIDE - 0.5) * np.pi / 2)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _sky_gaussians(field: Field, targets: Targets, origin: Array) -> Array:
    """(6 · SKY_SIDE², 11 + 12) large Gaussians far behind all others, in the colours that the field has where it has nothing."""
    direction = _cube_directions()
    unit = torch.from_numpy(direction.astype(np.float32))
    colour = np.tile(field.background.numpy(), (len(unit), 1)) if field.sky is None else sky_colours(field.sky, unit).numpy()
    back = targets.input_from_working
    direction = back.directions(direction)
    far = SKY_FAR * max(np.linalg.norm(targets.poses[:, :3, 3] - origin, axis=1).max(), 2 * field.space.half * back.scale)
    out = np.zeros((len(direction), G.HARMONICS + 12), np.float32)
    out[:, :3] = far * direction
    out[:, G.SCALE : G.SCALE + 3] = np.log(far * (math.pi / 2) / SKY_SIDE * 0.6)
    out[:, G.ROTATION], out[:, G.OPACITY] = 1, 4
    out[:, G.HARMONICS : G.HARMONICS + 3] = (targets.shown(colour) - 0.5) / SH_0
    return out


# ------------------------------------------------------------------------------------------------- steps


def polished(
    splats: Splats, targets: Targets, settings: SplatSettings, progress: Progress = SILENT, ticks: Callable[[], float] = time.perf_counter
) -> Splats:
    """The same Gaussians after so many steps as there are seconds for; what cannot be seen any more is left out."""
    values = splats.values.copy()
    state = G.Moments(np.zeros_like(values), np.zeros_like(values), np.zeros(len(values), np.uint16))
    sizes = np.exp(values[:, G.SCALE : G.SCALE + 3].mean(1))
    rates = _rates(values.shape[1])
    rng, clock, done = np.random.default_rng(settings.seed), Clock(ticks), 0.0
    while done < 1 and not progress.stopping():
        for index in rng.permutation(len(targets)):
            done = clock.seconds() / max(settings.seconds, 1e-9)
            if done >= 1 or progress.stopping():
                break
            progress.update(done, 1, "steps")
            lens, image, valid = targets.image(index, 2 if done < SMALL else 1)
            camera = _camera(targets, splats, index, lens)
            drawn = draw(values, camera)
            slope = _slope(drawn, image, valid, targets.background)
            _step(values, camera, drawn, slope, state, (rates * FINAL**done).astype(np.float32), sizes)
    kept = values[:, G.OPACITY] > math.log(2 / 255)
    return replace(splats, values=values[kept & np.isfinite(values).all(1)])


def _camera(targets: Targets, splats: Splats, index: int, lens: Intrinsics) -> G.Lens:
    pose = targets.poses[index].copy()
    pose[:3, 3] -= splats.origin
    return make_lens(lens, pose, 1e-3 * float(np.linalg.norm(pose[:3, 3])))


def _rates(parameters: int) -> Array:
    rates = np.full(parameters, RATES["harmonics"])
    rates[: G.SCALE], rates[G.SCALE : G.ROTATION], rates[G.ROTATION : G.OPACITY] = RATES["place"], RATES["scale"], RATES["rotation"]
    rates[G.OPACITY], rates[G.HARMONICS : G.HARMONICS + 3] = RATES["opacity"], RATES["colour"]
    return rates


def _slope(drawn: Drawn, image: Array, valid: Array | None, background: Array) -> Array:
    """(H, W, 4) of half the squared error: its slope over red, green and blue, and Σ of these times the colours."""
    shown = drawn.image[..., :3] + drawn.image[..., 3:4] * background.astype(np.float32)
    slope = np.empty((*image.shape[:2], 4), np.float32)
    slope[..., :3] = shown - image
    if valid is not None:
        slope[~valid] = 0
    slope[..., 3] = (slope[..., :3] * shown).sum(2)
    return slope


def _step(values: Array, lens: G.Lens, drawn: Drawn, slope: Array, state: G.Moments, rates: Array, sizes: Array) -> None:
    threads, partials = torch.get_num_threads(), backward(drawn, slope)
    known = (drawn.projected, drawn.ahead, drawn.places, partials)

    def part(piece: slice) -> None:
        G.adam_pass(values, lens, *known, piece.start, piece.stop, state, rates, sizes)

    share(part, slices(len(values), PARTS * threads), threads)
