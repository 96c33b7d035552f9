"""Packages that only some formats need: each is an extra of the installation."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fieldfuse.errors import InputError

# Of formats, as `export.formats` has them: the modules that write them, and the extra.
NEEDED = {"las": (("laspy",), "las"), "laz": (("laspy", "lazrs"), "las"), "e57": (("pye57",), "e57"), "usdz": (("pxr",), "usd")}


def require(kind: str) -> Any:
    """The first module that writes a format; None where no extra is needed.

    Raises:
        InputError: it is not installed.
    """
    modules, extra = NEEDED.get(kind, ((), ""))
    try:
        return next(iter([import_module(name) for name in modules]), None)
    except ImportError as error:
        sentence = f'the format {kind} needs the extra `{extra}`, which is not installed: pip install "fieldfuse[{extra}]"'
        raise InputError(sentence) from error
