"""Fieldfuse: NeRFusion-style radiance fields on sparse voxel blocks, with a TSDF baseline beside them. See `fieldfuse.api`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from fieldfuse.api import evaluate, fit, fuse_tsdf, infer, load
    from fieldfuse.errors import FieldfuseError, InputError, Interrupted, OutputError, PoseError
    from fieldfuse.results import Camera, Field, Mesh, Points, Render, Scene, Scores, Splats, Surface

_FUNCTIONS = ("evaluate", "fit", "fuse_tsdf", "infer", "load")
_ERRORS = ("FieldfuseError", "InputError", "Interrupted", "OutputError", "PoseError")
__all__ = [
    "Camera",
    "Field",
    "FieldfuseError",
    "InputError",
    "Interrupted",
    "Mesh",
    "OutputError",
    "Points",
    "PoseError",
    "Render",
    "Scene",
    "Scores",
    "Splats",
    "Surface",
    "evaluate",
    "fit",
    "fuse_tsdf",
    "infer",
    "load",
]


def __getattr__(name: str) -> Any:
    """Names are imported at their first use, so that `import fieldfuse` alone is quick."""
    from importlib import import_module

    if name in __all__:
        module = "api" if name in _FUNCTIONS else "errors" if name in _ERRORS else "results"
        return getattr(import_module(f"fieldfuse.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
