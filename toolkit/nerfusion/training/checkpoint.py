"""Checkpoints of a training run: weights, Adam's moments and the step as one safetensors file.

Nothing else needs storing: every random choice of a run is drawn from (seed, step, process), so a run that is resumed takes the same steps,
bit for bit on the CPU, as one that never stopped.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.training.optimiser import Average, NonfinitePolicy

MODEL, FIRST, SECOND, COUNT, AVERAGE = "model.", "adam.first.", "adam.second.", "adam.step.", "average."
FORMAT = "fieldfuse-training-1"


@dataclass
class TrainState:
    """What a training run changes."""

    model: nn.Module
    adam: torch.optim.Adam
    average: Average | None = None
    policy: NonfinitePolicy = field(default_factory=NonfinitePolicy)
    step: int = 0  # steps taken


def save_checkpoint(folder: Path, state: TrainState, settings: dict[str, Any], keep: int) -> Path:
    """Write a state, and remove all but the newest `keep` checkpoints.

    Raises:
        OutputError: it cannot be written.
    """
    tensors = {MODEL + name: value for name, value in state.model.state_dict().items()}
    for name, parameter in state.model.named_parameters():
        own = state.adam.state.get(parameter)
        if own:
            tensors[FIRST + name], tensors[SECOND + name] = own["exp_avg"], own["exp_avg_sq"]
            tensors[COUNT + name] = torch.as_tensor(own["step"], dtype=torch.float32).reshape(1)
    if state.average is not None:
        tensors |= {AVERAGE + name: value for name, value in state.average.values.items()}
    meta = {"format": FORMAT, "step": str(state.step), "settings": json.dumps(settings), "caution": json.dumps(asdict(state.policy))}
    path = folder / f"checkpoint-{state.step:07d}.safetensors"
    with atomic_path(path) as temporary:
        save_file({name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, temporary, metadata=meta)
    for old in checkpoints(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def checkpoints(folder: Path) -> list[Path]:
    """Checkpoints in a folder, oldest first."""
    return sorted(folder.glob("checkpoint-*.safetensors"))


def load_checkpoint(path: Path, state: TrainState) -> dict[str, Any]:
    """Put a checkpoint into `state`; answers the settings that it was trained with.

    Raises:
        InputError: not a checkpoint, or one of other networks.
    """
    try:
        with safe_open(path, "pt") as file:
            tensors, meta = {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InputError(f"cannot read {path} ({first_line(error)}); it is missing or not a safetensors file") from error
    try:
        settings = json.loads(meta["settings"])
        if not isinstance(settings, dict):
            raise ValueError("its settings are not an object")
        # Checkpoints of early versions have no record of bad steps.
        policy = NonfinitePolicy.from_dict(json.loads(meta["caution"])) if "caution" in meta else NonfinitePolicy()
    except (KeyError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a training checkpoint ({first_line(error)}); choose another") from error
    try:
        step = int(meta["step"])
        if meta["format"] != FORMAT:
            raise ValueError(f"format {meta['format']!r}")
        _fill(state.model, _part(tensors, MODEL))
        for name, parameter in state.model.named_parameters():
            if FIRST + name not in tensors:
                state.adam.state.pop(parameter, None)
                continue
            first, second = tensors[FIRST + name], tensors[SECOND + name]
            if first.shape != parameter.shape or second.shape != parameter.shape:
                raise ValueError(f"the optimiser's state of {name} has another shape")
            moments = {"exp_avg": first.to(parameter.device).clone(), "exp_avg_sq": second.to(parameter.device).clone()}
            state.adam.state[parameter] = {"step": tensors[COUNT + name].reshape(()).clone(), **moments}
        if state.average is not None:
            state.average.load(_part(tensors, AVERAGE))
    except (KeyError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path} is not a checkpoint of these networks ({first_line(error)}); go on with the settings it was made "
            "with, or start anew in another folder"
        ) from error
    state.step, state.policy = step, policy
    return settings


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def _fill(model: nn.Module, values: dict[str, Tensor]) -> None:
    """`load_state_dict` with a first line that names what is wrong."""
    own = model.state_dict()
    if odd := sorted(own.keys() ^ values.keys()):
        raise ValueError(f"{odd[0]} is {'not in it' if odd[0] in own else 'not one of theirs'}")
    for name, value in values.items():
        if value.shape != own[name].shape:
            there, here = ("×".join(map(str, one.shape)) or "one number" for one in (value, own[name]))
            raise ValueError(f"{name} is {there} there and {here} here")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name} holds a value that is not finite")
    model.load_state_dict(values)
