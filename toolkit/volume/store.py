"""`field.safetensors`: a sparse field on disk. Written atomically, read as if it came from anybody. Never pickle.

Tensors: `keys` (M, 3) int32 · `occupied` (M, 64) uint8, 512 bits a block, lowest bit first · `node_index` (R,) int32 ascending rows of
the stored lattice corners · `features` (R, C) float16 or float32 · `density` (R,) float32 · `decoder.<name>` float32. Everything else is
JSON under one metadata key. Corners that are not stored (those beside no occupied voxel) are zero.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field as Bounded
from pydantic import TypeAdapter, ValidationError
from pydantic_core import from_json
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fieldfuse import memory
from fieldfuse.camera import Similarity
from fieldfuse.errors import FieldfuseError, InputError, OutputError, all_lines, first_line
from fieldfuse.files import atomic_path
from fieldfuse.volume.host import zero_rows
from fieldfuse.volume.topology import MAX_TABLE_CELLS, VOXELS

VERSION = 1
METADATA_KEY = "fieldfuse.field"
MAX_METADATA_BYTES = 16 * 2**20
MAX_CHANNELS = 1024
KEY_LIMIT = 2**20  # block keys lie in [−KEY_LIMIT, KEY_LIMIT)
AT_ONCE = 2**16  # values that are looked at, or brought into their rows, at a time: so copies stay small
_BITS = VOXELS // 8
_DTYPES = {
    "keys": (torch.int32,),
    "occupied": (torch.uint8,),
    "node_index": (torch.int32,),
    "features": (torch.float16, torch.float32),
    "density": (torch.float32,),
}


@dataclass
class FieldFile:
    """What a field file holds.

    Attributes:
        keys: (M, 3) int32 block keys, none twice.
        occupied: (M, 512) bool, voxels that are sampled, z-major inside the block.
        node_index: (R,) int32 ascending rows (slot · 512 + local) of the stored lattice corners.
        features: (R, C) float32, or float16 as a file may hold them.
        density: (R,) float32 raw density.
        decoder: name → float32 tensor.
        config: how the field is to be read (plain JSON).
        working_from_input: similarity from the input's frame to the field's.
        voxel_size: working units.
        origin: place of lattice corner (0, 0, 0), working units.
        meta: remarks that nothing depends on (plain JSON).
        version: of the file's format.
    """

    keys: Tensor
    occupied: Tensor
    node_index: Tensor
    features: Tensor
    density: Tensor
    decoder: dict[str, Tensor]
    config: dict[str, Any]
    voxel_size: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    working_from_input: Similarity = field(default_factory=Similarity.identity)
    meta: dict[str, Any] = field(default_factory=dict)
    version: int = VERSION


def compact(rows: Tensor, node_index: Tensor, precision: torch.dtype = torch.float32) -> Tensor:
    """(M · 512 [+ 1], …) float32 block rows → (R, …) values of the stored corners, in `precision` where all of them fit into it."""
    out = zero_rows((len(node_index), *rows.shape[1:]), rows.device, precision)
    for part, index in zip(out.split(AT_ONCE), node_index.split(AT_ONCE), strict=True):
        values = rows.detach().index_select(0, index)
        if precision != torch.float32 and largest(values) > torch.finfo(precision).max:  # they would become infinite
            return compact(rows, node_index)
        part.copy_(values)
    return out


def largest(values: Tensor) -> float:
    """Largest magnitude, without a copy of the values; 0 of none."""
    return max(map(abs, map(float, torch.aminmax(values.detach())))) if values.numel() else 0.0


def expand(values: Tensor, node_index: Tensor, blocks: int) -> Tensor:
    """(R, …) stored values → (blocks · 512 + 1, …) float32 block rows; what is not stored, and the zero row at the end, is zero."""
    rows = zero_rows((blocks * VOXELS + 1, *values.shape[1:]), values.device)
    for part, index in zip(values.split(AT_ONCE), node_index.split(AT_ONCE), strict=True):
        rows.index_copy_(0, index.long(), part.float())
    return rows


def write_field(path: Path | str, data: FieldFile, precision: str = "float32") -> None:
    """Write a field; features in `precision` ("float32" or "float16", half the size, where they fit into it), the rest in float32.

    Raises:
        OutputError: the field does not pass the reader's own checks (a value that is not finite, …), or it cannot be written.
    """
    if precision not in ("float16", "float32"):
        raise ValueError(f"features are stored as float16 or float32, not {precision!r}")
    path = Path(path)
    kind = getattr(torch, precision)
    if largest(data.features) > torch.finfo(kind).max:
        kind = torch.float32  # beyond float16's range they would become infinite, and a finished fit could not be kept
    features = data.features.detach().to("cpu", kind).contiguous()
    tensors = {name: getattr(data, name).detach().cpu().contiguous() for name in ("keys", "node_index", "density")}
    tensors["features"] = features
    occupied = data.occupied.detach().bool().cpu().view(-1, VOXELS).numpy()
    tensors["occupied"] = torch.from_numpy(np.packbits(occupied, axis=1, bitorder="little"))
    tensors |= {f"decoder.{name}": tensor.detach().cpu().contiguous() for name, tensor in data.decoder.items()}
    information = {
        "version": data.version,
        "voxel_size": data.voxel_size,
        "origin": list(data.origin),
        "working_from_input": data.working_from_input.to_dict(),
        "config": data.config,
        "meta": data.meta,
    }
    try:
        text = json.dumps(information, allow_nan=False)
        _checked(tensors, text)
    except (_Unusable, ValueError, TypeError) as error:
        raise OutputError(f"the field is not written to {path}, because {first_line(error)}; please report this") from error
    with atomic_path(path) as temporary:
        try:
            # One metadata key only: with several their order, and so the file's bytes, would differ from run to run.
            save_file(tensors, str(temporary), metadata={METADATA_KEY: text})
        except SafetensorError as error:
            raise OutputError(f"cannot write {path} ({first_line(error)}); free space or choose another --out folder") from error


def read_field(path: Path | str) -> FieldFile:
    """Read and check a field file that may come from anybody.

    Raises:
        InputError: missing, truncated, not a field, of another version, any value that could not have been written, or more than there
            is memory for.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no field file {path}; run the fit first, or give the path of a field.safetensors")
    try:
        with safe_open(str(path), framework="pt", device="cpu") as source:
            metadata = source.metadata() or {}
            if METADATA_KEY not in metadata:
                raise _Unusable("it is not a Fieldfuse field")
            names = list(source.keys())
            for name in names:
                # Cheap refusals come before any tensor is read.
                if name not in _DTYPES and not name.startswith("decoder."):
                    raise _Unusable(f"it holds an unknown tensor {name[:40]!r}")
            # Copies, because the originals are windows into the file, which may change under them.
            tensors = {name: _copied(source.get_tensor(name)) for name in names}
        data = _checked(tensors, metadata[METADATA_KEY])
        # A few bytes of keys stand for kilobytes of rows: what a small file unpacks to is looked at before anybody unpacks it.
        unpacked = len(data.keys) * VOXELS * (4 * (data.features.shape[1] + 1) + 1)
        memory.require_place(unpacked, f"the field {path}")
        return data
    except FieldfuseError:
        raise
    except (_Unusable, SafetensorError, OSError, ValueError, TypeError, KeyError, RuntimeError, OverflowError, MemoryError) as error:
        why = all_lines(error)
        raise InputError(f"{path} cannot be used, because {why}; fit the field again or take another copy of the file") from error


