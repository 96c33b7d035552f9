"""A scene file becomes a capture with its ground truth: all of the folder, or nothing of it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.effects.effect_specs import Effects, parse
from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate.capture_files import writing
from fieldfuse.simulate.film import Film
from fieldfuse.simulate.mesh_scene import SUFFIXES, load_mesh_scene
from fieldfuse.simulate.paths import plan
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.seen import Scenery
from fieldfuse.simulate.settings import SceneFile
from fieldfuse.simulate.workers import drawing

SCENE, PATH = 0, 1  # streams of random numbers


def open_scene(settings: SceneFile, beside: Path) -> Scenery:
    """The scene that a file names; meshes are looked for relative to the folder `beside`.

    Raises:
        InputError: there is no such kind or mesh.
    """
    if Path(settings.scene).suffix.lower() in SUFFIXES:
        mesh = load_mesh_scene(beside / settings.scene, settings.mesh.up, settings.mesh.scale)
        if settings.mesh.free is not None:
            mesh.free = np.sort(np.array(settings.mesh.free, dtype=np.float64), axis=0)
        if settings.mesh.focus is not None:
            mesh.focus = np.array(settings.mesh.focus, dtype=np.float64)
        return mesh
    return random_scene(settings.scene, np.random.default_rng([settings.seed, SCENE]))


def prepare(settings: SceneFile, beside: Path, effects: Effects) -> Film:
    """All that is needed to film: scene, path, camera and effects.

    Raises:
        InputError: as for `open_scene`, or the path does not fit into the scene, or the lens not over the picture.
    """
    for name in ("depth_noise", "depth_offset"):
        if getattr(effects, name) is not None and not settings.depth:
            raise InputError(f"{name} is listed, but the capture has no depth; set `depth: true` in the scene file")
    scene = open_scene(settings, beside)
    motion = plan(scene, settings.path, np.random.default_rng([settings.seed, PATH]))
    if effects.background is not None:
        effects = replace(effects, background=replace(effects.background, seed=effects.background.seed + settings.seed))
    return Film(scene, settings.camera.intrinsics(), motion, settings.path.times(), effects, settings.seed, settings.depth, settings.side)


def simulate(
    settings: SceneFile,
    out: Path | str,
    beside: Path | str = ".",
    effects: Any = None,
    progress: Progress = SILENT,
    workers: int | None = None,
) -> Film:
    """Film a scene into the folder `out`.

    Args:
        beside: the folder that the scene file's paths start from.
        effects: a list that replaces the scene file's; None: the scene file's.
        workers: frames drawn at the same time; None: one a core, at most 4. It changes no bit of the result.

    Returns:
        what was filmed, for comparing with what is found in it.

    Raises:
        InputError: settings that do not work, or a folder that already holds something.
        OutputError: a file cannot be written.
        Interrupted: stopped by the user; nothing is left behind.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} already holds something; give a new folder with --out, or remove it")
    listed = parse(settings.effects if effects is None else effects, "the effects")
    film = prepare(settings, Path(beside), listed)
    suffix = ".png" if listed.compression is None else ".jpg"
    with (
        atomic_path(out) as temporary,
        writing(temporary, film.intrinsics, settings.path.fps, settings.output, suffix) as writer,
        drawing(workers) as side_by_side,
    ):
        for done, shot in enumerate(side_by_side(film.shot, range(len(film)))):
            progress.check()
            writer.add(shot)
            progress.update(done + 1, len(film))
        writer.finish(_about(settings), film.effects.describe(), film.scene.mesh())
    return film


def _about(settings: SceneFile) -> dict[str, Any]:
    """The scene file with all defaults filled in; effects stand in a file of their own."""
    about = asdict(settings)
    about.pop("effects")
    return about
