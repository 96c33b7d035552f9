"""`fieldfuse export`: points, meshes, splats, cameras and an orbit video from a run's field."""

from __future__ import annotations

from typing import Annotated

import typer

from fieldfuse.config import EXPORTS, require_formats
from fieldfuse.errors import InputError
from fieldfuse.pipelines.options import Options, Place, takes
from fieldfuse.pipelines.work import work

CROP = "off, auto, box, hull, or a box x0,y0,z0,x1,y1,z1 in the input's frame; kept for later exports of this run."


@takes("threads config pairs quiet json")
def export(
    place: Place,
    formats: Annotated[
        str | None, typer.Option(help=f"Comma-separated part of {','.join(EXPORTS)}.", show_default=False)
    ] = None,
    undistorted: Annotated[
        bool, typer.Option("--undistorted", help="Pinhole images with cameras for nerfstudio, COLMAP and 3DGS, with --formats or alone.")
    ] = False,
    crop: Annotated[str | None, typer.Option(help=CROP, show_default=False)] = None,
    clean: Annotated[
        bool | None, typer.Option("--clean/--no-clean", help="Without parts that no two cameras see (floaters).", show_default=False)
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
    if undistorted:
        wanted = [*(wanted or []), "undistorted"]
    work(place, options, ("export",), options.settings(**{"export.crop": crop, "export.clean": clean}), formats=wanted)
