"""The networks on disk: one safetensors file of float32 tensors with the configuration in its metadata. Never pickle."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from fieldfuse.errors import InputError, OutputError, all_lines, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.encoder import TRUNKS
from fieldfuse.nerfusion.model import ModelConfig, NerfusionModel

SHIPPED = Path(__file__).parent / "weights" / "nerfusion.safetensors"
METADATA_KEY = "fieldfuse.networks"
VERSION = 5  # 1: other normalisation in the encoder; 2: without agreement; 3: without the sweep; 4: density changed without bounds
MAX_BYTES = 10 * 2**20
LIMITS = {"direction": 0, "channels": 4}  # least values (of channels: a density and a colour); every other number is at least 1
CHOICES = {"encoder": TRUNKS, "decoder": ("deferred", "per_sample"), "fusion": ("gru", "mean")}


def save_model(path: Path | str, model: NerfusionModel, meta: dict[str, Any] | None = None) -> None:
    """Write the networks, atomically. `meta`: remarks that nothing depends on (plain JSON).

    Raises:
        OutputError: the file cannot be written, or would be larger than 10 MB.
    """
    tensors = {name: value.detach().float().cpu().contiguous() for name, value in model.state_dict().items()}
    size = sum(value.numel() * 4 for value in tensors.values())
    if size > MAX_BYTES:
        raise OutputError(f"the networks take {size / 2**20:.1f} MB, more than the 10 MB of a weights file; choose fewer channels")
    described = json.dumps({"version": VERSION, "config": asdict(model.config), "meta": meta or {}})
    with atomic_path(path) as temporary:
        try:
            save_file(tensors, str(temporary), {METADATA_KEY: described})
        except SafetensorError as error:
            raise OutputError(f"cannot write {path}: {first_line(error)}; free space or choose another folder") from error


def load_model(path: Path | str, device: torch.device | str = "cpu") -> NerfusionModel:
    """Read the networks, as if the file came from anybody.

    Raises:
        InputError: the file is missing, is not such a file, or does not fit its own configuration.
    """
    path = Path(path)
    try:
        if path.stat().st_size > 2 * MAX_BYTES:
            raise ValueError("it is larger than such a file can be")
        with safe_open(str(path), "pt") as file:
            described = json.loads((file.metadata() or {})[METADATA_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        if described["version"] != VERSION:
            raise ValueError(f"its version is {described['version']!r} and {VERSION} is read")
        model = NerfusionModel(config_from(described["config"]))
        if not all(value.dtype == torch.float32 and bool(torch.isfinite(value).all()) for value in tensors.values()):
            raise ValueError("it holds a value that is not a finite float32")
        model.load_state_dict(tensors)
    except OSError as error:
        raise InputError(f"cannot read the weights {path}: {error.strerror or error}") from error
    except (SafetensorError, KeyError, TypeError, AttributeError, ValueError, RuntimeError, RecursionError) as error:
        why = all_lines(error)
        raise InputError(f"{path} does not hold weights that can be used ({why}); take the shipped ones or train again") from error
    return model.to(device).eval()


def config_from(data: dict[str, Any]) -> ModelConfig:
    """A configuration from plain data.

    Raises:
        ValueError: an unknown entry, or a value that cannot be.
    """
    known = {field.name: str(field.type) for field in fields(ModelConfig)}
    for name, value in data.items():
        if name not in known or type(value).__name__ != known[name]:
            raise ValueError(f"the setting {str(name)[:40]!r} is not one of the networks', or not of its type")
        if name in CHOICES and value not in CHOICES[name]:
            raise ValueError(f"{name} cannot be {str(value)[:40]!r}")
        if type(value) is int and not LIMITS.get(name, 1) <= value <= 512:
            raise ValueError(f"{name} cannot be {value}")
    return ModelConfig(**data)
