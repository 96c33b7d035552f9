"""What the data set readers share: the folders of a data set's scenes, and a list of scenes where the site publishes one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fieldfuse.capture.listing import natural_key, read_text, require_folder
from fieldfuse.errors import InputError


def scene_folders(root: Path | str, is_scene: Callable[[Path], bool], what: str, inside: tuple[str, ...] = ()) -> list[Path]:
    """Folders of scenes directly in `root`, or in the first of its subfolders `inside` that has any; `root` itself when it is one.

    Raises:
        InputError: there is none.
    """
    root = require_folder(root)
    if is_scene(root):
        return [root]
    for place in (root, *(root / name for name in inside)):
        if place.is_dir():
            found = sorted((path for path in place.iterdir() if path.is_dir() and is_scene(path)), key=lambda path: natural_key(path.name))
            if found:
                return found
    raise InputError(f"{root} holds no scene of {what}; give the folder that holds the scenes, see docs/training.md")


def listed(root: Path, names: tuple[str, ...]) -> set[str] | None:
    """The words of the first list file of `names` that `root` has; None when it has none."""
    for name in names:
        if (root / name).is_file():
            return set(read_text(root / name).split())
    return None
