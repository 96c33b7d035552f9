"""Rendered pictures of one run: kept exactly for scoring (`renders/<what>.safetensors`), and as PNG for people."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.poses.scene import Scene

Array = NDArray[Any]
DEEPEST = 2**16 - 1  # steps


@dataclass
class Picture:
    """One rendered view."""

    rgb: Array  # (H, W, 3) uint8
    depth: Array  # (H, W) float32 along z, working units, 0 = missing
    mask: Array | None = None  # (H, W) bool, where a surface was hit; None for a field, which fills every pixel


@dataclass
class Pictures:
    """Rendered views by name, with the seconds that each took."""

    names: list[str] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)  # plain data that belongs to them

    def add(self, name: str, picture: Picture, seconds: float) -> None:
        self.names.append(name)
        self.pictures.append(picture)
        self.seconds.append(seconds)


def to_picture(rendered: Any) -> Picture:
    """What a renderer answers (`rgb` float or uint8, `depth`, optional `mask`) → a picture with 8-bit colour."""
    rgb = np.asarray(rendered.rgb)
    if rgb.dtype != np.uint8:
        rgb = (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
    mask = getattr(rendered, "mask", None)
    return Picture(rgb, np.ascontiguousarray(rendered.depth, dtype=np.float32), None if mask is None else np.asarray(mask).astype(bool))


def save_pictures(path: Path, pictures: Pictures) -> None:
    """Write all of them into one safetensors file, atomically."""
    tensors: dict[str, Array] = {}
    for index, picture in enumerate(pictures.pictures):
        tensors[f"rgb.{index}"] = np.ascontiguousarray(picture.rgb)
        tensors[f"depth.{index}"] = picture.depth
        if picture.mask is not None:
            tensors[f"mask.{index}"] = np.ascontiguousarray(picture.mask.astype(np.uint8))
    about = {"names": pictures.names, "seconds": pictures.seconds, "facts": pictures.facts}
    with atomic_path(path) as temporary:
        try:
            save_file(tensors, str(temporary), metadata={"pictures": json.dumps(about)})
        except SafetensorError as error:
            raise OutputError(f"cannot write {path}: {first_line(error)}; free space or choose another --out folder") from error


def load_pictures(path: Path) -> Pictures:
    """What `save_pictures` wrote.

    Raises:
        InputError: missing or damaged.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            about = json.loads(file.metadata()["pictures"])
            keys = set(file.keys())
            pictures = [
                Picture(
                    file.get_tensor(f"rgb.{index}"),
                    file.get_tensor(f"depth.{index}"),
                    file.get_tensor(f"mask.{index}").astype(bool) if f"mask.{index}" in keys else None,
                )
                for index in range(len(about["names"]))
            ]
            return Pictures(about["names"], pictures, about["seconds"], about["facts"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, MemoryError, RecursionError) as error:
        raise InputError(f"{path} cannot be read ({first_line(error)}); remove it and run the command again") from error


def file_name(name: str) -> str:
    """A frame's name as one part of a path."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "view"


def depth_step(scene: Scene) -> float:
    """What one step of a depth picture is, in the input's unit: a thousandth (a millimetre of what is metric), or, where what is not metric
    reaches farther than 65.535 units, the tenfold as often as it has to be."""
    step = 0.001
    while not scene.metric and scene.far / scene.working_from_input.scale > DEEPEST * step:
        step *= 10
    return step


def depth_steps(scene: Scene) -> float:
    """How many steps of a depth picture a working unit has."""
    return 1 / (scene.working_from_input.scale * depth_step(scene))


def write_pngs(folder: Path, prefix: str, pictures: Pictures, exposure: float, steps: float = 1000) -> list[Path]:
    """`<prefix>_<name>.png`, brighter by `exposure`, and `<prefix>_<name>_depth.png` (16 bit, so many `steps` a working unit; 0: none, and
    the largest number: that far or farther)."""
    written: list[Path] = []
    for index, (name, picture) in enumerate(zip(pictures.names, pictures.pictures, strict=True)):
        stem = f"{prefix}_{index:03d}_{file_name(Path(name).stem)}"
        depth = np.clip(np.nan_to_num(picture.depth) * steps + 0.5, 0, DEEPEST).astype(np.uint16)
        written += [write_png(folder / f"{stem}.png", exposed(picture.rgb, exposure)), write_png(folder / f"{stem}_depth.png", depth)]
    return written


def write_png(path: Path, pixels: Array) -> Path:
    """(H, W, 3) uint8 RGB or (H, W) uint16, atomically."""
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", pixels)
    if not done:
        raise OutputError(f"the picture {path} of shape {pixels.shape} cannot be encoded as PNG")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return path
