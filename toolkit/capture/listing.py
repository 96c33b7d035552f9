"""What all readers share: natural order, unique names, small text and JSON files, and the checks at the end."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import files
from fieldfuse.camera import Array
from fieldfuse.capture import exr, heif, raw
from fieldfuse.capture.images import cut_out
from fieldfuse.capture.poses import unread_frames
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line

ORDINARY = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif", *heif.SUFFIXES)
IMAGES = (*ORDINARY, exr.SUFFIX, *raw.SUFFIXES)
MAX_TEXT_BYTES = 64 * 2**20


def natural_key(text: str) -> tuple[list[str | int], str]:
    """Sort key under which `2` comes before `10`. Ties (`1` and `01`) are broken by the text itself."""
    parts = re.split(r"([0-9]+)", text.lower())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], text


def counted(number: int, one: str, many: str | None = None) -> str:
    """`1 image`, `2 images`."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def some_of(names: Sequence[str], most: int = 3) -> str:
    """The first few names, `, …` for the others."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


def words_of(name: str) -> set[str]:
    """Words of a name, in lower case: of `imagesMask_2` images and mask."""
    return set(re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower()))


# --------------------------------------------------------------------------------------------------- folders


def require_folder(path: Path | str) -> Path:
    """The absolute folder.

    Raises:
        InputError: missing, not a folder, not readable, or empty.
    """
    path = Path(path).absolute()
    if not path.exists():
        raise InputError(f"{path} does not exist; give a folder that does")
    if not path.is_dir():
        raise InputError(f"{path} is not a folder; give the folder that holds the capture")
    try:
        if not any(path.iterdir()):
            raise InputError(f"the folder {path} is empty; put a video, photos or a capture there")
    except OSError as error:
        raise InputError(f"cannot list the folder {path}: {error.strerror or error}") from error
    return path


def is_file(path: Path) -> bool:
    """Whether a file is there; False also for names that the file system refuses (too long)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def images_in(folder: Path, suffixes: Sequence[str] = IMAGES) -> list[Path]:
    """Images directly in `folder`, in natural order; an absent folder holds none. Hidden files are left out, and OpenEXR and camera raw
    beside ordinary images, since those are depth or the same photos."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()]
    if suffixes is IMAGES:
        groups = ([path for path in found if path.suffix.lower() in group] for group in (ORDINARY, (exr.SUFFIX,), raw.SUFFIXES))
        found = next((group for group in groups if group), [])
    return sorted(found, key=lambda path: natural_key(path.name))


def files_in(folder: Path, pattern: str) -> list[Path]:
    """Files directly in `folder` that fit the `pattern`. Hidden ones are left out, as macOS puts them beside others (`._pose.txt`)."""
    return [path for path in folder.glob(pattern) if not path.name.startswith(".") and path.is_file()]


def unique_names(paths: Sequence[Path]) -> list[str]:
    """A short name for each image: its stem; with its folders, then its suffix, where stems repeat."""
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    depth = min(len(path.parts) for path in paths)
    common = 0
    while common < depth - 1 and len({path.parts[common] for path in paths}) == 1:
        common += 1
    short = ["_".join([*path.parts[common:-1], path.stem]) for path in paths]
    return short if len(set(short)) == len(short) else ["_".join(path.parts[common:]) for path in paths]


# --------------------------------------------------------------------------------------------------- small files


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """A text file that may come from anybody.

    Raises:
        InputError: missing, too large, or not text.
    """
    try:
        if path.stat().st_size > max_bytes:
            raise InputError(f"{path} is larger than {max_bytes / 2**20:.0f} MB, too large for a text file of a capture")
        return path.read_text(encoding="utf-8-sig")  # with or without the mark that Windows' programs put first
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file in UTF-8; check how it was written") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def read_numbers(path: Path) -> Array:
    """All numbers of a text file, float64; values may be infinite or NaN, the latter also as Microsoft's C library has it (`-1.#IND`)."""
    words = read_text(path).split()
    try:
        return np.array([float("nan") if word.lower().lstrip("+-").startswith(("1.#", "nan")) else float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{path} must hold numbers only ({first_line(error)}); check how it was written") from error


def read_matrix(path: Path, *shapes: tuple[int, int]) -> Array:
    """A small matrix in one of `shapes`, distinguished by how many numbers there are.

    Raises:
        InputError: not such a matrix.
    """
    numbers = read_numbers(path)
    for shape in shapes:
        if numbers.size == shape[0] * shape[1]:
            return numbers.reshape(shape)
    known = " or ".join(f"{rows}×{columns}" for rows, columns in shapes)
    raise InputError(f"{path} holds {counted(numbers.size, 'number')}, a {known} matrix is expected; check how it was written")


def read_object(path: Path) -> dict[str, Any]:
    """A JSON file whose top level is an object."""
    data = files.read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold a JSON object at its top level; check how it was written")
    return data


def number(data: Mapping[str, Any], key: str, where: str) -> float | None:
    """`data[key]` as a finite float, None when absent."""
    value = data.get(key)
    if value is None:
        return None
    try:
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(float(value)):
            raise ValueError
        return float(value)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{where}: {key!r} must be a finite number, not {str(value)[:40]!r}; correct it") from error


def numbers(value: Any, where: str, count: int | None = None, advice: str = "check how it was written") -> Array:
    """Lists of numbers, or of words that are, as finite float64; `count` of them in all, if it is given."""
    try:
        array = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where} must hold numbers only; {advice}") from error
    if array.ndim == 0 or count not in (None, array.size):
        raise InputError(f"{where} must hold {'a list of numbers' if count is None else counted(count, 'number')}; {advice}")
    if not np.isfinite(array).all():
        raise InputError(f"{where} holds values that are not finite numbers; {advice}")
    return array


# --------------------------------------------------------------------------------------------------- at the end


def same_count(images: int, poses: int, where: Path) -> None:
    """Raises: InputError: the numbers of images and poses differ."""
    if images != poses:
        raise InputError(
            f"{where} holds {counted(images, 'image')} but {counted(poses, 'pose')}; "
            "each image needs exactly one pose, add or remove what does not belong"
        )


def assemble(kind: str, root: Path, frames: Sequence[Frame], remarks: Sequence[str] = (), **facts: Any) -> Capture:
    """The capture, frames in natural order of their names; those without a name are named by their images. `alpha` is measured on a few
    of its images unless `facts` have it.

    Raises:
        InputError: no frame is left, or two frames have one name.
    """
    if not frames and unread_frames():
        raise InputError(next(iter(unread_frames().values())))
    if not frames:
        raise InputError(f"no usable image was found in {root}; check the folder's layout")
    if not all(frame.name for frame in frames):
        names = unique_names([frame.image for frame in frames])
        frames = [replace(frame, name=name) for frame, name in zip(frames, names, strict=True)]
    names = [frame.name for frame in frames]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{root}: the image {twice!r} is listed twice; list each image once")
    if "alpha" not in facts:
        facts["alpha"] = cut_out(frames)
    ordered = sorted(frames, key=lambda frame: natural_key(frame.name))
    return replace(Capture(kind=kind, root=root, frames=tuple(ordered)), warnings=tuple(remarks), **facts)
