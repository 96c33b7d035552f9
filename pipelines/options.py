"""Arguments and flags that commands share, and how they become settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

Source = Annotated[
    Path, typer.Argument(help="A video, a folder of photos, or a posed capture; its kind is found by looking.", show_default=False)
]
Target = Annotated[Path, typer.Argument(help="The folder of an earlier run; or a source, then --out is needed.", show_default=False)]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for everything that the run makes.", show_default=False)]
OptionalOut = Annotated[
    Path | None, typer.Option("--out", "-o", help="Folder of the run, when the first argument is a source.", show_default=False)
]
Preset = Annotated[str | None, typer.Option(help="fast, balanced (default), quality, or paper (as NeRFusion does it).", show_default=False)]
Budget = Annotated[float | None, typer.Option(help="Seconds of optimisation.", show_default=False)]
ImageSize = Annotated[int | None, typer.Option(help="Long side of the pictures in pixels.", show_default=False)]
Holdout = Annotated[
    int | None, typer.Option(help="Every n-th picture by name is kept for testing; 0: none. Default 8.", show_default=False)
]
Device = Annotated[str | None, typer.Option(help="auto (default), cpu or cuda.", show_default=False)]
Threads = Annotated[int | None, typer.Option(help="Threads to use; default: all cores.", show_default=False)]
Seed = Annotated[int | None, typer.Option(help="Seed of all random numbers; default 0.", show_default=False)]
Engine = Annotated[
    str | None, typer.Option(help="auto (default): numba on the CPU, triton on CUDA; numba, triton or torch.", show_default=False)
]
Decoder = Annotated[str | None, typer.Option(help="deferred (default) or per_sample (the paper's).", show_default=False)]
Init = Annotated[
    str | None,
    typer.Option(
        help="Start of the fit: network, classical, or auto (default): the networks' with fewer than 24 training pictures.",
        show_default=False,
    ),
]
Finetune = Annotated[
    bool | None,
    typer.Option("--finetune/--no-finetune", help="Whether the networks' field is fitted (default), or the result.", show_default=False),
]
PosesFrom = Annotated[str | None, typer.Option("--poses", help="auto (default), given, or sfm: ignore given poses.", show_default=False)]
Baked = Annotated[
    bool, typer.Option("--baked", help="Take the baked field, as pages have it; it is made if need be.", show_default=False)
]
Config = Annotated[Path | None, typer.Option(help="YAML file with settings.", show_default=False)]
Pairs = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any setting as key=value; may be repeated.", show_default=False)
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]


def gather(preset: str | None = None, config: Path | None = None, pairs: list[str] | None = None, **flags: Any) -> dict[str, Any]:
    """Flags of a command → the options that `fieldfuse.pipelines.job.read_settings` takes."""
    return {"preset": preset, "config": config, "pairs": list(pairs or []), "flags": flags}
