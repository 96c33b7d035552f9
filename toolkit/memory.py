"""Memory: how much this process may still take, the refusal, with numbers, of work that needs more, and what is given back early."""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import resource
import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
from numpy.typing import NDArray

from fieldfuse.errors import InputError

if TYPE_CHECKING:
    from fieldfuse.camera import Intrinsics
    from fieldfuse.capture.types import Views
    from fieldfuse.render.field import Field

GIB = 2**30
SPARE = 128 * 2**20  # left to everything else
IN_MEMORY = 0.5  # of the memory that can still be had is the most that one array of a field takes of it; larger ones go into files
_CGROUP = Path("/sys/fs/cgroup")
# Of control groups, second and first version: what is allowed, what is in use, and which part of it are files nobody looked at lately.
_GROUPS = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
)
_ARENA_MAX = -8  # malloc.h's M_ARENA_MAX
# Measured at 900×900: 200 bytes a pixel for a picture by torch (34 by a baked field), 240 for SSIM, 201 for LPIPS, 110 for PSNR.
RENDER_BYTES = 260  # a pixel of the picture that is being rendered: rays, samples of a part of them, colour, depth, opacity
SCORE_BYTES = 320  # a pixel of the picture that is being scored
KEPT_BYTES = 8  # a pixel of a picture that is kept until all are there: colour, depth, mask
SURFACE_BYTES = 40  # the same when depth maps are made to agree before they become a surface: 33 measured
PICTURE_BYTES = 8  # of a picture that depth is polished by: its colours, and its grey levels with those beside them
SEEN_BYTES = 12  # a corner of a field while what views see of it is noted, by two threads: 10 measured
ROW_COPIES = 3  # of a field's values while it is baked: its own, sorted ones for the range, the bytes
MESH_COPIES = 6  # of a mesh file's size in memory while meshes are compared: float64, a tree to search in, samples


def available() -> int:
    """Bytes that can still be had: what the machine has free, what a container allows, what RLIMIT_AS leaves."""
    limits = [psutil.virtual_memory().available]
    for allowed, used, idle in _GROUPS:
        with suppress(OSError, ValueError):  # "max" where there is no limit
            limits.append(int((_CGROUP / allowed).read_text()) - int((_CGROUP / used).read_text()) + _idle_files(_CGROUP / used, idle))
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most != resource.RLIM_INFINITY:
        limits.append(most - psutil.Process().memory_info().vms)
    return max(0, min(limits))


def require(size: int, what: str, advice: str) -> None:
    """Refuse what would need `size` bytes when there are fewer.

    Args:
        what: what needs them, the start of a sentence. advice: what to do, its end.

    Raises:
        InputError: naming both numbers.
    """
    there = available()
    if size > there - SPARE:
        raise InputError(f"{what} needs about {size / GIB:.1f} GB of memory and {there / GIB:.1f} GB is free; {advice}")


def pixels(lens: Intrinsics) -> int:
    return lens.width * lens.height


def require_pictures(lenses: Sequence[Intrinsics], kept: bool, advice: str = "lower --image-size", each: int = KEPT_BYTES) -> None:
    """Refuse to render images that do not fit, all of which are held in memory when they are `kept` (`each` byte a pixel).

    Raises:
        InputError: with what is needed and what is free.
    """
    if lenses:
        largest, whole = max(map(pixels, lenses)), sum(map(pixels, lenses)) if kept else 0
        what = f"rendering {len(lenses)} pictures of up to {largest / 1e6:.1f} million pixels"
        require(RENDER_BYTES * largest + each * whole, what, advice)


def require_scores(views: Views, methods: int) -> None:
    """Refuse to score the held-out pictures of so many methods when a picture's measures do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    lenses = [lens for lens, test in zip(views.intrinsics, views.test, strict=True) if test]
    if lenses:
        largest = max(map(pixels, lenses))
        what = f"scoring {methods * len(lenses)} pictures of up to {largest / 1e6:.1f} million pixels"
        require(SCORE_BYTES * largest, what, "run again with a lower --image-size")


def require_baking(field: Field) -> None:
    """Refuse to bake a field whose copies do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    size = sum(values.numel() * values.element_size() for values in (field.density_rows, field.feature_rows))
    require(ROW_COPIES * size, f"baking a field of {field.blocks:,} blocks", "fit it at a lower resolution (field.resolution)")


def require_splats(field: Field, sums: int) -> None:
    """Refuse to make splats of a field when what is noted of its voxels does not fit.

    Args:
        sums: bytes that threads collect light in.

    Raises:
        InputError: with what is needed and what is free.
    """
    size = SEEN_BYTES * len(field.occupied) + sums
    require(size, f"making splats of a field of {field.blocks:,} blocks", "fit it at a lower resolution (field.resolution)")


