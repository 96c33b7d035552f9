"""Gaussian splats on disk: `.ply` as the authors of 3D Gaussian Splatting write it, and Niantic's `.spz`.

`.ply`: float properties x y z, nx ny nz (zero), f_dc_0…2, f_rest_… (all coefficients but the first, red before green before blue),
opacity, scale_0…2, rot_0…3 (w x y z), in the frame of the cameras that it was fitted to (graphdeco-inria/gaussian-splatting,
`GaussianModel.save_ply`).

`.spz` (nianticlabs/spz, versions 2 and 3): gzip of a header of 16 bytes and then, of all Gaussians, places as 24-bit fixed point,
opacities, colours, logarithms of scales, rotations and harmonics as bytes. Its axes are right, up, back where those of the `.ply` are
right, down, forward, so y and z are turned on the way.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.backends.numba import splats as G
from fieldfuse.camera import Array
from fieldfuse.capture.ply_points import ply_columns
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.render.splats import MAX_DEGREE, MOST, Splats

SUFFIXES = (".ply", ".spz")
MAX_BYTES = 3 * 2**30
REST = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(MAX_DEGREE + 1)}  # numbers of f_rest_… → degree
LARGEST = {"logarithm": 30.0, "harmonic": 1e3, "place": 1e9}  # that is taken from files
# .spz
MAGIC, VERSION, READ_VERSIONS = 0x5053474E, 3, (2, 3)
HEADER = struct.Struct("<IIIBBBB")
COLOUR_STEP = 0.15  # of a constant coefficient, of 255
FIXED = 2**23  # places are below it, in steps
FINEST = 20  # bits behind the point
ROOT = np.sqrt(0.5)
# Signs of the harmonics where y and z change theirs, from degree 1 on.
TURNED = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


def save_splats(path: Path | str, splats: Splats) -> None:
    """Write `.ply` or `.spz`, as the suffix says, atomically.

    Raises:
        InputError: another suffix, or places that the format cannot hold.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    suffix = _suffix(path)
    content = to_ply(splats) if suffix == ".ply" else to_spz(splats, str(path))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def open_splats(path: Path | str) -> Splats:
    """Read `.ply` or `.spz`; Gaussians with numbers that are none are left out.

    Raises:
        InputError: another suffix, no splats, damaged, or more than `MOST`.
    """
    path = Path(path)
    suffix = _suffix(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} is larger than {MAX_BYTES / 2**30:.0f} GB; give splats with fewer Gaussians")
        values = _of_ply(path.read_bytes()) if suffix == ".ply" else _of_spz(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, IndexError, OverflowError, MemoryError, EOFError, struct.error, zlib.error) as error:
        raise InputError(f"{path} does not hold Gaussian splats that can be read ({first_line(error)}); write it again") from error
    values = values[np.isfinite(values[:, : G.SCALE]).all(1) & ~np.isnan(values).any(1)]
    log, most = LARGEST["logarithm"], LARGEST["harmonic"]
    values[:, G.SCALE : G.ROTATION] = values[:, G.SCALE : G.ROTATION].clip(-log, log)
    values[:, G.OPACITY] = values[:, G.OPACITY].clip(-log, log)
    values[:, G.HARMONICS :] = values[:, G.HARMONICS :].clip(-most, most)
    turn = values[:, G.ROTATION : G.OPACITY].clip(-1e6, 1e6)
    values[:, G.ROTATION : G.OPACITY] = np.where(np.linalg.norm(turn, axis=1, keepdims=True) > 1e-9, turn, [1, 0, 0, 0])
    if not len(values) or np.abs(values[:, : G.SCALE]).max() > LARGEST["place"]:
        raise InputError(f"{path} holds no Gaussian with usable numbers; write it again")
    return Splats(np.ascontiguousarray(values, np.float32), np.zeros(3))


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"splats are files that end with {' or '.join(SUFFIXES)}, not {suffix or 'without a suffix'}; rename {path.name}")
    return suffix


def _normalised(values: Array) -> Array:
    """(N, 4) unit quaternions w, x, y, z with w ≥ 0."""
    turn = values[:, G.ROTATION : G.OPACITY]
    turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return np.where(turn[:, :1] < 0, -turn, turn)


# --------------------------------------------------------------------------------------------------------------- ply


def _properties(degree: int) -> list[str]:
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(rest)), "opacity"]
    return [*names, *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]


def to_ply(splats: Splats) -> bytes:
    """The content of a `.ply` file."""
    values, names = splats.values, _properties(splats.degree)
    rest = values[:, G.HARMONICS + 3 :].reshape(len(values), -1, 3).transpose(0, 2, 1).reshape(len(values), -1)
    columns = (splats.centres, np.zeros((len(values), 3)), values[:, G.HARMONICS : G.HARMONICS + 3], rest)
    last = (values[:, G.OPACITY : G.OPACITY + 1], values[:, G.SCALE : G.ROTATION], _normalised(values))
    rows = np.concatenate([np.asarray(column, "<f4") for column in (*columns, *last)], 1)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}", *(f"property float {name}" for name in names)]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + rows.tobytes()


def _of_ply(content: bytes) -> Array:
    def wanted(names: list[str]) -> list[str]:
        rest = sum(name.startswith("f_rest_") for name in names)
        missing = [name for name in ("f_dc_0", "opacity", "scale_0", "scale_1", "scale_2", "rot_0") if name not in names]
        if missing:
            raise ValueError(f"its points have no {missing[0]}")
        if rest not in REST:
            raise ValueError(f"{rest} coefficients f_rest_… are those of no degree")
        return [name for name in _properties(REST[rest]) if not name.startswith("n")]

    given = ply_columns(content, wanted, MOST, np.float32)
    count = given.shape[1] - 14
    rest = given[:, 6 : 6 + count].reshape(len(given), 3, -1).transpose(0, 2, 1).reshape(len(given), -1)
    opacity, scale, turn = given[:, 6 + count, None], given[:, 7 + count : 10 + count], given[:, 10 + count :]
    return np.concatenate([given[:, :3], scale, turn, opacity, given[:, 3:6], rest], 1)


