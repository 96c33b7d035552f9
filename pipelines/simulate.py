"""`fieldfuse simulate SCENE.yaml --out CAPTURE`: film a scene, with exact ground truth and exactly the listed effects."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from fieldfuse.pipelines.options import Json, Quiet, Seed


def simulate(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE.yaml", help="A scene file, or the name of one that comes along (room, street, …).")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the capture; must not hold anything yet.", show_default=False)],
    effects: Annotated[
        str | None,
        typer.Option(help="name or name:strength, separated by commas, instead of the scene file's; none: no effects.", show_default=False),
    ] = None,
    seed: Seed = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Film a procedural or mesh scene into a capture with ground truth beside it."""
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.simulate.settings import read_scene_file
    from fieldfuse.simulate.simulate import simulate as film_scene

    path = find_scene(scene)
    settings = read_scene_file(path)
    if seed is not None:
        settings.seed = seed
    listing = None if effects is None else [name for name in effects.split(",") if name.strip() not in ("", "none")]
    progress = make_progress(quiet or json)
    began = time.monotonic()
    with progress.listening():
        progress.begin("film")
        film = film_scene(settings, out, path.parent, listing, progress)
        progress.finish("film", time.monotonic() - began, cached=False)
    names = list(film.effects.names())
    if json:
        import json as writer

        facts = {"capture": str(out), "scene": settings.scene, "seed": settings.seed, "frames": len(film), "effects": names}
        typer.echo(writer.dumps(facts, indent=1))
    elif not quiet:
        typer.echo(f"{out}: {len(film)} frames, effects: {', '.join(names) or 'none'}")


def find_scene(name: str) -> Path:
    """The scene file of that path, or the one of that name among those that come along.

    Raises:
        InputError: neither is there.
    """
    from importlib import resources

    from fieldfuse.errors import InputError

    path = Path(name)
    if path.is_file():
        return path
    folder = resources.files("fieldfuse.configs").joinpath("scenes")
    known = sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))
    if name in known:
        return Path(str(folder.joinpath(f"{name}.yaml")))
    raise InputError(f"there is no scene file {name}; give the path of one, or one of {', '.join(known)}")