def _copied(values: Tensor) -> Tensor:
    return zero_rows(tuple(values.shape), dtype=values.dtype).copy_(values)


class _Unusable(Exception):
    """Why a field is refused: the middle of a sentence."""


_Number = Annotated[float, Bounded(gt=-1e30, lt=1e30)]  # products of two stay finite
_Positive = Annotated[float, Bounded(gt=0, lt=1e30)]
_Triple = tuple[_Number, _Number, _Number]


@dataclass
class _Similarity:
    scale: _Positive
    rotation: tuple[_Triple, _Triple, _Triple]
    translation: _Triple


@dataclass
class _Header:
    """The metadata of a file."""

    version: int
    voxel_size: _Positive
    origin: _Triple
    working_from_input: _Similarity
    config: dict[str, Any]
    meta: dict[str, Any]


def _checked(tensors: dict[str, Tensor], text: str) -> FieldFile:
    """A `FieldFile` from tensors as they lie in the file and the metadata's JSON, or `_Unusable`."""
    header = _header(text)
    for name, dtypes in _DTYPES.items():
        if name not in tensors:
            raise _Unusable(f"its tensor {name!r} is missing")
        if tensors[name].dtype not in dtypes:
            raise _Unusable(f"its tensor {name!r} has the type {tensors[name].dtype}")
    keys, packed, nodes = tensors["keys"], tensors["occupied"], tensors["node_index"]
    features, density = tensors["features"], tensors["density"]
    blocks, stored = len(keys) if keys.ndim else 0, nodes.numel()
    channels = features.shape[1] if features.ndim == 2 else 0
    shapes = {
        "keys": (blocks, 3),
        "occupied": (blocks, _BITS),
        "node_index": (stored,),
        "features": (stored, channels),
        "density": (stored,),
    }
    for name, shape in shapes.items():
        if tuple(tensors[name].shape) != shape:
            raise _Unusable(f"its tensor {name!r} has the shape {tuple(tensors[name].shape)} where {shape} belongs")
    if not 1 <= channels <= MAX_CHANNELS:
        raise _Unusable(f"it has {channels} feature channels")
    _check_keys(keys)
    if stored and not (int(nodes[0]) >= 0 and int(nodes[-1]) < blocks * VOXELS and bool((nodes[1:] > nodes[:-1]).all())):
        raise _Unusable("its node index is not ascending or leads outside the blocks")
    decoder = {name.removeprefix("decoder."): tensor for name, tensor in tensors.items() if name.startswith("decoder.")}
    for name, tensor in {"features": features, "density": density, **decoder}.items():
        if name in decoder and tensor.dtype != torch.float32:
            raise _Unusable(f"its decoder tensor {name[:40]!r} has the type {tensor.dtype}")
        if not all(bool(torch.isfinite(part).all()) for part in tensor.reshape(-1).split(AT_ONCE)):
            raise _Unusable(f"its tensor {name[:40]!r} holds values that are not finite")
    occupied = torch.from_numpy(np.unpackbits(packed.numpy(), axis=1, bitorder="little").astype(bool))
    return FieldFile(keys, occupied, nodes, features, density, decoder, **header)


