"""The weights in the repository: they load, they are small, and they know more than untrained networks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from fieldfuse.nerfusion import weights
from fieldfuse.nerfusion.model import ModelConfig, NerfusionModel
from fieldfuse.nerfusion.training.procedural import ProceduralScene
from fieldfuse.nerfusion.training.samples import draw_sample
from fieldfuse.nerfusion.training.step import LOCAL, StepLoss, Stepper, local_of, seeded
from tests.nerfusion.training.tiny import tiny_settings

FILE = Path(weights.__file__).parent / "weights" / "nerfusion.safetensors"


def measured(model: NerfusionModel) -> dict[str, float]:
    """Means over a few scenes that no training run draws (their seeds are not of its streams)."""
    settings = tiny_settings(loss={"rays": 512}, volume={"voxels_to_median": [20.0, 20.0], "most": 40, "closed": 1.0})
    stepper, rows = Stepper(model, settings), []
    with torch.no_grad():
        for seed in range(4):
            scene = ProceduralScene("object", np.random.default_rng([99, seed]), 144, 12)
            sample = draw_sample(scene, np.random.default_rng(seed), settings.pictures, settings.volume, 1)
            loss = StepLoss(stepper, sample, 0, seeded(0, 0, 0))
            loss(local_of(model, sample, 0), sample.targets[0], sample.references[0], 512, LOCAL)
            rows.append(loss.outcome.means())
    return {name: float(np.mean([row[name] for row in rows])) for name in ("psnr_local", "depth_likelihood", "depth_error")}


def test_shipped_weights_load_and_see_depth() -> None:
    assert FILE.stat().st_size <= 10 * 2**20
    model = weights.load_model(FILE)
    assert model.config == ModelConfig()
    torch.manual_seed(0)
    trained, untrained = measured(model), measured(NerfusionModel().eval())
    # Untrained networks begin with the plane sweep and mean colours, so they are no straw man: 3.2% median depth error, 13.7 dB.
    assert trained["psnr_local"] > untrained["psnr_local"] + 1.5, (trained, untrained)
    assert trained["depth_likelihood"] > untrained["depth_likelihood"] + 0.15, (trained, untrained)
    assert trained["depth_error"] < min(untrained["depth_error"], 0.035), (trained, untrained)
