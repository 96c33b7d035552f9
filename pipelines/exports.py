"""Files for other programs, made of a run's field in the input's frame: points, meshes, textures, cameras, the page and the video."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse import memory
from fieldfuse.camera import Array
from fieldfuse.capture.convert import all_converted, stored_cameras
from fieldfuse.capture.select import SELECTED
from fieldfuse.capture.types import MODEL_NAMES, Capture
from fieldfuse.capture.unpack import folder_around
from fieldfuse.errors import InputError
from fieldfuse.export.cameras import write_cameras
from fieldfuse.export.crop import seen_part
from fieldfuse.export.extras import require
from fieldfuse.export.georeference import write_georeference
from fieldfuse.export.parts import PARTS
from fieldfuse.export.sparse import colours_in, points_of_field, stored_points
from fieldfuse.export.surface import Originals, at_most, surface_of_field, whole_mesh
from fieldfuse.export.undistorted import write_undistorted
from fieldfuse.files import write_json
from fieldfuse.memory import require_pictures
from fieldfuse.pipelines.cropping import shown_part
from fieldfuse.pipelines.fields import Fitted
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.pictures import NAME, PAGE, orbit_cameras, put_page
from fieldfuse.pipelines.prepare import Prepared
from fieldfuse.pipelines.schemas import read_export_facts
from fieldfuse.pipelines.splats import SPLAT_FILES, SPZ, remove_old_splats, splats_or_why_not
from fieldfuse.pipelines.stages import CollectingStage
from fieldfuse.pipelines.surfaces import in_input, put_cloud, put_points
from fieldfuse.pipelines.textured import TEXTURED, put_textured
from fieldfuse.poses.region import Region
from fieldfuse.render.film import film
from fieldfuse.tone import exposed
from fieldfuse.tsdf.mesh import as_bytes

if TYPE_CHECKING:
    from fieldfuse.render.splats import Splats

MESHES = ("ply", "obj", "glb")  # as `export.formats` has them
TEXTURE = "texture"
TEXTURES = {TEXTURE: TEXTURED, "usdz": "textured.usdz"}
CLOUDS = ("las", "laz", "e57")
SURFACES = {"points", *CLOUDS, *MESHES, *TEXTURES}
UNDISTORTED = "undistorted"
MOST_TRIANGLES = 2_000_000
VIDEO_SIDE = 640
BESIDE_BYTES = 4 * 2**30  # that are free where the page and the video are made beside meshes
FPS = 30
REMOVED = "of {}, and removed: {}; `fieldfuse export {} --formats …` exports this one"
GONE = (
    "the folder of the capture, {}, is not there any more, and its pictures are needed; put it back (or repeat the run's own command with "
    "its new place) and run the command again"
)
LOST = "the capture's picture {} is not there any more; put it back and run the command again"
WITHOUT = "the finer field's points and meshes cannot be made: {}, or leave them out with --set 'export.formats=[{}]'"


@dataclass(frozen=True)
class Wish:
    """What is to be exported.

    Attributes:
        formats: this time; None: those of the settings, which a later command makes, too.
        alone: nothing but exports is wanted.
    """

    formats: list[str] | None = None
    alone: bool = False


@dataclass
class Exported:
    """What was written.

    Attributes:
        facts: of the mesh (triangles, watertight, …) and `notes` on what was left out.
        whole: False: something was left out for want of the capture's images, and can be made when they are there again.
    """

    facts: dict[str, Any]
    files: list[Path] = field(default_factory=list)
    made: set[str] = field(default_factory=set)  # formats
    whole: bool = True


def export_results(job: Job, ready: Prepared, fitted: Fitted, wish: Wish) -> dict[str, Any]:
    """Write what is wanted; answers the mesh's facts and notes. Files of the same field that were made before, in other formats, stay.

    Raises:
        InputError: nothing else is wanted, and none of it could be made.
    """
    path = job.folder / "exports" / "facts.json"
    old, exported = job.stages.record("export"), Exported({})
    part = job.settings.export.crop + (", cleaned" if job.settings.export.clean else "")
    same_part = not path.is_file() or read_export_facts(path)["part"] == part
    formats = job.settings.export.formats if wish.formats is None else wish.formats
    splats = splats_or_why_not(job, ready, fitted, formats) if "export" not in job.stages.trusted else None

    def make() -> dict[str, Any]:
        nonlocal exported
        fits = job.stages.usable("export") and same_part
        before = read_export_facts(path) if fits else None
        exported = export_field(job, ready, fitted, wish, splats)
        stage.whole, facts = exported.whole, {**exported.facts, "part": part}
        if wish.alone and not exported.made:
            raise InputError(f"nothing was exported: {'; '.join(facts['notes'])}")
        if before is not None and facts["mesh"] is None:
            facts["mesh"] = before["mesh"]
        if old is not None and not fits:
            made = {file.relative_to(job.folder.path).as_posix() for file in exported.files}
            left = [Path(name) for name in set(old.outputs) - made if name.startswith("exports/")]
            earlier = {one.name for one in left if one.parent.name != PARTS} - {path.name}
            gone = sorted(earlier | (remove_old_splats(job) if splats is None else set()))
            of = "an earlier field" if same_part else "another crop"
            facts["notes"] += [REMOVED.format(of, ", ".join(gone), job.folder.path)] if gone else []
        return facts

    def save(facts: dict[str, Any]) -> list[Path]:
        write_json(path, facts)
        return [path, *exported.files]

    stage = CollectingStage(
        "export",
        make=make,
        save=save,
        load=partial(read_export_facts, path),
        inputs=["field", "poses", "scene", "views"],
        settings=asdict(job.settings.export),
        version=3,
        only_part=wish.formats is not None,
        renewed=not same_part,
    )
    return job.run(stage)


def export_field(job: Job, ready: Prepared, fitted: Fitted, wish: Wish, splats: Splats | str | None) -> Exported:
    """What this command or the settings' `export.formats` name, in the input's frame; `splats`: those of the run, or why there are none."""
    from fieldfuse.render.splat_files import save_splats

    views, folder = ready.views, job.folder / "exports"
    formats = set(job.settings.export.formats if wish.formats is None else wish.formats)
    notes: list[str] = []
    out = Exported({"mesh": None, "notes": notes})
    undone: set[str] = set()
    fitted, region = shown_part(job, ready, fitted, notes, wish.alone)
    for name in sorted(formats):
        try:
            require(name)
        except InputError as error:
            undone.add(name)
            notes.append(f"{name} was left out: {error}")
    for what, names, side in needs_originals(job, formats):
        gone = missing_originals(job, ready, side)
        if gone is not None and names - undone:
            undone |= names
            notes.append(f"{what} left out: {gone}")
    out.whole = not undone
    # Meshes and texture keep one core busy for much of their time, so that the page and the video are made beside them.
    roomy = fitted.field.device.type == "cpu" and memory.available() > BESIDE_BYTES
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(put_shown, job, ready, fitted, formats) if roomy and formats & SURFACES - undone else None
        if surfaces := (formats - undone) & SURFACES:
            try:
                out.facts["mesh"], out.files = export_surface(job, ready, (fitted, region), surfaces, notes)
                undone |= {name for name, file in TEXTURES.items() if folder / file not in out.files}
            except InputError as error:
                undone |= surfaces
                notes.append(f"points and meshes were left out: {error}")
        if ready.poses.georeference is not None:
            out.files += write_georeference(folder, ready.poses.georeference)
        if wanted := (formats - undone) & {"cameras", UNDISTORTED}:
            sparse = starting_points(job, ready, fitted)
            if "cameras" in wanted:
                put_cameras(folder / "cameras", ready.posed, *sparse)
                out.files += [path for path in sorted((folder / "cameras").rglob("*")) if path.is_file()]
            if UNDISTORTED in wanted:
                try:
                    out.files += write_undistorted(folder / UNDISTORTED, ready.posed, *sparse, views.test, job.progress)
                except InputError as error:
                    undone, out.whole = undone | {UNDISTORTED}, False
                    notes.append(f"undistorted images were left out: {error}")
    shown = beside.result() if beside is not None else put_shown(job, ready, fitted, formats)
    out.files += shown.files
    notes += shown.facts["notes"]
    undone |= formats & {PAGE, "video"} - shown.made
    if isinstance(splats, str):
        undone |= formats & set(SPLAT_FILES)
        notes.append(splats)
    elif splats is not None:
        if job.settings.export.clean:
            notes.append("floaters stay in splats: their steps remove what no image wants")
        if SPZ in formats:
            save_splats(folder / SPLAT_FILES[SPZ], splats)
            out.files.append(folder / SPLAT_FILES[SPZ])
    out.made = formats - undone
    return out


def put_shown(job: Job, ready: Prepared, fitted: Fitted, formats: set[str]) -> Exported:
    """The page and the orbit video, where they are among the formats; of both, the field without what no training view sees."""
    from fieldfuse.export.video import write_video

    views, scene, folder, out = ready.views, ready.scene, job.folder / "exports", Exported({"notes": []})
    if not formats & {PAGE, "video"}:
        return out
    shown = seen_part(fitted.field, ready.training.intrinsics, ready.training.world_from_camera, job.progress)
    if PAGE in formats:
        try:
            out.files += put_page(job, folder / NAME, shown, views, scene)
            out.made.add(PAGE)
        except InputError as error:
            out.facts["notes"].append(f"the page to walk through was left out: {error}")
    if "video" in formats:
        _, lenses, around = orbit_cameras(views, scene, job.settings.export.video_frames)
        job.progress.update(0, len(around), "orbit video")
        lenses = [at_most(lens, VIDEO_SIDE) for lens in lenses]
        require_pictures(lenses, kept=False, advice="leave video out of export.formats")
        frames = (exposed(as_bytes(frame), views.exposure) for frame in film(shown, lenses, around, job.progress))
        write_video(folder / "orbit.mp4", frames, FPS)
        out.files.append(folder / "orbit.mp4")
        out.made.add("video")
    return out


def export_surface(
    job: Job, ready: Prepared, part: tuple[Fitted, Region | None], formats: set[str], notes: list[str]
) -> tuple[dict[str, Any], list[Path]]:
    """The field's depth at the training cameras, polished by their images as they were taken and fused: points and meshes of the region of
    interest; `notes` gets a sentence when the texture had to be left out.

    Raises:
        InputError: the field has no surface.
    """
    from fieldfuse.export.mesh import mesh_facts, write_mesh

    folder, exposure = job.folder / "exports", ready.views.exposure
    fitted, region = part
    originals = Originals(ready.posed, ready.corrections)
    volume = surface_of_field(fitted.field, ready.views, ready.scene, job.settings, originals, job.progress, region)
    memory.give_back()  # what images and depth maps took
    input_from_working = ready.scene.working_from_input.inverse()
    written = []
    if formats & {"points", *CLOUDS}:
        points = volume.points()
        written += [put_points(folder / "points.ply", points, input_from_working, exposure)] if "points" in formats else []
        for path in [folder / f"points.{kind}" for kind in CLOUDS if kind in formats]:
            note = put_cloud(path, in_input(points, input_from_working, exposure), ready.poses.georeference)
            notes += [] if note is None else [note]
            written.append(path)
        del points
    whole = whole_mesh(volume, job.settings.export.smooth)
    del volume
    mesh = whole.decimated(MOST_TRIANGLES).transformed(input_from_working)
    mesh = replace(mesh, colours=exposed(mesh.colours, exposure))
    facts = mesh_facts(mesh)
    for path in [job.folder / "mesh.ply", *(folder / f"mesh.{suffix}" for suffix in MESHES if suffix in formats)]:
        write_mesh(path, mesh)
        written.append(path)
    if wanted := [folder / file for kind, file in TEXTURES.items() if kind in formats]:
        memory.give_back()
        try:
            # People who walk through belong into a texture as little as into the field.
            shown = ready if fitted.left_out is None else replace(ready, views=fitted.left_out.without(ready.views))
            put_textured(job, shown, wanted, whole)
            written += wanted
        except InputError as error:
            notes.append(f"the texture was left out: {error}")
    return facts, written


def put_cameras(folder: Path, posed: Capture, points: Array | None = None, colours: Array | None = None) -> None:
    """Cameras as transforms.json and COLMAP text, to be put into the capture's folder: for the images as they lie there.

    Args:
        points, colours: (P, 3) in the input's frame, and their colours (None: grey).
    """
    cut = all(frame.instant is not None for frame in posed.frames)
    made_here = cut or SELECTED in posed.extra or all_converted(posed)  # then the images lie in the run's folder
    root = posed.frames[0].image.parents[2 if cut else 1] if made_here else folder_around(posed.root) or posed.root
    # A capture that is reached through a link has its images where the link leads.
    bases = (root, root.resolve())
    paths = [frame.image for frame in posed.frames]
    files = [next((path.relative_to(base).as_posix() for base in bases if path.is_relative_to(base)), str(path)) for path in paths]
    known = {} if made_here else posed.extra.get(MODEL_NAMES, {})
    names = [known.get(frame.name, file) for frame, file in zip(posed.frames, files, strict=True)]
    # Those of the frames that take part, which may be fewer than have a pose.
    intrinsics, world_from_camera = stored_cameras(posed)
    write_cameras(folder, files, intrinsics, world_from_camera, points, colours, names)


def starting_points(job: Job, ready: Prepared, fitted: Fitted) -> tuple[Array, Array]:
    """(P, 3) points in the input's frame, and their colours (P, 3) uint8, for programs that start from some: those that came with the
    poses, else of the surface that was exported, else of renders of the field."""
    views, working, points = ready.training, ready.scene.working_from_input, ready.poses.points
    if points is not None and len(points):
        return points, exposed(colours_in(working.points(points), views), views.exposure)
    if (stored := stored_points(job.folder / "exports" / "points.ply")) is not None and len(stored[0]):
        return stored
    points, colours = points_of_field(fitted.field, views, job.settings.engine)
    return working.inverse().points(points), exposed(colours, views.exposure)


def needs_originals(job: Job, formats: Iterable[str]) -> list[tuple[str, set[str], int]]:
    """What of `formats` is made of images as they were taken: how a sentence on it begins, the formats, and the images' long side."""
    surfaces, export = SURFACES & set(formats), job.settings.export
    found = [("points and meshes were", surfaces, export.mesh_size), ("the texture was", surfaces & TEXTURES.keys(), export.texture_size)]
    return [one for one in found if one[1]]


def missing_originals(job: Job, ready: Prepared, side: int) -> str | None:
    """A sentence when `Originals.at` could not read the training images, since they are gone."""
    train, shown, posed = np.flatnonzero(~ready.views.test), ready.training, ready.posed
    if Originals(posed).at(train, shown, side)[0] == shown.intrinsics:
        return None  # the run has them
    lost = next((path for index in train if not (path := posed.frames[index].image).is_file()), None)
    if lost is None:
        return None
    return LOST.format(lost) if posed.root.is_dir() or lost.is_relative_to(job.folder.path) else GONE.format(posed.root)


def require_originals(job: Job, ready: Prepared) -> None:
    """Before a field is replaced: what the run exports can be made of the next one, too. The run's settings stay as they were, else.

    Raises:
        InputError: the capture's images are needed for that, and are gone.
    """
    formats = job.settings.export.formats
    for _, _, side in needs_originals(job, formats):
        if gone := missing_originals(job, ready, side):
            job.folder.restore()
            raise InputError(WITHOUT.format(gone, ",".join(name for name in formats if name not in SURFACES)))
