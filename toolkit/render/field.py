"""The radiance field: sparse blocks of density and features, a decoder, and the space that they live in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError, first_line
from fieldfuse.nerfusion.decoder import Deferred, PerSample, make_decoder
from fieldfuse.render.composite import RAW_MAX, UNITS
from fieldfuse.render.march import MarchGrid
from fieldfuse.render.sky import checked_sky
from fieldfuse.volume.edit import corner_nodes
from fieldfuse.volume.space import Space
from fieldfuse.volume.store import FieldFile, compact, expand, read_field, write_field
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

Tensor = torch.Tensor
BRIGHTEST = 1e3  # of a background that is read; colours are 0 to 1


def density(raw: Tensor) -> Tensor:
    """Raw density → σ ≥ 0 per normalised unit: exp, clamped in its forward value (a zero-length interval must not meet an infinite σ)."""
    return torch.exp(raw.clamp_max(RAW_MAX)) * UNITS


@dataclass
class Field:
    """A sparse voxel field in the working frame.

    Attributes:
        space: region of interest and contraction.
        resolution: voxels along the lattice's cube; lattice corner (0, 0, 0) is its low corner, keys count from there.
        topology: blocks; also those that only hold corners of occupied voxels.
        occupied: (M · 512,) bool, voxels that are sampled.
        density_rows: (M · 512 + 1,) float32 raw density at lattice corners; the last is the zero row of absent blocks.
        feature_rows: (M · 512 + 1, C) float32.
        decoder: deferred or per sample.
        background: (3,) colour behind everything.
        near: distance before which nothing is sampled.
        sky: (9, 3) harmonics of the colour behind everything, which whole renders show instead of `background`; None: there is none. It
            stays on the CPU, where renders are put together.
        outer: a coarser field of the same space and decoder, which is sampled where this one has no voxel, and never trained: the rest of a
            scene while one cell of it is fitted. Compiled engines of the CPU alone know it; it is not saved.
    """

    space: Space
    resolution: int
    topology: Topology
    occupied: Tensor
    density_rows: Tensor
    feature_rows: Tensor
    decoder: Deferred | PerSample
    background: Tensor
    near: float = 0.0
    fine: int = 4
    sky: Tensor | None = None
    outer: Field | None = None

    def __post_init__(self) -> None:
        self.grid = MarchGrid(self.space, self.resolution, self.topology, self.occupied)

    @property
    def device(self) -> torch.device:
        return self.density_rows.device

    @property
    def voxel_size(self) -> float:
        """Side of a voxel inside the region of interest, working units."""
        return 2 * self.space.extent / self.resolution * self.space.half

    @property
    def blocks(self) -> int:
        return self.topology.blocks

    @property
    def voxels(self) -> int:
        """Occupied voxels."""
        return int(self.occupied.sum())

    @property
    def bytes(self) -> int:
        """Memory of blocks, features, densities and occupancy."""
        return self.blocks * (VOXELS * (4 * (self.feature_rows.shape[1] + 1) + 1) + 12)

    def to(self, device: torch.device | str) -> Field:
        """The same field on another device."""
        return replace(
            self,
            topology=self.topology.to(device),
            occupied=self.occupied.to(device),
            density_rows=self.density_rows.to(device),
            feature_rows=self.feature_rows.to(device),
            decoder=self.decoder.to(device),
            background=self.background.to(device),
        )

    def settled(self) -> Field:
        """A copy in memory of its own, without the blocks that hold nothing."""
        return self.packed()()

    def packed(self) -> Callable[[], Field]:
        """What makes the copy that `settled` is; it holds the corners that voxels use and nothing else, so that the memory of this field's
        rows can be freed before the copy's is taken: the end of a fit is when most is needed."""
        corners = corner_nodes(self.topology, self.occupied).view(-1, VOXELS)
        kept = corners.any(1).nonzero().view(-1)
        source = corners.view(-1).nonzero().view(-1)
        density, feature = (compact(rows, source) for rows in (self.density_rows, self.feature_rows))
        index, blocks = corners[kept].view(-1).nonzero().view(-1), len(kept)
        occupied = self.occupied.view(-1, VOXELS)[kept].view(-1)
        topology, none = Topology(self.topology.keys[kept]), (density[:0], feature[:0])
        rest = replace(self, topology=topology, occupied=occupied, density_rows=none[0], feature_rows=none[1])
        return lambda: replace(rest, density_rows=expand(density, index, blocks), feature_rows=expand(feature, index, blocks))

    def save(self, path: Path | str, working_from_input: Similarity | None = None, meta: dict[str, Any] | None = None) -> None:
        """Write `field.safetensors`, atomically; corners that no occupied voxel uses are left out.

        Raises:
            OutputError: it cannot be written.
        """
        nodes = corner_nodes(self.topology, self.occupied).nonzero().squeeze(1)
        decoder = "deferred" if isinstance(self.decoder, Deferred) else "per_sample"
        config = {
            "space": self.space.to_dict(),
            "resolution": self.resolution,
            "decoder": decoder,
            "hidden": self.decoder.hidden,
            "background": self.background.tolist(),
            "near": self.near,
            "fine": self.fine,
            "sky": None if self.sky is None else self.sky.tolist(),
        }
        x, y, z = (c - self.space.extent * self.space.half for c in self.space.centre)
        data = FieldFile(
            keys=self.topology.keys,
            occupied=self.occupied.view(-1, VOXELS),
            node_index=nodes.int(),
            features=compact(self.feature_rows, nodes, torch.float16),
            density=compact(self.density_rows, nodes),
            decoder=dict(self.decoder.state_dict()),
            config=config,
            voxel_size=self.voxel_size,
            origin=(x, y, z),
            working_from_input=working_from_input or Similarity.identity(),
            meta=meta or {},
        )
        write_field(path, data, precision="float16")

    @classmethod
    def load(cls, path: Path | str) -> Field:
        """Read `field.safetensors`. What is too large for the memory is unpacked into temporary files (`memory.pages`).

        Raises:
            InputError: the file is not a field, or was tampered with, or there is too little memory and disk for it.
        """
        return cls.from_file(read_field(path), Path(path))

    @classmethod
    def from_file(cls, data: FieldFile, path: Path) -> Field:
        """A field from the contents of the file `path`; see `load`."""
        try:
            config = data.config
            space, resolution = Space.from_dict(config["space"]), int(config["resolution"])
            kind, hidden, fine, near = str(config["decoder"]), int(config["hidden"]), int(config["fine"]), float(config["near"])
            background, sky = torch.tensor([float(v) for v in config["background"]]), checked_sky(config.get("sky"))
            sane = kind in ("deferred", "per_sample") and 8 <= resolution <= 8192 and 1 <= hidden <= 4096 and 1 <= fine <= 64 and near >= 0
            sane = sane and len(background) == 3 and bool((background.abs() <= BRIGHTEST).all())  # not of what is not a number
            if not sane or not space.half > 0 or not 0 <= space.shell <= 16:
                raise ValueError("a setting is out of range")
            if len(data.keys) and (int(data.keys.min()) < 0 or int(data.keys.max()) > resolution // BLOCK):
                raise ValueError("a block lies outside the lattice")
            decoder = make_decoder(kind, data.features.shape[1], hidden)
            decoder.load_state_dict(data.decoder)
        except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            reason = first_line(error)
            raise InputError(f"{path} does not hold a field that can be used ({reason}); fit it again") from error
        blocks = len(data.keys)
        return cls(
            space,
            resolution,
            Topology(data.keys),
            data.occupied.reshape(-1),
            expand(data.density, data.node_index, blocks),
            expand(data.features, data.node_index, blocks),
            decoder,
            background,
            near,
            fine,
            sky,
        )
