"""How saturated the fusion's gates are, read from the running GRU by hooks, without touching it."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from fieldfuse.nerfusion.gru import FusionGRU
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.health import saturation

Tensor = torch.Tensor


class GateWatch:
    """Shares of saturated values of the update and the reset gate since the last question.

    The update gate's known part (how many key frames a voxel was in) is not counted: what is watched is what was learned.
    """

    def __init__(self, model: NerfusionModel) -> None:
        self.on = False
        self._seen: dict[str, list[float]] = {}
        if isinstance(model.fusion, FusionGRU):
            for name in ("update", "reset"):
                getattr(model.fusion, name).register_forward_hook(self._hook(f"gate_{name}_saturated"))

    def _hook(self, name: str) -> Any:
        def look(_module: nn.Module, inputs: tuple[Any, ...], output: Tensor) -> None:
            if self.on:
                inside = inputs[2]
                values = output.detach()[: len(inside)][inside]
                self._seen.setdefault(name, []).append(saturation(torch.sigmoid(values)))

        return look

    def shares(self) -> dict[str, float]:
        """Means since the last question; empty when no gate was used."""
        seen, self._seen = self._seen, {}
        return {name: sum(values) / len(values) for name, values in seen.items()}
