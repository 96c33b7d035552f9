"""`python -m benchmarks.cells CAPTURE --budget 120 --cells 8`: a field fitted in cells beside one that is fitted in one piece.

Both get the same seconds of one core, all in this process and on its processor's clock, so that other work does not count. Rows:

- what held-out views score, whole, and pixel by pixel beside borders of cells (the surface is at most `BESIDE` voxels away) and elsewhere;
- the most memory that a fit took beyond what this process had before it, libraries and kernels included (of cells: the largest).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from benchmarks.experiment import Experiment, Folder, Row, application, markdown, program, section, show
from fieldfuse import steps
from fieldfuse.api import load
from fieldfuse.camera import Array, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet
from fieldfuse.pipelines.stages import PeakMemory
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.training.cells import scene as cells
from fieldfuse.training.cells.partition import Cells
from fieldfuse.training.engine import warm_up
from fieldfuse.training.fit import Begin
from fieldfuse.training.guided import fit_guided
from fieldfuse.volume.grid import host_for

BESIDE = 4  # voxels from a border of two cells
TITLES = {
    "way": "",
    "psnr": "PSNR",
    "beside": "beside borders",
    "elsewhere": "elsewhere",
    "seconds": "seconds",
    "memory_mb": "memory, MB",
    "voxels": "voxels",
}


def run(
    capture: Annotated[Path, typer.Argument(help="A posed capture.")],
    budget: Annotated[float, typer.Option(help="Seconds of one core, in all.")] = 120.0,
    count: Annotated[int, typer.Option("--cells", min=2, help="Cells.")] = 8,
    image_size: Annotated[int, typer.Option(help="Long side of the images in pixels.")] = 320,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    out: Folder = None,
    quiet: Quiet = False,
) -> None:
    """Fit a capture in one piece and in cells."""
    torch.set_num_threads(1)
    progress = make_progress(quiet)
    loaded = load(capture, image_size=image_size, threads=1, seed=seed)
    settings = replace(loaded.settings, device="cpu", threads=1)
    settings.fit.budget, settings.fit.cells = budget, count
    bench = Bench(loaded.views, loaded.geometry, settings)
    plan = [{"capture": capture.name, "budget": budget, "image_size": image_size, "cells": count, "seed": seed, "way": way} for way in WAYS]
    with tempfile.TemporaryDirectory(prefix="fieldfuse-cells-") as folder:
        experiment = Experiment("cells", plan, lambda entry: bench.row(entry["way"], Path(folder)), table)
        show(section(experiment.conduct(out, progress, 1), table), quiet)


WAYS = ("cells", "one piece")


@dataclass
class Bench:
    """One capture, fitted in both ways."""

    views: Views
    scene: Scene
    settings: Settings
    borders: tuple[Cells, int] | None = None  # of the cells, and how much finer the fields' lattice is than theirs
    coarse_seconds: float = 0.0  # of the last fit in cells

    def row(self, way: str, folder: Path) -> Row:
        warm_up(self.settings, SILENT)
        field, seconds, memory = self.in_cells(folder) if way == "cells" else self.in_one_piece()
        lenses = [lens for lens, test in zip(self.views.intrinsics, self.views.test, strict=True) if not test]
        facts = {"seconds": round(seconds, 1), "memory_mb": round(memory), "voxels": field.voxels}
        if way == "cells":
            facts["coarse_seconds"] = round(self.coarse_seconds, 1)
        return {**self.scores(field), **facts, "megapixels": round(sum(lens.width * lens.height for lens in lenses) / 1e6, 2)}

    def in_one_piece(self) -> tuple[Field, float, float]:
        with Watch() as watch:
            steps.set_seeds(self.settings.seed)
            result = fit_guided(self.views, self.scene, self.settings, begin=Begin(host_for("cpu")), ticks=time.process_time)
        return result.field, watch.seconds, watch.megabytes

    def in_cells(self, folder: Path) -> tuple[Field, float, float]:
        with Watch() as before:
            steps.set_seeds(self.settings.seed)
            coarse = cells.fit_coarse(self.views, self.scene, self.settings, begin=Begin(host_for("cpu")), ticks=time.process_time)
            if coarse.done == 1:
                raise InputError("the budget is too small for cells; give more --budget")
            plan = cells.write_scene(folder, "benchmark", coarse, self.scene, self.settings, ticks=time.process_time)
        watches = []
        for cell in range(plan.count):
            with Watch() as watch:
                cells.fit_cell_of((str(folder), cell), SILENT, time.process_time)
            watches.append(watch)
        with Watch() as after:
            field, _ = cells.merge_scene(folder, plan)
        _, known, _ = cells.coarse_of(folder, plan.key)
        self.borders = known, plan.resolution // coarse.field.resolution
        seconds, self.coarse_seconds = sum(watch.seconds for watch in (before, *watches, after)), before.seconds
        return field, seconds, max(watch.megabytes for watch in watches)

    def scores(self, field: Field) -> Row:
        """PSNR of all held-out pixels' views, and of pixels beside borders and elsewhere."""
        view, errors, near = make_renderer(field, threads=1), [], []
        for index in np.flatnonzero(self.views.test):
            camera, pose = self.views.intrinsics[index], self.views.world_from_camera[index]
            shown = render_view(field, camera, pose, view)
            valid = self.views.valid[index] if self.views.valid else None
            error = np.square(shown.rgb - self.views.images[index] / np.float32(255)).mean(2).reshape(-1)
            origins, directions, cosine = rays(camera, pose, pixel_grid(camera.width, camera.height))
            place = origins + directions * (torch.from_numpy(shown.depth).view(-1) / cosine)[:, None]
            use = (np.ones(len(error), bool) if valid is None else valid.reshape(-1)) & (shown.depth.reshape(-1) > 0)
            errors.append((error[use], error if valid is None else error[valid.reshape(-1)]))
            near.append(self.beside(field, place[torch.from_numpy(use)]))
        both, beside = np.concatenate([one for one, _ in errors]), np.concatenate(near)
        return {
            "psnr": round(float(np.mean([_psnr(whole) for _, whole in errors])), 3),
            "beside": round(_psnr(both[beside]), 3) if beside.any() else None,
            "elsewhere": round(_psnr(both[~beside]), 3),
            "share_beside": round(float(beside.mean()), 4),
        }

    def beside(self, field: Field, places: torch.Tensor) -> Array:
        """(N, 3) working frame → (N,) bool: at most `BESIDE` voxels from another cell."""
        assert self.borders is not None
        known, ratio = self.borders
        lattice = (field.space.contract(field.space.normalise(places)) + field.space.extent).numpy() / field.grid.voxel
        owners = [
            known.owner_of(np.floor((lattice + BESIDE * np.array(shift)) / 8).astype(np.int64), ratio)
            for shift in ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
        ]
        return np.asarray(np.any([(other != owners[0]) & (other >= 0) for other in owners[1:]], axis=0))


def _psnr(errors: Array) -> float:
    return float(-10 * np.log10(max(errors.mean(), 1e-10)))


class Watch:
    """Seconds of processor, and the most memory beyond what there was before."""

    def __enter__(self) -> Watch:
        self._memory = PeakMemory()
        self._memory.__enter__()
        self._before, self._began = self._memory.own, time.process_time()
        return self

    def __exit__(self, *_: Any) -> None:
        self.seconds = time.process_time() - self._began
        self._memory.__exit__(None, None, None)
        self.megabytes = self._memory.own - self._before


def table(data: Row) -> str:
    """Markdown: a line a way."""
    return markdown(list(TITLES.values()), [[_cell(row.get(name)) for name in TITLES] for row in data["rows"]])


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


app = application(run)
if __name__ == "__main__":
    program(app)
