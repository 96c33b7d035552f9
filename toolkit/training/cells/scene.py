"""A scene as cells on disk: what a worker needs to fit one of them, and nothing else.

A folder holds

    coarse.safetensors      the coarse field
    cells.safetensors       blocks of the coarse field, their owners, and the rays that see them
    pixels-003.safetensors  the training pixels of a cell
    plan.json               the rest, written last
    cell-003.safetensors    a fitted cell, with its halo

so workers share storage and no memory, and whatever is there need not be made again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from fieldfuse.backends.constants import BLOCK
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings, checked, load_settings, settings_dict
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.files import atomic_path, read_json, remove, write_json
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.bake import seen_weights
from fieldfuse.render.field import Field
from fieldfuse.training.cells.fit import COARSER, CellPlan, FittedCell, fit_cell
from fieldfuse.training.cells.merge import NotCoveredError, check_coverage, merged
from fieldfuse.training.cells.partition import Cells, cut, region_mask
from fieldfuse.training.cells.pixels import Sight, pools
from fieldfuse.training.engine import warm_up
from fieldfuse.training.fit import DEFAULT_BUDGET, Begin, FitResult
from fieldfuse.training.guided import fit_guided
from fieldfuse.training.levels import pruned
from fieldfuse.training.losses import FINE, ROUGH
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.start import finest_resolution, space_of
from fieldfuse.volume.edit import dilate

LEAST_RESOLUTION = 32  # of a coarse field
LEAST_LEFT = 0.1  # of the seconds, for all cells
PIXELS_A_CELL = 8_000_000  # of training images, where the number of cells is chosen (`auto`)
# Memory of a cell's fit: libraries, kernels and the coarse field; a value of a lattice corner, with what Adam keeps of it.
BASE, CORNER_BYTES = 700 * 2**20, 12
COARSE, CELLS, PLAN = "coarse.safetensors", "cells.safetensors", "plan.json"


@dataclass(frozen=True)
class ScenePlan:
    """What all cells have in common (plain data).

    Attributes:
        key: identity of all that went in.
        settings: of the run, plain.
        count: cells.
        resolution: of the finest lattice.
        done_before: share of the whole fit that the coarse field was.
        rays_before, steps_before, seconds_before: that it took, seconds with the cut.
        shares: of the scene's pixels, by cell; a pixel may be seen in several.
        seconds: of each cell. steps: of every cell, None: without end.
        memory: bytes that the fit of each takes at most, roughly.
        slow_within: working units.
        rough: whether depth was matched quickly, and is trusted less.
        opaque: whether every ray ends somewhere.
    """

    key: str
    settings: dict[str, Any]
    count: int
    resolution: int
    done_before: float
    rays_before: int
    steps_before: int
    seconds_before: float
    shares: list[float]
    seconds: list[float]
    steps: int | None
    memory: list[int]
    slow_within: float
    rough: bool
    opaque: bool


def coarse_resolution(views: Views, scene: Scene, settings: Settings) -> int:
    """Of the lattice that a scene is cut on."""
    train = views.subset(np.flatnonzero(~views.test))
    finest = settings.field.resolution or finest_resolution(space_of(views, scene, settings.field.background), train, scene)
    return max(LEAST_RESOLUTION, finest // (COARSER * BLOCK * 2) * BLOCK * 2)


def fit_coarse(
    views: Views,
    scene: Scene,
    settings: Settings,
    progress: Progress = SILENT,
    begin: Begin = Begin(),  # noqa: B008 (frozen)
    ticks: Callable[[], float] = time.perf_counter,
) -> FitResult:
    """The first part of a fit in one piece: all of it but its finest level, which cells are to fit. `done` of the result is its share, 1
    where seconds or steps are too few for that level.

    Args and errors as of `fit_guided`.
    """
    resolution = coarse_resolution(views, scene, settings)
    coarse = replace(settings, field=replace(settings.field, resolution=resolution))
    return fit_guided(views, scene, coarse, progress, replace(begin, until=COARSER * resolution), ticks)


def cell_count(views: Views, settings: Settings) -> int:
    """Into how many cells a scene is to be cut; 1: it is fitted in one piece.

    `auto` goes by the pixels of the training images, which are known before anything is fitted, and not by who will fit the cells.
    """
    if settings.fit.cells != "auto":
        return int(settings.fit.cells) if settings.fit.cells != "off" else 1
    pixels = sum(lens.width * lens.height for lens, test in zip(views.intrinsics, views.test, strict=True) if not test)
    return max(1, round(pixels / PIXELS_A_CELL))


def write_scene(
    folder: Path,
    key: str,
    result: FitResult,
    scene: Scene,
    settings: Settings,
    progress: Progress = SILENT,
    ticks: Callable[[], float] = time.perf_counter,
) -> ScenePlan:
    """Cut a scene by its coarse field into `cell_count` cells. They share the seconds that are left.

    Args:
        result: of `fit_coarse`, whose views the cells are fitted to.
        ticks: the clock that the budget is counted on.

    Raises:
        InputError: training rays see nothing of the field.
        OutputError: the folder cannot be written.
        Interrupted: the user asked to stop.
    """
    if (shown := result.views) is None:
        raise ValueError("a result that was not just fitted has no views")
    began = ticks()
    train = shown.subset(np.flatnonzero(~shown.test))
    coarse = result.field
    least = settings.fit.prune_weight
    seen = seen_weights(coarse, train.intrinsics, train.world_from_camera, progress, least) > least
    coarse = pruned(coarse, dilate(coarse.topology, seen, 1, grow=False)[1]).settled()
    sight = Sight(coarse, settings.threads)
    rays = sight.rays_of_blocks(train)
    if not rays.any():
        raise InputError("training rays see nothing of the coarse field, so it cannot be cut into cells; give it more --budget")
    voxels = coarse.occupied.view(-1, BLOCK**3).sum(1).numpy()
    # Seconds go by rays, memory by voxels: cells are to be alike in both.
    cells = cut(coarse.topology.keys.numpy(), np.sqrt(rays * voxels.astype(np.float64)), cell_count(shown, settings))
    coarse.save(folder / COARSE, scene.working_from_input)
    owners = {"keys": cells.keys, "owner": cells.owner, "rays": rays}
    write_tensors(folder / CELLS, {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in owners.items()})
    whole, sizes, memory = sum(lens.width * lens.height for lens in train.intrinsics), [], []
    for cell, pool in enumerate(pools(train, cells, sight, settings.fit.depth > 0)):
        progress.check()
        progress.update(cell, cells.count, "pixels of cells")
        sizes.append(len(pool))
        arrays = pool.arrays()
        write_tensors(folder / f"pixels-{cell:03}.safetensors", arrays, {"height": str(pool.height)})
        region = int(region_mask(coarse, cells, cell, coarse.resolution, COARSER * coarse.resolution).sum())
        corners = COARSER**3 * region * CORNER_BYTES * (coarse.feature_rows.shape[1] + 1)
        memory.append(BASE + 2 * sum(values.nbytes for values in arrays.values()) + corners)
    budget, steps = settings.fit.budget or DEFAULT_BUDGET, settings.fit.iterations
    spent = result.seconds + ticks() - began
    # What a fit in one piece would have on this machine: cells have one thread each, however many are fitted side by side.
    left = max(budget - spent, LEAST_LEFT * budget) * (settings.threads or torch.get_num_threads())
    plan = ScenePlan(
        key=key,
        settings=settings_dict(settings),
        count=cells.count,
        resolution=COARSER * coarse.resolution,
        # With steps by these alone: equal ones are to give equal fields.
        done_before=result.done if steps is None else result.steps / steps,
        rays_before=result.rays,
        steps_before=result.steps,
        seconds_before=spent,
        shares=[size / whole for size in sizes],
        seconds=[left * size / sum(sizes) for size in sizes],
        steps=None if steps is None else max(1, steps - result.steps),
        memory=memory,
        slow_within=settings.fit.slow_within * scene.median_depth,
        rough=shown.rough,
        opaque=shown.background is None,
    )
    write_json(folder / PLAN, asdict(plan))
    return plan


def write_tensors(path: Path, tensors: dict[str, torch.Tensor], about: dict[str, str] | None = None) -> None:
    """Write tensors by name, and remarks on them.

    Raises:
        OutputError: they cannot be written.
    """
    with atomic_path(path) as temporary:
        save_file({name: values.contiguous() for name, values in tensors.items()}, temporary, about)


def read_plan(folder: Path) -> ScenePlan | None:
    """The plan of a folder; None: there is none, or it cannot be used."""
    try:
        return checked(ScenePlan, read_json(folder / PLAN), PLAN)
    except InputError:
        return None


@lru_cache(maxsize=1)
def coarse_of(folder: Path, key: str) -> tuple[Field, Cells, np.ndarray[Any, Any]]:
    """The coarse field and its cells; a worker that fits several cells of a scene reads them once."""
    with _reading(folder / CELLS) as file:
        keys, owner, rays = (file.get_tensor(name).numpy() for name in ("keys", "owner", "rays"))
    return Field.load(folder / COARSE), Cells(keys, owner, int(owner.max()) + 1), rays


def _reading(path: Path) -> Any:
    try:
        return safe_open(path, framework="pt")
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path} cannot be read ({error}); remove its folder and start the run again") from error


def cell_path(folder: Path, cell: int) -> Path:
    return folder / f"cell-{cell:03}.safetensors"


def fitted_cell(folder: Path, plan: ScenePlan, cell: int) -> dict[str, Any] | None:
    """What is known of a fitted cell: key, seconds, steps, rays, voxels; None: it is not fitted."""
    path = cell_path(folder, cell)
    try:
        found = read_json(path.with_suffix(".json"))
    except InputError:
        return None
    return found if isinstance(found, dict) and found.get("key") == plan.key and path.is_file() else None


def missing(folder: Path, plan: ScenePlan) -> list[int]:
    """The cells that are not fitted yet."""
    return [cell for cell in range(plan.count) if fitted_cell(folder, plan, cell) is None]


def remove_pixels(folder: Path) -> None:
    """Once all cells are fitted nobody needs them; they are as large as the images."""
    for path in folder.glob("pixels-*.safetensors"):
        remove(path)


def fit_cell_of(argument: tuple[str, int], progress: Progress, ticks: Callable[[], float] = time.perf_counter) -> dict[str, Any]:
    """Fit a cell, and write it into the scene's folder: the task of a worker.

    Args:
        argument: the folder, and the cell.

    Raises:
        InputError: the folder cannot be read. OutputError: it cannot be written.
        Interrupted: it was stopped before the cell was done.
    """
    folder, cell = Path(argument[0]), argument[1]
    plan = read_plan(folder)
    if plan is None:
        raise InputError(f"{folder / PLAN} is not there or damaged; start the run again")
    if (known := fitted_cell(folder, plan, cell)) is not None:
        return known
    coarse, cells, _ = coarse_of(folder, plan.key)
    settings = load_settings(plan.settings["preset"], stored=plan.settings)
    with _reading(folder / f"pixels-{cell:03}.safetensors") as file:
        names = ("colour", "places", "starts", "distance", "camera", "pose")
        pool = PixelPool.of([file.get_tensor(name) for name in names], int(file.metadata()["height"]))
    warm_up(replace(settings, device="cpu"), progress)
    of_cell = CellPlan(
        cell=cell,
        rays_before=plan.rays_before,
        done_before=plan.done_before,
        share=plan.shares[cell],
        seconds=plan.seconds[cell],
        steps=plan.steps,
        slow_within=plan.slow_within,
        trust=ROUGH if plan.rough else FINE,
        opaque=plan.opaque,
        seed=settings.seed + cell,
    )
    done: FittedCell = fit_cell(coarse, cells, pool, settings, of_cell, progress, ticks)
    if done.interrupted:
        raise Interrupted
    path = cell_path(folder, cell)
    done.field.save(path)
    facts = {"key": plan.key, "seconds": round(done.seconds, 3), "steps": done.steps, "rays": done.rays, "voxels": done.field.voxels}
    write_json(path.with_suffix(".json"), facts)
    return facts


def merge_scene(folder: Path, plan: ScenePlan) -> tuple[Field, list[str]]:
    """One field of all cells, and what there is to say about it.

    Raises:
        NotCoveredError: a part of the scene is missing. InputError: a file cannot be read.
    """
    coarse, cells, rays = coarse_of(folder, plan.key)
    if absent := missing(folder, plan):
        raise NotCoveredError(f"{len(absent)} of {plan.count} cells are not fitted; start the run again, and it fits them")
    field = merged(coarse, cells, lambda cell: Field.load(cell_path(folder, cell)))
    return field, check_coverage(coarse, rays, cells, field)
