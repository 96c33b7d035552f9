"""`BlockGrid`: blocks of voxels hosted by Open3D's `VoxelBlockGrid`, shared with torch without copying.

Open3D's hash map has habits that lose data silently. They end here: keys already present, growth that moves every row, erased slots
that come back dirty, buffer order that differs from run to run, and memory still held by torch when Python exits.
"""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
import open3d as o3d
import torch
from torch import Tensor
from torch.utils import dlpack

from fieldfuse.errors import InputError
from fieldfuse.memory import keep_only
from fieldfuse.volume.host import Host, Hosted, TorchHost, plain_rows
from fieldfuse.volume.topology import BLOCK, VOXELS, Topology

LOOKED_AT = 64  # blocks at once, when memory is checked for being clean: each value is a byte for a moment
LINE = 64  # bytes of a cache line
GROWTH = 1.5  # a table that must grow gets at least this much more room


class BlockGrid:
    """A growing set of 8×8×8 blocks with float32 attributes.

    Buffer slot b of the grid owns rows b·512 … b·512 + 511 of every attribute, z-major inside the block as in `Topology`. Slots are in
    no order, though the same in every run as long as the table has not grown; `ordered` and `topology` sort by keys.

    Args:
        voxel_size: edge of a voxel in working units.
        attributes: name → channels, float32.
        capacity: blocks to make room for at once; growth costs up to three times the memory for a moment.
        device: "cpu" or "cuda".

    Raises:
        InputError: Open3D cannot use the device, or there is not enough memory.
    """

    def __init__(
        self, voxel_size: float, attributes: Mapping[str, int], capacity: int = 1024, device: torch.device | str = "cpu"
    ) -> None:
        self.voxel_size = float(voxel_size)
        self.attributes = dict(attributes)
        self.device = torch.device(device)
        if not self.voxel_size > 0 or not self.attributes or min(self.attributes.values()) < 1:
            raise ValueError("a grid needs a positive voxel size and at least one attribute with at least one channel")
        if self.device.type == "cuda" and not o3d.core.cuda.is_available():
            raise InputError("this Open3D cannot use CUDA here; choose --device cpu or install its CUDA build")
        place = f"CUDA:{self.device.index or 0}" if self.device.type == "cuda" else "CPU:0"
        self._views: dict[str, Tensor] = {}
        self._lent: list[weakref.ref[Tensor]] = []
        try:
            host: Any = o3d.t.geometry.VoxelBlockGrid  # its stubs have neither tuples nor plain integers
            self._host = host(
                attr_names=tuple(self.attributes),
                attr_dtypes=(o3d.core.float32,) * len(self.attributes),
                attr_channels=tuple(self.attributes.values()),
                voxel_size=self.voxel_size,
                block_resolution=BLOCK,
                block_count=max(int(capacity), 1),
                device=o3d.core.Device(place),
            )
        except RuntimeError as error:
            raise self._no_memory(capacity) from error
        self._map: Any = self._host.hashmap()
        _OPEN.add(self)

    def __len__(self) -> int:
        """Number of active blocks."""
        return int(self._table().size())

    @property
    def capacity(self) -> int:
        """Blocks there is room for; rows of every attribute = capacity · 512."""
        return int(self._table().capacity())

    def reserve(self, blocks: int) -> None:
        """Make room for at least `blocks` blocks in all. When that moves rows, views are void.

        Raises:
            InputError: not enough memory.
        """
        if blocks <= self.capacity:
            return
        self._void_views()
        try:
            self._map.reserve(int(blocks))
        except (RuntimeError, MemoryError) as error:
            raise self._no_memory(blocks) from error

    def activate(self, keys: Tensor) -> Tensor:
        """Make sure that the blocks (N, 3) exist; new ones hold zeros. Keys may repeat.

        Returns:
            (N,) int64 buffer slots.

        Raises:
            InputError: not enough memory.
        """
        keys = self._keys(keys)
        slots = self.find(keys)
        if bool((slots >= 0).all()):
            return slots
        missing = torch.unique(keys[slots < 0], dim=0)
        needed = len(self) + len(missing)
        if needed > self.capacity:
            self.reserve(max(needed, int(self.capacity * GROWTH)))
        # Open3D inserts with several threads, which draw slots in the order in which they come; one key at a time, the order is ours.
        inserted = self._to_open3d(missing)
        for index in range(len(missing)):
            self._map.activate(inserted[index : index + 1])
        fresh = self.find(missing)
        for name, channels in self.attributes.items():
            rows = self.rows(name).detach().view(-1, VOXELS * channels)
            dirty = fresh
            if 2 * len(fresh) > self.capacity:  # memory that is new is zero, and takes nothing as long as it is only looked at
                dirty = fresh[torch.cat([part.any(1) for part in rows.split(LOOKED_AT)])[fresh]]
            rows.index_fill_(0, dirty, 0.0)
        return self.find(keys)

    def find(self, keys: Tensor) -> Tensor:
        """(N, 3) integer keys → (N,) int64 buffer slots, −1 where there is no such block."""
        keys = self._keys(keys)
        if len(keys) == 0 or len(self) == 0:
            return torch.full((len(keys),), -1, dtype=torch.int64, device=self.device)
        slots, found = self._map.find(self._to_open3d(keys))
        return torch.where(_to_torch(found).to(torch.bool), _to_torch(slots).to(torch.int64), -1)

    def erase(self, keys: Tensor) -> int:
        """Remove the blocks (N, 3) that are there; returns how many. Rows of other blocks stay where they are."""
        keys = torch.unique(self._keys(keys), dim=0)
        keys = keys[self.find(keys) >= 0]
        if len(keys):
            self._map.erase(self._to_open3d(keys))
        return len(keys)

    def ordered(self) -> tuple[Tensor, Tensor]:
        """(M, 3) int32 active keys sorted by z, then y, then x, and their (M,) int64 buffer slots: the same in every run."""
        if len(self) == 0:
            empty = torch.zeros((0, 3), dtype=torch.int32, device=self.device)
            return empty, torch.zeros(0, dtype=torch.int64, device=self.device)
        slots = _to_torch(self._map.active_buf_indices()).to(torch.int64)
        keys = _to_torch(self._map.key_tensor())[slots]
        order = torch.arange(len(keys), device=self.device)
        for axis in range(3):  # least significant axis first; stable sorts keep what came before
            order = order[torch.sort(keys[order, axis], stable=True).indices]
        return keys[order].contiguous(), slots[order]

    def topology(self) -> Topology:
        """The active blocks; its slot s is the s-th of `ordered`, not a buffer slot."""
        return Topology(self.ordered()[0])

    def rows(self, name: str) -> Tensor:
        """(capacity · 512, C) float32 view that shares Open3D's buffer: writes are seen by both sides.

        It is void after the next growth: it then has no rows, so that a write cannot be lost in silence.
        To optimise values in place call `requires_grad_()` on this very tensor (a `Parameter` made of it, like any tensor derived
        from it, is another handle on the old memory which the grid can neither void nor release at exit).
        """
        if name not in self.attributes:
            raise KeyError(f"the grid has no attribute {name!r}; it has {', '.join(self.attributes)}")
        if name not in self._views:
            self._table()
            view = dlpack.from_dlpack(self._host.attribute(name).reshape((-1, self.attributes[name])).to_dlpack())
            self._views[name] = view
            self._lent.append(weakref.ref(view))
        return self._views[name]

    def close(self) -> None:
        """Free all memory, views included. Called at exit for grids still open: Open3D complains about longer held buffers and
        fails the exit status."""
        self._void_views()
        self._map = self._host = None
        _OPEN.discard(self)

    def _table(self) -> Any:
        if self._map is None:
            raise RuntimeError("this grid is closed")
        return self._map

    def _void_views(self) -> None:
        """Void every view lent so far, so that its old memory is freed and its use fails."""
        self._views.clear()
        for reference in self._lent:
            view = reference()
            if view is not None:
                view.grad = None
                view.data = torch.empty((0, view.shape[1]), device=view.device)
        self._lent.clear()

    def _keys(self, keys: Tensor) -> Tensor:
        if keys.ndim != 2 or keys.shape[1] != 3 or keys.is_floating_point():
            raise ValueError(f"block keys must be an integer (N, 3) tensor, not {keys.dtype} {tuple(keys.shape)}")
        return keys.to(self.device, torch.int32).contiguous()

    def _to_open3d(self, keys: Tensor) -> o3d.core.Tensor:
        return o3d.core.Tensor.from_dlpack(keys.__dlpack__())

    def _no_memory(self, blocks: int) -> InputError:
        size = blocks * VOXELS * 4 * sum(self.attributes.values()) / 2**30
        return InputError(f"there is not enough memory for a volume of {blocks} blocks ({size:.1f} GB); choose a lower resolution")


