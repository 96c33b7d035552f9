"""`baked.safetensors`: a baked field on disk. Tensors carry the names of `Baked`, and `decoder.<name>` those of `common.Decoder`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fieldfuse.backends.numba import common as K
from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError, OutputError, all_lines, first_line
from fieldfuse.files import atomic_path
from fieldfuse.nerfusion.encoding import DIRECTION
from fieldfuse.render.bake import FINER, LEVELS, Baked, BakedField, counted, occupied_voxels
from fieldfuse.render.sky import checked_sky
from fieldfuse.volume.space import Space

Array = np.ndarray[Any, Any]
VERSION = 1
METADATA_KEY = "fieldfuse.baked"
MAX_METADATA_BYTES = 2**20
MOST_CHANNELS, MOST_HIDDEN = 1024, 4096
KINDS = {"table": "<i4", "first": "<i4", "rows": "<i4", "base": "<i4", **dict.fromkeys(("bricks", "bits", "packed", "feature"), "|u1")}


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
    """Read and check a baked field that may come from anybody.

    Raises:
        InputError: missing, damaged, of another version, or any index that could not have been written.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no baked field {path}; make it with `fieldfuse bake`")
    try:
        with safe_open(str(path), framework="numpy") as source:
            text = (source.metadata() or {}).get(METADATA_KEY, "")
            _require(0 < len(text) <= MAX_METADATA_BYTES, "it is not a baked field")
            names = {*Baked._fields, *(f"decoder.{name}" for name in K.Decoder._fields)}
            _require(set(source.keys()) == names, "its tensors are not those of a baked field")
            arrays = {name: source.get_tensor(name) for name in names}
        for name, array in arrays.items():
            _require(array.dtype.str == KINDS.get(name, "<f4"), f"its tensor {name!r} has the type {array.dtype}")
            finite = array.dtype.kind != "f" or bool(np.isfinite(array).all())
            _require(finite, f"its tensor {name!r} holds values that are not finite")
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
    background = np.array([float(v) for v in about["background"]], np.float32)
    _require(background.shape == (3,) and bool(np.isfinite(background).all()), "its background is not a colour")
    sky = checked_sky(about.get("sky"))
    blocks, voxels, stored = len(arrays["base"]), len(arrays["packed"]), len(arrays["feature"])
    channels, hidden = arrays["feature"].shape[-1], len(arrays["decoder.b1"])
    _require(1 <= channels <= MOST_CHANNELS, f"it has {channels} feature channels")
    _require(1 <= hidden <= MOST_HIDDEN, "its decoder is too wide")
    side, inputs = resolution // 4 + 2, channels + DIRECTION
    shapes = {
        "bricks": (side, side, side),
        "bits": (blocks, 64),
        "packed": (voxels, 8),
        "feature": (stored, channels),
        "thickness": (LEVELS * FINER + 1,),
        "scale": (channels,),
        "low": (channels,),
        "decoder.w1": (inputs, hidden),
        "decoder.w1_out": (hidden, inputs),
        "decoder.b1": (hidden,),
        "decoder.w2": (hidden, hidden),
        "decoder.w2_out": (hidden, hidden),
        "decoder.b2": (hidden,),
        "decoder.w3": (3, hidden),
        "decoder.b3": (3,),
    }
    for name, shape in shapes.items():
        _require(arrays[name].shape == shape, f"its tensor {name!r} has the shape {arrays[name].shape} where {shape} belongs")
    # Indices: all of them follow from which voxels are occupied, and every block has one place in the lattice.
    table, occupied = arrays["table"], occupied_voxels(arrays["bits"])
    placed = table.ndim == 3 and np.array_equal(np.sort(table[table >= 0]), np.arange(blocks)) and int(table.min(initial=-1)) >= -1
    _require(placed, "its block table leads nowhere")
    first, rows, base, total = counted(occupied)
    same = all(np.array_equal(arrays[name], values) for name, values in (("first", first), ("rows", rows), ("base", base)))
    _require(same and total == stored and int(occupied.sum()) == voxels, "its voxels or corners are miscounted")
    words = {"bits": arrays["bits"].view("<u8"), "packed": arrays["packed"].view("<u8").reshape(-1)}
    baked = Baked(**{name: arrays[name] for name in Baked._fields if name not in words}, **words)
    decoder = K.Decoder(*(arrays[f"decoder.{name}"] for name in K.Decoder._fields))
    x, y, z = (int(v) for v in about["table_origin"])
    sky_array = None if sky is None else sky.numpy()
    field = BakedField(space, resolution, near, fine, (x, y, z), background, baked, decoder, sky_array)
    keys = field.keys()
    _require(keys.min(initial=0) >= 0 and keys.max(initial=0) <= resolution // 8, "a block lies outside the lattice")
    return field
