"""Where the images of a COLMAP model lie: by their names, and by what other systems and programs make of names.

COLMAP for Windows writes `cam\\0001.jpg`. In its text files a space ends a name for many programs, so some (`toolkit/export/cameras.py`
too) put underscores there: such a name stands for the one picture whose spaces become them.
"""

from __future__ import annotations

import re
from pathlib import Path

from toolkit import files
from toolkit.capture.listing import is_file

_SPACES = re.compile(r"\s+")


def locate(folder: Path, names: list[str]) -> dict[int, Path]:
    """Index of a name → its file in `folder`, of the names that are there.

    Raises:
        InputError: a name leads outside `folder`.
    """
    found: dict[int, Path] = {}
    for index, name in enumerate(names):
        path = files.inside(folder, name)
        if not is_file(path) and "\\" in name:
            path = files.inside(folder, name.replace("\\", "/"))
        if is_file(path):
            found[index] = path
    taken = set(found.values())
    children: dict[Path, dict[str, list[str]]] = {}
    for index, name in enumerate(names):
        if index not in found and "_" in name:
            spaced = _with_spaces(folder, name.replace("\\", "/"), children)
            if spaced is not None and spaced not in taken:
                found[index] = spaced
    return found


def _with_spaces(folder: Path, name: str, children: dict[Path, dict[str, list[str]]]) -> Path | None:
    """The one file whose path below `folder` becomes `name` when each run of spaces becomes an underscore; None for none, or several.

    `children` keeps folders that were looked through: name with underscores → names in that folder.
    """
    places = [""]
    for part in name.split("/"):
        nexts = []
        for place in places:
            where = files.inside(folder, place)
            if where not in children:
                children[where] = _listing(where)
            nexts += [f"{place}{child}/" for child in children[where].get(part, [])]
        places = nexts
    found = [path for place in places if is_file(path := files.inside(folder, place.rstrip("/")))]
    return found[0] if len(found) == 1 else None


def _listing(folder: Path) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    if folder.is_dir():
        for child in folder.iterdir():
            out.setdefault(_SPACES.sub("_", child.name), []).append(child.name)
    return out