# --------------------------------------------------------------------------------------------------------------- spz


def _bytes(values: Array) -> Array:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def to_spz(splats: Splats, where: str = "splats") -> bytes:
    """The content of a `.spz` file of version 3.

    Raises:
        InputError: places too far from the origin.
    """
    values, places = splats.values, splats.centres * [1, -1, -1]
    reach = float(np.abs(places).max(initial=1e-6))
    bits = min(FINEST, int(np.floor(np.log2((FIXED - 1) / reach))))
    if bits < 0:
        raise InputError(f"{where} cannot hold places as far from the origin as {reach:.3g}; write the splats as .ply")
    fixed = np.rint(places * 2.0**bits).astype("<i4").reshape(-1, 1).view(np.uint8)[:, :3]
    harmonics = values[:, G.HARMONICS + 3 :].reshape(len(values), -1, 3) * TURNED[: (splats.degree + 1) ** 2 - 1, None]
    parts = (
        fixed,
        _bytes(255 / (1 + np.exp(-values[:, G.OPACITY].astype(np.float64)))),
        _bytes((values[:, G.HARMONICS : G.HARMONICS + 3] * COLOUR_STEP + 0.5) * 255),
        _bytes((values[:, G.SCALE : G.ROTATION] + 10) * 16),
        _smallest_three(_normalised(values)[:, [1, 2, 3, 0]] * [1, -1, -1, 1]),
        _bytes(harmonics * 128 + 128),
    )
    header = HEADER.pack(MAGIC, VERSION, len(values), splats.degree, bits, 0, 0)
    return gzip.compress(header + b"".join(np.ascontiguousarray(part).tobytes() for part in parts), 6, mtime=0)


def _smallest_three(turn: Array) -> Array:
    """(N, 4) unit quaternions x, y, z, w → (N,) uint32: which is the largest, and the others in order: a sign, nine bits each."""
    largest = np.abs(turn).argmax(1)
    turn = turn * np.where(np.take_along_axis(turn, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    for k in range(4):
        size = np.floor(511 * np.abs(turn[:, k]) / ROOT + 0.5).clip(0, 511).astype(np.uint32)
        packed = np.where(largest == k, packed, packed << 10 | (turn[:, k] < 0).astype(np.uint32) << 9 | size)
    return packed.astype("<u4")


def _of_smallest_three(packed: Array) -> Array:
    largest, turn = (packed >> 30).astype(np.int64), np.zeros((len(packed), 4))
    rest = packed.copy()
    for k in (3, 2, 1, 0):
        size = (rest & 511) / 511 * ROOT
        mine = largest != k
        turn[mine, k] = np.where(rest & 512, -size, size)[mine]
        rest = np.where(mine, rest >> 10, rest)
    np.put_along_axis(turn, largest[:, None], np.sqrt(np.maximum(0, 1 - (turn**2).sum(1)))[:, None], 1)
    return turn


def _of_spz(content: bytes) -> Array:
    if content[:2] != b"\x1f\x8b":
        raise ValueError("versions 2 and 3 are read, which are compressed as gzip" if content[:4] == b"NGSP" else "it is not gzip")
    unpack = zlib.decompressobj(16 + zlib.MAX_WBITS)
    head = unpack.decompress(content, HEADER.size)
    magic, version, count, degree, bits, _, _ = HEADER.unpack(head)
    if magic != MAGIC or version not in READ_VERSIONS or degree > MAX_DEGREE or bits > 30:
        raise ValueError("its header is not that of version 2 or 3")
    if not 0 < count <= MOST:
        raise ValueError(f"{count} Gaussians; from 1 to {MOST} can be read")
    coefficients = (degree + 1) ** 2 - 1
    sizes = [9, 1, 3, 3, 4 if version == 3 else 3, 3 * coefficients]
    body = unpack.decompress(unpack.unconsumed_tail, count * sum(sizes) + 1)
    if len(body) != count * sum(sizes):
        raise ValueError("more or fewer bytes than its Gaussians need")
    cuts = count * np.cumsum([0, *sizes])
    parts: list[Any] = [
        np.frombuffer(body, np.uint8, count * size, cut).reshape(count, size) for size, cut in zip(sizes, cuts, strict=False)
    ]
    triples = parts[0].reshape(count, 3, 3).astype(np.int32)
    fixed = triples[..., 0] | triples[..., 1] << 8 | triples[..., 2] << 16
    places = (fixed - (fixed >> 23 << 24)) / 2.0**bits * [1, -1, -1]
    share = np.clip(parts[1] / 255.0, 1e-7, 1 - 1e-7)
    if version == 3:
        turn = _of_smallest_three(np.ascontiguousarray(parts[4]).view("<u4")[:, 0])
    else:
        three = parts[4] / 127.5 - 1
        turn = np.concatenate([three, np.sqrt(np.maximum(0, 1 - (three**2).sum(1, keepdims=True)))], 1)
    turn = (turn * [1, -1, -1, 1])[:, [3, 0, 1, 2]]
    harmonics = (parts[5].reshape(count, coefficients, 3) / 128.0 - 1) * TURNED[:coefficients, None]
    colours = (parts[2] / 255.0 - 0.5) / COLOUR_STEP
    return np.concatenate([places, parts[3] / 16.0 - 10, turn, np.log(share / (1 - share)), colours, harmonics.reshape(count, -1)], 1)
