"""`fieldfuse export`: points, meshes, splats, cameras and an orbit video from a run's field."""

from __future__ import annotations

from typing import Annotated

import typer

from fieldfuse.config import EXPORTS, require_formats
from fieldfuse.errors import InputError
from fieldfuse.pipelines.options import Options, Place, takes
from fieldfuse.pipelines.work import work


@takes("threads config pairs quiet json")
def export(
    place: Place,
    formats: Annotated[
        str | None, typer.Option(help=f"Comma-separated part of {','.join(EXPORTS)}.", show_default=False)
    ] = None,
    *,
    options: Options,
) -> None:
    """Write the field as files for other programs, in the input's own frame and scale, into DIR/exports.

    --formats is for this call only: the formats of the run stay as they are set, and existing files of the same field stay.
    """
    wanted = None if formats is None else [name.strip() for name in formats.split(",") if name.strip()]
    if wanted == []:
        raise InputError(f"--formats names none; give some of {', '.join(EXPORTS)}, separated by commas")
    require_formats(wanted or [], "--formats")
    work(place, options, ("export",), options.settings(), formats=wanted)
