"""What the formats that are made when they are named need."""

from __future__ import annotations

from typing import Any

from fieldfuse.extras import extra

# Of formats, as `export.formats` has them: the modules that write them, and the extra.
NEEDED = {"las": (("laspy",), "las"), "laz": (("laspy", "lazrs"), "las"), "e57": (("pye57",), "e57"), "usdz": (("pxr",), "usd")}


def require(kind: str) -> Any:
    """The first module that writes a format; None where no extra is needed.

    Raises:
        InputError: it is not installed.
    """
    modules, name = NEEDED.get(kind, ((), ""))
    return next(iter([extra(name, module, f"the format {kind}") for module in modules]), None)
