"""A training run that is small enough for tests."""

from __future__ import annotations

from typing import Any

from fieldfuse.nerfusion.training.settings import TrainSettings, load_train_settings

SMALL: dict[str, Any] = {
    "device": "cpu",
    "window": 2,
    "reuse": 2,
    "model": {"image_channels": 16, "sampled": 8, "direction": 4, "hidden": 8, "channels": 8, "gru_hidden": 8, "features": 8},
    "pictures": {"long_side": [48, 48], "frames": 12, "views": 3, "key_frames": 2, "targets": 2},
    "volume": {"voxels_to_median": [8.0, 10.0], "most": 24},
    "loss": {"rays": 96, "depth_steps": 2},
    "stage": {"steps": 2, "fused_steps": 2, "most_split": 100},
    "optimiser": {"warmup": 2},
    "record": {"log_every": 1, "health_every": 100, "checkpoint_every": 100},
}


def merged(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    out = dict(first)
    for key, value in second.items():
        out[key] = merged(out[key], value) if isinstance(value, dict) and isinstance(out.get(key), dict) else value
    return out


def tiny_settings(**changes: Any) -> TrainSettings:
    return load_train_settings(data=merged(SMALL, changes))
