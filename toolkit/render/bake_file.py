"""`baked.safetensors`: a baked field on disk, rendered from where it lies.

Tensors carry the names of `baked.Baked` and `decoder.<name>` of `common.Decoder`. Densities and features, nearly all of the file,
stay windows into it and are read page by page as rays come to them. Every index is copied and checked, because compiled code follows it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.baked import CORNERS, FINER, LEVELS, Baked
from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError, OutputError, all_lines, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.encoding import DIRECTION
from fieldfuse.render.bake import BakedField
from fieldfuse.render.sky import checked_sky
from fieldfuse.volume.space import Space

Array = np.ndarray[Any, Any]
VERSION = 1
METADATA_KEY = "fieldfuse.baked"
MAX_METADATA_BYTES = 2**20
MOST_CHANNELS, MOST_HIDDEN = 1024, 4096
MAPPED = ("packed", "feature")  # any content of these is harmless
KINDS = {
    "table": torch.int32,
    "bricks": torch.uint8,
    "bits": torch.uint8,
    "first": torch.int32,
    "packed": torch.uint8,
    "rows": torch.int32,
    "base": torch.int32,
    "feature": torch.uint8,
    "thickness": torch.float32,
    "scale": torch.float32,
    "low": torch.float32,
}


def write_baked(path: Path | str, field: BakedField, working_from_input: Similarity | None = None) -> None:
    """Write a baked field, atomically.

    Raises:
        OutputError: it cannot be written.
    """
    tensors = {name: np.ascontiguousarray(array) for name, array in field.arrays._asdict().items()}
    tensors["bits"] = tensors["bits"].view(np.uint8).reshape(-1, 64)
    tensors["packed"] = tensors["packed"].view(np.uint8).reshape(-1, 8)
    tensors |= {f"decoder.{name}": np.ascontiguousarray(array) for name, array in field.decoder._asdict().items()}
    information = {
        "version": VERSION,
        "space": field.space.to_dict(),
        "resolution": field.resolution,
        "near": field.near,
        "fine": field.fine,
        "table_origin": list(field.table_origin),
        "background": field.background.tolist(),
        "sky": None if field.sky is None else field.sky.tolist(),
        "working_from_input": (working_from_input or Similarity.identity()).to_dict(),
    }
    with atomic_path(path) as temporary:
        try:
            # As bytes: what safetensors writes by itself only its owner may read.
            temporary.write_bytes(save(tensors, metadata={METADATA_KEY: json.dumps(information, allow_nan=False)}))
        except (SafetensorError, ValueError) as error:
            raise OutputError(f"cannot write {path} ({first_line(error)}); free space or choose another folder") from error


def read_baked(path: Path | str) -> BakedField:
    """Open and check a baked field that may come from anybody. The file must not be changed while it is in use.

    Raises:
        InputError: missing, damaged, of another version, or any index that could not have been written.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no baked field {path}; make it with `fieldfuse bake`")
    try:
        with safe_open(str(path), framework="pt", device="cpu") as source:
            text = (source.metadata() or {}).get(METADATA_KEY, "")
            _require(0 < len(text) <= MAX_METADATA_BYTES, "it is not a baked field")
            names = set(source.keys())
            decoder_names = {f"decoder.{name}" for name in K.Decoder._fields}
            _require(names == set(KINDS) | decoder_names, "its tensors are not those of a baked field")
            tensors = {name: source.get_tensor(name) for name in names}
        for name, tensor in tensors.items():
            _require(tensor.dtype == KINDS.get(name, torch.float32), f"its tensor {name!r} has the type {tensor.dtype}")
        arrays = {name: tensor.numpy() if name in MAPPED else tensor.clone().numpy() for name, tensor in tensors.items()}
        return _checked(arrays, json.loads(text))
    except (_Unusable, SafetensorError, OSError, ValueError, TypeError, KeyError, RuntimeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} cannot be used, because {all_lines(error)}; bake the run again") from error


class _Unusable(Exception):
    """Why a file is refused: the middle of a sentence."""


def _require(fine: bool, reason: str) -> None:
    if not fine:
        raise _Unusable(reason)


