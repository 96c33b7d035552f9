"""Files on disk: atomic writes, safe paths, hashes. Every writer in the toolkit goes through `atomic_path`."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError

from fieldfuse.errors import InputError, OutputError, brief, first_line

MAX_JSON_BYTES = 64 * 2**20


@contextmanager
def atomic_path(target: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside `target`; on success rename it to `target`, on failure remove it.

    The suffix is kept (`mesh.ply` → `.tmp-<pid>-mesh.ply`), because writers choose their format by it.

    Raises:
        OutputError: the folder is not writable or the disk is full.
    """
    target = Path(target)
    temporary = target.with_name(f".tmp-{os.getpid()}-{target.name}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}; free space or choose another folder") from error
    except SafetensorError as error:  # says of a full disk what an OSError would
        raise OutputError(f"cannot write {target}: {first_line(error)}; free space or choose another folder") from error
    finally:
        with suppress(OSError):  # what went wrong is already on its way up
            remove(temporary)


def remove(path: Path) -> None:
    """Remove a file or a folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def write_json(path: Path | str, value: Any) -> None:
    """Write `value` as indented JSON, atomically. NaN and infinity are refused (they are not JSON)."""
    text = json.dumps(value, indent=1, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path | str, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file that may come from anybody: size bounded, nesting bounded by the parser.

    Raises:
        InputError: missing, too large, not UTF-8, not JSON, or nested too deeply.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            most = f"{max_bytes / 2**20:.0f} MB"
            raise InputError(f"{path} holds {size / 2**20:.0f} MB of JSON, more than the {most} that is read; remove what is not needed")
        return json.loads(path.read_text(encoding="utf-8-sig"))  # with or without the mark that Windows' programs put first
    except RecursionError as error:
        raise InputError(f"{path} is nested too deeply to be read as JSON; check how it was written") from error
    except ValueError as error:  # not JSON, not UTF-8, or a number of thousands of digits
        raise InputError(f"{path} is not valid JSON ({first_line(error)}); check how it was written") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def inside(root: Path, relative: str) -> Path:
    """`root / relative`, refused when it leads outside `root` (also through links or an absolute path).

    Raises:
        InputError: the path leads outside.
    """
    root = root.resolve()
    try:
        resolved = (root / relative).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"the path {brief(repr(relative))} listed in {root} is not usable ({first_line(error)})") from error
    if _circular(resolved):
        raise InputError(f"the path {brief(repr(relative))} listed in {root} is not usable (its links lead in a circle)")
    if not resolved.is_relative_to(root) and Path(os.path.normpath(root / relative)).is_relative_to(root):
        raise InputError(
            f"{brief(repr(relative))} is a link, or lies in a linked folder, that leads outside the capture folder {root}; only files "
            "inside it are read: copy there what it links to"
        )
    if not resolved.is_relative_to(root):
        raise InputError(f"the path {brief(repr(relative))} leads outside the capture folder {root}; only files inside it are read")
    return resolved


def require_utf8(path: Path) -> None:
    """Refuse what libraries cannot open, some of them only when a fit is done, and others by ending the process.

    Raises:
        InputError: the path is not UTF-8, as where an archive was unpacked with names in another encoding.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"the name {path} is not UTF-8, and other programs cannot open it; rename it, with letters that show") from error


def _circular(path: Path) -> bool:
    """Whether links are left after `resolve`, which says so by itself up to Python 3.12."""
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def fingerprint(*parts: Any) -> str:
    """A short hash of plain data (JSON-able; paths by name, size and modification time), for stage keys."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            stat = part.stat()
            part = [str(part.resolve()), stat.st_size, stat.st_mtime_ns]
        digest.update(json.dumps(part, sort_keys=True, default=_plain).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:16]


def _plain(value: Any) -> Any:
    """Arrays by their content (their text form leaves out most of it), other things by their text form."""
    if isinstance(value, np.ndarray | np.generic):
        return [str(value.dtype), list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    return str(value)
