"""Checkpoints of a training run: weights, Adam's moments and the step as one safetensors file; and compact weights to ship.

Nothing else needs keeping: every random choice of a run is drawn from (seed, step, process), so a run that goes on from a checkpoint
takes the same steps, bit for bit on the CPU, as one that never stopped.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.training.average import Average
from fieldfuse.nerfusion.training.caution import Caution

Tensor = torch.Tensor
MODEL, FIRST, SECOND, COUNT, AVERAGE = "model.", "adam.first.", "adam.second.", "adam.step.", "average."
FORMAT = "fieldfuse-training-1"


def checkpoint_name(step: int) -> str:
    """File name of a checkpoint taken after `step` steps."""
    return f"checkpoint-{step:07d}.safetensors"


def save_checkpoint(
    folder: Path,
    step: int,
    model: nn.Module,
    adam: torch.optim.Adam,
    settings: dict[str, Any],
    keep: int,
    caution: Caution,
    average: Average | None = None,
) -> Path:
    """Write the state after `step` steps, and remove all but the newest `keep` checkpoints.

    Raises:
        OutputError: it cannot be written.
    """
    tensors = {MODEL + name: value for name, value in model.state_dict().items()}
    for name, parameter in model.named_parameters():
        state = adam.state.get(parameter)
        if state:
            tensors[FIRST + name], tensors[SECOND + name] = state["exp_avg"], state["exp_avg_sq"]
            tensors[COUNT + name] = torch.as_tensor(state["step"], dtype=torch.float32).reshape(1)
    tensors |= {} if average is None else {AVERAGE + name: value for name, value in average.values.items()}
    meta = {"format": FORMAT, "step": str(step), "settings": json.dumps(settings), "caution": json.dumps(caution.to_dict())}
    path = folder / checkpoint_name(step)
    with atomic_path(path) as temporary:
        save_file({name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}, temporary, metadata=meta)
    for old in checkpoints(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def checkpoints(folder: Path) -> list[Path]:
    """Checkpoints in a folder, oldest first."""
    return sorted(folder.glob("checkpoint-*.safetensors"))


def load_checkpoint(path: Path, model: nn.Module, adam: torch.optim.Adam, average: Average | None = None) -> int:
    """Put a checkpoint's state into `model`, `adam` and `average`; answers the number of steps taken.

    Raises:
        InputError: not a checkpoint, or one of other networks.
    """
    tensors, meta = _read(path)
    try:
        step = int(meta["step"])
        if meta["format"] != FORMAT:
            raise ValueError(f"format {meta['format']!r}")
        _fill(model, {name[len(MODEL) :]: value for name, value in tensors.items() if name.startswith(MODEL)})
        for name, parameter in model.named_parameters():
            if FIRST + name not in tensors:
                adam.state.pop(parameter, None)
                continue
            first, second = tensors[FIRST + name], tensors[SECOND + name]
            if first.shape != parameter.shape or second.shape != parameter.shape:
                raise ValueError(f"the optimiser's state of {name} has another shape")
            count = tensors[COUNT + name].reshape(())
            adam.state[parameter] = {
                "step": count.clone(),
                "exp_avg": first.to(parameter.device).clone(),
                "exp_avg_sq": second.to(parameter.device).clone(),
            }
        if average is not None:
            average.load({name[len(AVERAGE) :]: value for name, value in tensors.items() if name.startswith(AVERAGE)})
    except (KeyError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path} is not a checkpoint of these networks ({first_line(error)}); go on with the settings it was made "
            "with, or start anew in another folder"
        ) from error
    return step


def load_caution(path: Path) -> Caution:
    """What a run had met when the checkpoint was made; nothing, for checkpoints that do not tell.

    Raises:
        InputError: not a checkpoint.
    """
    try:
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get("caution")
        return Caution() if text is None else Caution.from_dict(json.loads(text))
    except (OSError, SafetensorError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a training checkpoint ({first_line(error)}); choose another") from error


def checkpoint_settings(path: Path) -> dict[str, Any]:
    """The settings that a checkpoint was trained with.

    Raises:
        InputError: not a checkpoint.
    """
    try:
        with safe_open(path, "pt") as file:
            data = json.loads((file.metadata() or {})["settings"])
    except (OSError, SafetensorError, KeyError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a training checkpoint ({first_line(error)}); choose another") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} is not a training checkpoint (its settings are not an object); choose another")
    return data


def _fill(model: nn.Module, values: dict[str, Tensor]) -> None:
    own = model.state_dict()
    # Said here: what torch says of such begins with a line that tells nothing.
    if odd := sorted(own.keys() ^ values.keys()):
        raise ValueError(f"{odd[0]} is {'not in it' if odd[0] in own else 'not one of theirs'}")
    for name, value in values.items():
        if value.shape != own[name].shape:
            raise ValueError(f"{name} is {_size(value)} there and {_size(own[name])} here")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name} holds a value that is not finite")
    model.load_state_dict(values)


def _size(value: Tensor) -> str:
    return "×".join(map(str, value.shape)) or "one number"


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InputError(f"cannot read {path} ({first_line(error)}); it is missing or not a safetensors file") from error
