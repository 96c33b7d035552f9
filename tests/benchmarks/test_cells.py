"""The benchmark of cells: which places lie beside borders, and its table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from benchmarks.cells import BESIDE, Bench, table
from fieldfuse.config import load_settings
from fieldfuse.training.cells.partition import Cells
from tests.render.made import random_field
from tests.training.test_fit import scene, sphere_views


def test_places_beside_borders_are_those_few_voxels_from_another_cell() -> None:
    field = random_field(0.0, 32)
    keys = field.topology.keys.numpy()
    bench = Bench(sphere_views(4), scene(), load_settings(), (Cells(keys, (keys[:, 0] >= 2).astype(np.int32), 2), 1))
    x = torch.tensor([16 - BESIDE - 0.5, 16 - BESIDE + 0.5, 15.5, 16.5, 16 + BESIDE - 0.5, 16 + BESIDE + 0.5])
    lattice = torch.stack([x, torch.full_like(x, 12.5), torch.full_like(x, 12.5)], 1)
    places = field.space.to_working(lattice * field.grid.voxel - field.space.extent)
    assert bench.beside(field, places).tolist() == [False, True, True, True, True, False]


def test_scores_tell_borders_from_the_rest() -> None:
    views = sphere_views(8)
    field = random_field(0.0, 32)
    keys = field.topology.keys.numpy()
    bench = Bench(replace(views, test=np.arange(8) < 2), scene(), load_settings(), (Cells(keys, (keys[:, 2] >= 2).astype(np.int32), 2), 1))
    found = bench.scores(field)
    assert 0 < found["share_beside"] < 1 and 0 < found["psnr"] < 30
    assert "| cells |" in table({"rows": [{"way": "cells", **found}]})