def _check_keys(keys: Tensor) -> None:
    if len(keys) == 0:
        return
    low, high = keys.long().amin(0), keys.long().amax(0)
    if int(low.min()) < -KEY_LIMIT or int(high.max()) >= KEY_LIMIT:
        raise _Unusable("its block keys are out of range")
    extent = (high - low + 3).tolist()
    if math.prod(extent) > MAX_TABLE_CELLS:
        raise _Unusable("its blocks lie too far apart to be rendered")
    relative = keys.long() - low
    if len(torch.unique((relative[:, 2] * extent[1] + relative[:, 1]) * extent[0] + relative[:, 0])) != len(keys):
        raise _Unusable("it holds a block twice")


def _header(text: str) -> dict[str, Any]:
    """The metadata's JSON as arguments of `FieldFile`."""
    if len(text) > MAX_METADATA_BYTES:
        raise _Unusable("its metadata is too large")
    try:
        data = from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise _Unusable("its metadata is not valid JSON") from error
    if not isinstance(data, dict) or type(data.get("version")) is not int:
        raise _Unusable("its metadata has no version")
    if data["version"] != VERSION:
        raise _Unusable(f"its format has version {data['version'] % 10**9} and only version {VERSION} is read")
    try:
        header = TypeAdapter(_Header).validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise _Unusable(f"its {'.'.join(map(str, first['loc']))} is not one ({first['msg'].lower()})") from error
    similarity = header.working_from_input
    rotation = np.array(similarity.rotation, np.float64)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise _Unusable("its similarity does not hold a rotation")
    working = Similarity(similarity.scale, rotation, np.array(similarity.translation, np.float64))
    return {**vars(header), "working_from_input": working}