def _to_torch(tensor: Any) -> Tensor:
    """A copy that shares nothing with Open3D (bool tensors do not pass through DLPack in every version)."""
    if tensor.dtype == o3d.core.bool:
        tensor = tensor.to(o3d.core.uint8)
    return dlpack.from_dlpack(tensor.to_dlpack()).clone()


_OPEN: weakref.WeakSet[BlockGrid] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    for grid in list(_OPEN):
        grid.close()


def host_for(device: torch.device | str) -> Host:
    """Open3D's hash map where this Open3D can use the device. The packages for the CPU cannot use CUDA: there rows are plain tensors."""
    device = torch.device(device)
    return GridHost(device) if device.type == "cpu" or o3d.core.cuda.is_available() else TorchHost(device)


class GridHost:
    """Rows inside Open3D's hash map, shared without a copy. One grid at a time: a finer level replaces the coarser one."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.grid: BlockGrid | None = None

    def allocate(self, keys: Tensor, channels: int, voxel_size: float) -> Hosted:
        blocks = len(keys)
        self.close()
        # One spare block holds the zero row, so the table never grows and the views stay good. It gives `_aligned` room, too.
        self.grid = BlockGrid(voxel_size, {"feature": channels, "density": 1}, capacity=blocks + 1, device=self.device)
        slots = self.grid.activate(keys)
        if blocks and int(slots.max()) != blocks - 1:  # a fresh table hands out its first slots; otherwise its order is not ours to use
            return plain_rows(self.grid.topology(), channels)
        ordered = torch.empty_like(keys)
        ordered[slots] = keys
        feature, density = (_aligned(self.grid.rows(name), blocks * VOXELS) for name in ("feature", "density"))
        return Hosted(Topology(ordered), density[:, 0], feature)

    def close(self) -> None:
        if self.grid is None:
            return
        for name in self.grid.attributes if self.device.type == "cpu" else ():
            rows = self.grid.rows(name).numpy()
            keep_only(rows, np.zeros(len(rows), np.bool_))  # at once, though the void rows may still be referenced: they read as zero
        self.grid.close()
        self.grid = None


def _aligned(buffer: Tensor, rows: int) -> Tensor:
    """(R, C) rows of Open3D's → (rows + 1, C) of the same memory from its first cache line on, and the zero row.

    Open3D's memory begins 16 bytes after such a line, so each row of 16 features would lie in two of them, which costs a step of a fit 6 to
    10%. Open3D looks up blocks here and looks at no values, so it does not matter that its own rows begin elsewhere.
    """
    buffer[rows : rows + LINE] = 0  # what rows reach of the spare block
    skip = -buffer.data_ptr() % LINE // buffer.element_size()
    channels = buffer.shape[1]
    return buffer.view(-1)[skip : skip + (rows + 1) * channels].view(rows + 1, channels)