def _checked(arrays: dict[str, Array], about: dict[str, Any]) -> BakedField:
    _require(about["version"] == VERSION, f"its version is not {VERSION}")
    space = Space.from_dict(about["space"])
    resolution, fine, near = int(about["resolution"]), int(about["fine"]), float(about["near"])
    numbers = (*space.centre, space.half, space.shell, *space.box, near)
    sane = all(math.isfinite(v) for v in numbers) and space.half > 0 and 0 <= space.shell <= 16 and near >= 0
    _require(sane and 8 <= resolution <= 8192 and 1 <= fine <= 64, "a setting is out of range")
    x, y, z = (int(v) for v in about["table_origin"])
    _require(max(abs(v) for v in (x, y, z)) <= resolution, "its block table lies outside the lattice")
    background = np.array([float(v) for v in about["background"]], np.float32)
    _require(background.shape == (3,) and bool(np.isfinite(background).all()), "its background is not a colour")
    sky = checked_sky(about.get("sky"))
    _check_arrays(arrays, resolution)
    channels = arrays["feature"].shape[1]
    hidden = len(arrays["decoder.b1"])
    _require(1 <= hidden <= MOST_HIDDEN, "its decoder is too wide")
    inputs = channels + DIRECTION
    shapes = {"w1": (inputs, hidden), "w1_out": (hidden, inputs), "b1": (hidden,), "w2": (hidden, hidden), "w2_out": (hidden, hidden)}
    shapes |= {"b2": (hidden,), "w3": (3, hidden), "b3": (3,)}
    for name, shape in shapes.items():
        _require(arrays[f"decoder.{name}"].shape == shape, f"its decoder tensor {name!r} has another shape")
    for name, array in arrays.items():
        _require(array.dtype != np.float32 or bool(np.isfinite(array).all()), f"its tensor {name!r} holds values that are not finite")
    baked = Baked(**{name: arrays[name] for name in Baked._fields if name not in ("bits", "packed")}, **_words(arrays))
    decoder = K.Decoder(*(arrays[f"decoder.{name}"] for name in K.Decoder._fields))
    return BakedField(space, resolution, near, fine, (x, y, z), background, baked, decoder, None if sky is None else sky.numpy())


def _words(arrays: dict[str, Array]) -> dict[str, Array]:
    return {"bits": arrays["bits"].view("<u8"), "packed": arrays["packed"].view("<u8").reshape(-1)}


def _check_arrays(arrays: dict[str, Array], resolution: int) -> None:
    """Shapes, and that no index leads outside what it points into."""
    blocks, voxels, stored = len(arrays["base"]), len(arrays["packed"]), len(arrays["feature"])
    channels = arrays["feature"].shape[-1]
    side = resolution // 4 + 2
    shapes = {
        "bricks": (side, side, side),
        "bits": (blocks, 64),
        "first": (blocks, 8),
        "packed": (voxels, 8),
        "rows": (blocks, CORNERS * CORNERS),
        "base": (blocks,),
        "feature": (stored, channels),
        "thickness": (LEVELS * FINER + 1,),
        "scale": (channels,),
        "low": (channels,),
    }
    for name, shape in shapes.items():
        _require(arrays[name].shape == shape, f"its tensor {name!r} has the shape {arrays[name].shape} where {shape} belongs")
    _require(1 <= channels <= MOST_CHANNELS, f"it has {channels} feature channels")
    table = arrays["table"]
    _require(table.ndim == 3 and table.size > 0 and int(table.min()) >= -1 and int(table.max()) < blocks, "its block table leads nowhere")
    occupied = np.unpackbits(arrays["bits"], axis=1, bitorder="little").reshape(-1, 8, 8, 8).astype(bool)
    counts = occupied.reshape(-1, 64).sum(1, dtype=np.int64)
    _require(
        bool((arrays["first"].reshape(-1) == np.cumsum(counts) - counts).all()) and counts.sum() == voxels, "its voxels are miscounted"
    )
    # Corner rows: as many bits as corners, counted in order; and beside every occupied voxel all eight are there.
    rows = arrays["rows"]
    mask = (rows[:, :, None] >> np.arange(CORNERS) & 1).astype(bool)
    here = mask.sum(2)
    total = here.sum(1)
    right = bool((rows >> CORNERS == np.cumsum(here, 1) - here).all()) and int(total.sum()) == stored
    _require(right and bool((arrays["base"] == np.cumsum(total) - total).all()), "its corners are miscounted")
    cube = mask.reshape(-1, CORNERS, CORNERS, CORNERS)
    for z in (0, 1):
        for y in (0, 1):
            for x in (0, 1):
                _require(bool(cube[:, z : z + 8, y : y + 8, x : x + 8][occupied].all()), "a voxel lacks a corner")
