"""`fieldfuse simulate SCENE.yaml --out CAPTURE`: film a scene, with exact ground truth and exactly the listed effects."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fieldfuse.pipelines.options import Options, show, takes


@takes("seed quiet json")
def simulate(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE.yaml", help="A scene file, or the name of one that comes along (room, street, …).")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the capture; must not hold anything yet.", show_default=False)],
    effects: Annotated[
        str | None,
        typer.Option(help="name or name:strength, separated by commas, instead of the scene file's; none: no effects.", show_default=False),
    ] = None,
    *,
    options: Options,
) -> None:
    """Film a procedural or mesh scene into a capture with ground truth beside it."""
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.simulate.settings import read_scene_file
    from fieldfuse.simulate.simulate import simulate as film_scene

    path = find_scene(scene)
    settings = read_scene_file(path)
    if options.seed is not None:
        settings.seed = options.seed
    listing = None if effects is None else [name for name in effects.split(",") if name.strip() not in ("", "none")]
    progress = make_progress(options.quiet or options.json)
    with progress.listening(), progress.stage("film"):
        film = film_scene(settings, out, path.parent, listing, progress)
    names = list(film.effects.names())
    facts = {"capture": str(out), "scene": settings.scene, "seed": settings.seed, "frames": len(film), "effects": names}
    show(facts, options, lambda: [f"{out}: {len(film)} frames, effects: {', '.join(names) or 'none'}"])


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
