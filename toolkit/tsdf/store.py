"""A TSDF volume as a file: safetensors, written atomically, read with every shape checked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d.core as o3c
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fieldfuse.camera import Array
from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.tsdf.volume import BLOCK, TsdfVolume

VERSION = 1
CHANNELS = {"tsdf": 1, "weight": 1, "color": 3}


def save_volume(path: Path | str, volume: TsdfVolume) -> None:
    """Write the blocks in use: keys (B, 3) int32, tsdf, weight (B, 512, 1) and color (B, 512, 3) float32.

    Raises:
        OutputError: the file cannot be written.
    """
    table = volume.grid.hashmap()
    rows = table.active_buf_indices().to(o3c.int64)
    arrays = {"keys": table.key_tensor()[rows].numpy()}
    for name, channels in CHANNELS.items():
        stored = volume.grid.attribute(name).reshape(o3c.SizeVector([-1, BLOCK**3, channels]))
        arrays[name] = stored[rows].numpy()
    facts = {
        "version": VERSION,
        "voxel_size": volume.voxel_size,
        "depth_max": volume.depth_max,
        "truncation": volume.truncation,
        "frames": volume.frames,
        "empty_frames": volume.empty_frames,
        "touches": volume.touches,
    }
    with atomic_path(path) as temporary:
        try:
            whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
            save_file(whole, temporary, metadata={"tsdf": json.dumps(facts)})
        except SafetensorError as error:  # a full disk arrives as this, not as an OSError
            raise OutputError(f"cannot write {path}: {first_line(error)}; free space or choose another --out folder") from error


def load_volume(path: Path | str) -> TsdfVolume:
    """Read what `save_volume` wrote.

    Raises:
        InputError: missing, damaged, of another version, or too large for the memory allowed.
    """
    facts, arrays = _read(Path(path))
    keys = arrays["keys"]
    try:
        voxel_size, depth_max, truncation = (float(facts[name]) for name in ("voxel_size", "depth_max", "truncation"))
        volume = TsdfVolume(voxel_size, depth_max, truncation, expected_blocks=2 * len(keys))
        volume.frames, volume.empty_frames, volume.touches = int(facts["frames"]), int(facts["empty_frames"]), int(facts["touches"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is no TSDF volume of ours (its facts lack or misstate {first_line(error)}); fuse again") from error
    if len(keys) > volume.max_blocks or len(np.unique(keys, axis=0)) != len(keys):
        raise InputError(f"{path} holds {len(keys)} blocks, too many or repeated ones; fuse again with a larger tsdf.voxel_size")
    if len(keys) == 0:
        return volume
    table = volume.grid.hashmap()
    wanted = o3c.Tensor.from_numpy(np.ascontiguousarray(keys))
    table.activate(wanted)
    rows = table.find(wanted)[0].to(o3c.int64)
    for name, channels in CHANNELS.items():
        # A reshaped attribute shares the table's memory, so this writes into the volume.
        volume.grid.attribute(name).reshape(o3c.SizeVector([-1, BLOCK**3, channels]))[rows] = o3c.Tensor.from_numpy(arrays[name])
    return volume


def _read(path: Path) -> tuple[dict[str, float], dict[str, Array]]:
    try:
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {}).get("tsdf", "null"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; fuse the capture's depth first") from error
    except (SafetensorError, OSError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise InputError(f"{path} is not a TSDF volume or is damaged ({first_line(error)}); fuse again") from error
    if not isinstance(facts, dict) or facts.get("version") != VERSION:
        raise InputError(f"{path} is not a TSDF volume of version {VERSION}; fuse again with this program")
    count = len(arrays["keys"]) if "keys" in arrays and arrays["keys"].ndim == 2 else -1
    shapes = {"keys": (count, 3), **{name: (count, BLOCK**3, channels) for name, channels in CHANNELS.items()}}
    for name, shape in shapes.items():
        kind = np.int32 if name == "keys" else np.float32
        if name not in arrays or arrays[name].shape != shape or arrays[name].dtype != kind or not np.isfinite(arrays[name]).all():
            raise InputError(f"{path} is damaged: its {name!r} is missing, misshaped or not finite; fuse again")
    return facts, {name: np.ascontiguousarray(arrays[name]) for name in shapes}