def require_meshes(paths: Sequence[Path]) -> None:
    """Refuse to compare meshes that do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    size = sum(path.stat().st_size for path in paths if path.is_file())
    require(MESH_COPIES * size, f"comparing {len(paths)} meshes", "make them with a coarser tsdf.voxel_size")


def require_file(path: Path, what: str) -> None:
    """Refuse to read a file of prepared data whose content does not fit; a file that is not there is another's concern.

    Raises:
        InputError: with what is needed and what is free.
    """
    if path.is_file():
        require(path.stat().st_size, what, "run again with a lower --image-size, or give fewer pictures")


def bounded(most: int, share: float = 0.5) -> int:
    """`most` bytes, or `share` of what is there when that is less: for work that makes do with what it is given."""
    return max(0, min(most, int(share * (available() - SPARE))))


def workers(wanted: int, each: int, what: str, advice: str) -> int:
    """How many of `wanted` workers, of which each takes `each` bytes, there is room for.

    Raises:
        InputError: not for one; `what` and `advice` as for `require`.
    """
    require(each, what, advice)
    return max(1, min(wanted, (available() - SPARE) // max(1, each)))


def pages(size: int, spill: bool = False) -> mmap.mmap | bytearray:
    """`size` bytes, all zero, for what will be written here and there: where nothing is written they take no memory, page by page. (What
    NumPy gives begins so, too, but on systems with huge pages a byte that is written takes 2 MB.)

    Args:
        spill: if these bytes are more than `IN_MEMORY` of what can still be had, they are a file in the folder for temporary files
            (TMPDIR), of which the system keeps in memory what is in use. It has no name and goes with the last reference.

    Raises:
        InputError: neither memory nor disk has room for them.
    """
    if size == 0 or not hasattr(mmap, "MAP_PRIVATE"):
        return bytearray(size)
    if spill and size > IN_MEMORY * (available() - SPARE):
        require_place(size, "a field that does not fit into memory")
        with suppress(OSError, AttributeError), tempfile.TemporaryFile() as file:  # AttributeError: not every system has the call
            # Without its blocks on the disk a write to a full one would end the process. Where there are too few it is memory after all.
            os.posix_fallocate(file.fileno(), 0, size)
            return mmap.mmap(file.fileno(), size)
    out = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        with suppress(OSError):  # a kernel without huge pages
            out.madvise(mmap.MADV_NOHUGEPAGE)
    return out


def require_place(size: int, what: str) -> None:
    """Refuse what would need `size` bytes, in memory or else in the folder for temporary files, when there are fewer.

    Args:
        what: what needs them, the start of a sentence.

    Raises:
        InputError: naming both numbers.
    """
    there, folder = available(), tempfile.gettempdir()
    free = shutil.disk_usage(folder).free
    if size > max(there, free) - SPARE:
        left = f"{there / GIB:.1f} GB of memory and {free / GIB:.1f} GB in {folder} are free"
        advice = "free some, or set TMPDIR to a folder on a larger disk"
        raise InputError(f"{what} needs about {size / GIB:.1f} GB of memory or disk, and {left}; {advice}")


def unwritten(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """An array of zeros, in pages of which those take no memory that nobody writes (`pages`): for what is sized for the worst case."""
    return np.frombuffer(pages(math.prod(shape) * np.dtype(dtype).itemsize), dtype).reshape(shape)


def give_back() -> None:
    """Give the system what this process has freed and its C library still holds (glibc keeps pieces of up to 32 MB); a few milliseconds.
    Called where much was just freed."""
    with suppress(OSError, TypeError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def one_heap() -> None:
    """Have all threads allocate from one heap: glibc gives each of them its own, and what is freed in one is of no use to the others. What
    the environment says (MALLOC_ARENA_MAX) stays."""
    if "MALLOC_ARENA_MAX" not in os.environ:
        with suppress(OSError, TypeError, AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def keep_only(rows: NDArray[Any], used: NDArray[np.bool_]) -> int:
    """Give the system the pages of `rows` in which no row is `used`; what is asked of them afterwards is zero, until it is written again.

    Args:
        rows: (N, …) contiguous, in memory of this process alone (no window into a file, nothing shared).
        used: (N,) bool.

    Returns:
        bytes that were given back; 0 where the system has no such call.
    """
    if len(rows) != len(used) or not rows.flags.c_contiguous:
        raise ValueError("rows that are given back must be contiguous, and one mark belongs to each")
    page, width, start = mmap.PAGESIZE, rows.nbytes // max(1, len(rows)), rows.ctypes.data
    first = -start % page  # of the pages that lie wholly within
    count = (rows.nbytes - width - first) // page  # the last row stays, so that no slice below ends beyond the marks
    if madvise is None or width == 0 or count <= 0:
        return 0
    edges = first + np.arange(count, dtype=np.int64) * page
    slices = np.stack([edges // width, -(-(edges + page) // width)], 1)  # rows of which a part lies in a page
    free = ~np.logical_or.reduceat(used, slices.reshape(-1))[::2]
    ends = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8))).reshape(-1, 2)
    for begin, end in (start + first + ends * page).tolist():
        madvise(begin, end - begin, mmap.MADV_DONTNEED)
    return int(free.sum()) * page


def _system_call() -> Any:
    """`madvise` of the C library, where pages that are not needed read as zero afterwards (Linux)."""
    if not sys.platform.startswith("linux"):
        return None
    with suppress(OSError, AttributeError):
        call = ctypes.CDLL(None).madvise
        call.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
        return call
    return None


madvise = _system_call()


def _idle_files(used: Path, name: str) -> int:
    """Bytes of files that a control group holds and the system takes back when memory is needed; 0 where it does not report them."""
    with suppress(OSError, ValueError):
        entries = dict(line.split(" ", 1) for line in (used.parent / "memory.stat").read_text(encoding="ascii").splitlines())
        return int(entries.get(name, 0))
    return 0
