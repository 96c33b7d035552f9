"""A capture in a zip file, of any layout that is known as a folder. Its files are unpacked once, and what they say their names are is
checked before one is written: no name leads anywhere else, nothing is a link, and a small file does not become a large one.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from fieldfuse.capture.archive import open_archive
from fieldfuse.capture.record3d import holds_record3d
from fieldfuse.errors import InputError, OutputError, brief, first_line
from fieldfuse.files import atomic_path, fingerprint, read_json, remove, write_json
from fieldfuse.progress import SILENT, Progress

UNPACKED = "unpacked"  # folder of a run
SUFFIX = ".zip"
MOST_FILES = 200_000
MOST_TIMES, MOST_BYTES = 100, 2**28  # what files become when they are unpacked: so many times the zip file's size, and so much
MARKER = ".source.json"  # in the folder: which zip file it is of
LONGEST, LONGEST_PART = 2000, 240  # bytes of a file's name with its folders, and of each
CHUNK = 2**20


def is_packed(source: Path) -> bool:
    """Whether a source is a zip file that has to be unpacked. Record3D's recordings are read as they are.

    Raises:
        InputError: it is called a zip file, and is none.
    """
    return source.suffix.lower() == SUFFIX and source.is_file() and not holds_record3d(source)


@contextmanager
def unpacked(source: Path, folder: Path | None = None, progress: Progress = SILENT) -> Iterator[Path]:
    """The folder of the capture that a zip file holds; any other source as it is. Errors inside name the zip file, not the folder.

    Args:
        folder: where it is unpacked to, unless that was done before, and stays if nothing fails inside; None: a temporary one that goes.

    Raises:
        InputError: a name that leads out, a link, too much in it, a password, or it is damaged.
        OutputError: there is no room for it.
    """
    if not is_packed(source):
        yield source
        return
    temporary = None if folder is not None else tempfile.TemporaryDirectory(prefix="fieldfuse-")
    place = folder if folder is not None else Path(temporary.name if temporary else "") / UNPACKED
    before = place.exists()
    try:
        unpack(source, place, progress)
        yield _top(place)
    except InputError as error:
        if not before:
            remove(place)
        raise InputError(str(error).replace(str(place), str(source))) from error
    finally:
        if temporary is not None:
            temporary.cleanup()


def unpack(archive: Path, folder: Path, progress: Progress = SILENT) -> None:
    """Unpack a zip file into `folder`, all of it or nothing; what is there of the very same file is left as it is.

    Raises: as `unpacked`.
    """
    state, members = fingerprint(archive), _members(archive)
    with suppress(InputError, OSError):  # the marker is not there, or a file
        if read_json(folder / MARKER) == state and all((folder / name).stat().st_size == of.file_size for name, of in members.items()):
            return
    needed = sum(member.file_size for member in members.values())
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder.parent).free
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror}; choose another folder") from error
    if needed > free:
        megabytes = f"{needed / 2**20:.0f} MB, and {folder.parent} has {free / 2**20:.0f} MB free"
        raise OutputError(f"{archive} unpacks to {megabytes}; make room there")
    remove(folder)
    opened = open_archive(archive)
    with atomic_path(folder) as temporary:
        for number, (name, member) in enumerate(members.items()):
            progress.check()
            progress.update(number, len(members), f"unpacking {brief(name)}")
            target = temporary.joinpath(*PurePosixPath(name).parts)
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("xb") as file:
                for chunk in _chunks(opened, member, f"{brief(name)} in {archive}"):
                    file.write(chunk)
        write_json(temporary / MARKER, state)


def _chunks(opened: zipfile.ZipFile, member: zipfile.ZipInfo, what: str) -> Iterator[bytes]:
    try:
        with opened.open(member) as packed:
            while chunk := packed.read(CHUNK):
                yield chunk
    except Exception as error:  # zipfile, zlib and the system raise many families on damaged files
        raise InputError(
            f"{what} cannot be unpacked ({first_line(error)}); copy the zip file again, or unpack it by another program and give the folder"
        ) from error


def folder_around(root: Path) -> Path | None:
    """The folder in which a zip file was unpacked that holds the capture at `root`; None where it came from none."""
    return next((place.parent for place in (root, *root.parents) if (place / MARKER).is_file()), None)


def _members(archive: Path) -> dict[str, zipfile.ZipInfo]:
    """The files of a zip file by their names with forward slashes, without hidden ones and what macOS adds.

    Raises:
        InputError: as `unpacked`.
    """
    found: dict[str, zipfile.ZipInfo] = {}
    for member in open_archive(archive).infolist():
        name = member.filename.replace("\\", "/")
        if re.match(r"/|[A-Za-z]:", name) or ".." in name.split("/"):
            raise InputError(f"{archive} holds {brief(repr(name))}, a name that leads out of its folder; make the zip file anew")
        parts = PurePosixPath(name).parts
        if len(os.fsencode(name)) > LONGEST or any(len(os.fsencode(part)) > LONGEST_PART for part in parts):
            raise InputError(f"{archive} holds {brief(repr(name))}, a name too long for a file; make the zip file anew, with shorter ones")
        if name.endswith("/") or not parts or any(part.startswith((".", "__MACOSX")) for part in parts):
            continue
        if stat.S_ISLNK(member.external_attr >> 16):
            raise InputError(f"{archive} holds {brief(repr(name))}, which is a link; make the zip file anew, with the file itself")
        if member.flag_bits & 1:
            raise InputError(f"{archive} is locked by a password; unpack it, and give the folder")
        name = "/".join(parts)
        if name in found:
            raise InputError(f"{archive} holds {brief(repr(name))} twice; make the zip file anew")
        found[name] = member
        if len(found) > MOST_FILES:
            raise InputError(f"{archive} holds more than {MOST_FILES} files; give one capture")
    if both := next((str(parent) for name in found for parent in PurePosixPath(name).parents if str(parent) in found), None):
        raise InputError(f"{archive} holds {brief(repr(both))} twice, as a file and as a folder; make the zip file anew")
    if not found:
        raise InputError(f"{archive} is empty; make the zip file anew from the capture's folder")
    total, most = sum(member.file_size for member in found.values()), MOST_BYTES + MOST_TIMES * archive.stat().st_size
    if total > most:
        raise InputError(
            f"{archive} becomes {total / 2**20:.0f} MB when it is unpacked, more than images do ({most / 2**20:.0f} MB at most); if that "
            "is right, unpack it by another program and give the folder"
        )
    return found


def _top(folder: Path) -> Path:
    """The folder itself, or the one that is all that it holds."""
    while True:
        children = [child for child in folder.iterdir() if child.name != MARKER]
        if len(children) != 1 or not children[0].is_dir():
            return folder
        folder = children[0]
