"""Training with witnesses: a sample's sweeps against those that direct inference makes of the same pictures, and a step with them."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from fieldfuse.nerfusion.extras.cross_view_consistency import confident_points, consistency, cross_view
from fieldfuse.nerfusion.extras.matching import patch_descriptors
from fieldfuse.nerfusion.extras.plane_sweep import cost_volume, to_probability
from fieldfuse.nerfusion.training.distributed import Crew
from fieldfuse.nerfusion.training.mixture import Mixture
from fieldfuse.nerfusion.training.samples import keyframe_distributions
from fieldfuse.nerfusion.training.train import Trainer
from tests.nerfusion.training.tiny import tiny_settings


def test_a_samples_sweeps_are_held_against_each_other() -> None:
    sample = Mixture(tiny_settings()).sample(0, 2)
    descriptors = patch_descriptors(sample.pictures.images)
    first, second = (
        cost_volume([descriptors[k] for k in indices], sample.pictures.cameras(indices), sample.near, sample.far)
        for indices in sample.references
    )
    own_estimate = to_probability(first)
    correction = consistency(first, [cross_view(to_probability(second))], confident_points(first, own_estimate))
    distribution = keyframe_distributions(sample)
    assert len(distribution) == 2 and not torch.equal(distribution[0].table, own_estimate.table)
    torch.testing.assert_close(distribution[0].table, to_probability(first, correction=correction).table)
    assert distribution[0].lowest == own_estimate.lowest and distribution[0].step == own_estimate.step


def test_one_key_frame_has_no_witness() -> None:
    sample = Mixture(tiny_settings()).sample(0, 1)
    indices = sample.references[0]
    descriptors = patch_descriptors(sample.pictures.images)
    costs = cost_volume([descriptors[k] for k in indices], sample.pictures.cameras(indices), sample.near, sample.far)
    (distribution,) = keyframe_distributions(sample)
    assert torch.equal(distribution.table, to_probability(costs).table)


def test_a_step_with_witnesses_learns_something_else(tmp_path: Path) -> None:
    rows = []
    for witnesses in (False, True):
        settings = tiny_settings(stage={"steps": 0, "fused_steps": 2, "most_split": 100, "witnesses": witnesses})
        rows.append(Trainer(settings, tmp_path / str(witnesses), Crew()).one_step())
    assert all(math.isfinite(row["loss"]) and row["skipped"] == 0 for row in rows)
    assert rows[0]["loss"] != rows[1]["loss"]
