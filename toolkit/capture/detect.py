"""Which kind of capture lies at a path, found by looking at names (and, between two layouts, at two image headers).

The order is deliberate: what somebody wrote for this very purpose goes before what another step left behind.
1. `transforms.json`: nerfstudio leaves its COLMAP model beside it;
2. Blender's `transforms_train.json`;
3. RGB-D layouts, whose depth would be lost by reading them as anything else (ScanNet before 7-Scenes: they share file names), those of
   phones with a depth sensor among them;
4. DTU's `cameras*.npz`;
5. what photogrammetry programs export (Metashape, RealityCapture, OpenSfM and OpenDroneMap, Meshroom, Bundler);
6. a COLMAP model before LLFF's `poses_bounds.npy`: sets that have both keep lens and points only in the model, but only
   when its images are there (sets at 1/8 size often come without them);
7. colour and depth in folders of any name, with a list of poses;
8. photos; 9. one video (or recording in one file) in a folder, alone or with one image (its cover);
10. the only capture in a folder further down, as unpacking leaves it.

Where several of 1, 2, 5 and 6 lie in one folder, the first is used, unless it cannot be read or another has poses for many more images; the
others are named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fieldfuse.capture.archive import SUFFIXES as ARCHIVES
from fieldfuse.capture.arkitscenes import looks_like_arkitscenes, read_arkitscenes
from fieldfuse.capture.blender import looks_like_blender, read_blender
from fieldfuse.capture.bundler import looks_like_bundler, read_bundler
from fieldfuse.capture.colmap import candidate_models, has_images, looks_like_colmap, owners, read_colmap
from fieldfuse.capture.dtu import looks_like_dtu, read_dtu
from fieldfuse.capture.listing import IMAGES, counted, images_in, natural_key, require_folder, some_of
from fieldfuse.capture.llff import looks_like_llff, read_llff
from fieldfuse.capture.meshroom import ALEMBIC, looks_like_meshroom, read_meshroom, scenes_of
from fieldfuse.capture.metashape import looks_like_metashape, read_metashape
from fieldfuse.capture.opensfm import NAME as OPENSFM
from fieldfuse.capture.opensfm import looks_like_opensfm, read_opensfm
from fieldfuse.capture.photos import looks_like_photos, photo_files, read_photos
from fieldfuse.capture.polycam import looks_like_polycam, read_polycam
from fieldfuse.capture.realitycapture import looks_like_realitycapture, read_realitycapture
from fieldfuse.capture.record3d import SUFFIX as RECORD3D
from fieldfuse.capture.record3d import holds_record3d, looks_like_record3d, read_record3d
from fieldfuse.capture.redwood import looks_like_redwood, read_redwood
from fieldfuse.capture.replica import looks_like_replica, read_replica
from fieldfuse.capture.resolve import CaptureFiles
from fieldfuse.capture.rgbd_folder import looks_like_rgbd, read_rgbd, unused_depth
from fieldfuse.capture.scanner3d import looks_like_scanner3d, read_scanner3d
from fieldfuse.capture.scannet import looks_like_scannet, read_scannet, read_sens
from fieldfuse.capture.scannetpp import looks_like_scannetpp, read_scannetpp
from fieldfuse.capture.sens import is_sens
from fieldfuse.capture.seven_scenes import looks_like_seven_scenes, read_seven_scenes
from fieldfuse.capture.stray import looks_like_stray, read_stray
from fieldfuse.capture.transforms import looks_like_transforms, read_transforms
from fieldfuse.capture.tum import looks_like_tum, read_tum
from fieldfuse.capture.types import Capture
from fieldfuse.capture.video import VIDEO_SUFFIXES, read_video
from fieldfuse.errors import InputError
from fieldfuse.files import require_utf8

FILMS = (*VIDEO_SUFFIXES, RECORD3D)
DEEPEST, MOST_FOLDERS = 3, 200  # where captures are looked for that are not in the given folder itself
# Kinds without depth, whose files may lie together.
POSED_IMAGES = ("transforms", "blender", "metashape", "realitycapture", "opensfm", "meshroom", "bundler", "colmap", "llff")
FEWER = 0.8  # of the images that another has poses for, below which the first of several is not used
PROJECTS = {
    (".psx", ".psz"): "a project of Metashape; export its cameras as XML (File › Export › Export Cameras)",
    (".rsproj", ".rcproj"): 'a project of RealityCapture; export its registration as "Internal/External camera parameters" (CSV)',
    (".mg",): "a project of Meshroom; give its MeshroomCache, or the cameras.sfm of the node StructureFromMotion",
    (".abc",): ALEMBIC.removeprefix("is "),
}


def _colmap_without_llff(path: Path) -> bool:
    if looks_like_colmap(path):
        return not looks_like_llff(path) or has_images(path)
    # A model below is this folder's where its images lie here or in a sibling, and no capture of its own is around it.
    models = owners(path)
    if not models or looks_like_llff(path) or any(map(has_images, models)) or captures_below(path) != models:
        return False
    try:
        return bool(candidate_models(path)[0].images)
    except InputError:
        return not looks_like_photos(path)  # the reader reports what is wrong


def captures_below(folder: Path) -> list[Path]:
    """Folders below that hold a capture with poses, none of them within another; those of fewest parts first."""
    found = owners(folder)
    kinds = [looks_like for kind, looks_like, _ in READERS if kind not in ("colmap", "photos")]
    for below in _folders_below(folder):
        if not any(below.is_relative_to(other) for other in found) and any(looks_like(below) for looks_like in kinds):
            found.append(below)
    found = [one for one in found if not any(one != other and one.is_relative_to(other) for other in found)]
    return sorted(found, key=lambda one: (len(one.parts), natural_key(str(one))))


def _folders_below(folder: Path) -> list[Path]:
    return [folder / name for name in CaptureFiles(folder).folders() if name and name.count("/") < DEEPEST][:MOST_FOLDERS]


def _read_below(folder: Path) -> Capture | None:
    """The only capture in the folders below: of those with poses, else of photos, or a video; None where there is none.

    Several folders of images may be one capture's colour and depth, which only a layout shows.
    """
    found = captures_below(folder)
    if len(found) > 1:
        names = some_of([f"{one.relative_to(folder).as_posix()}/" for one in found], 4)
        raise InputError(f"{folder} holds {len(found)} captures ({names}); give one of them")
    if not found:
        found = [below for below in _folders_below(folder) if len(images_in(below)) > 1 or len(images_in(below, FILMS)) == 1]
    return _descended(folder, found[0]) if len(found) == 1 else None


def _posed_below(folder: Path) -> Capture | None:
    """The capture whose images are photos of this folder and whose json lies further down; None where there is none."""
    found = captures_below(folder)
    if len(found) != 1 or not looks_like_transforms(found[0]):
        return None
    try:
        capture = _descended(folder, found[0])
    except InputError:
        return None  # another's
    photos = {photo.resolve() for photo in photo_files(folder)}
    return capture if all(frame.image in photos for frame in capture.frames) else None


def _descended(folder: Path, below: Path) -> Capture:
    # What its json lists may lie beside its folder.
    capture = read_transforms(below, within=folder) if detect_kind(below) == "transforms" else read_source(below)
    return replace(capture, warnings=(f"the capture was found in {below.relative_to(folder).as_posix()}/", *capture.warnings))


def _photos_of(folder: Path) -> Capture:
    capture = read_photos(folder)
    return capture.with_frames(capture.frames, *unused_depth(folder))


def _photos_without_film(path: Path) -> bool:
    """One image beside a film is its cover, not a capture; and what lies in other folders may have been made of the film."""
    return len(photo_files(path)) > 1 if images_in(path, FILMS) else looks_like_photos(path)


READERS: tuple[tuple[str, Callable[[Path], bool], Callable[[Path], Capture]], ...] = (
    ("transforms", looks_like_transforms, read_transforms),
    ("blender", looks_like_blender, read_blender),
    ("scannetpp", looks_like_scannetpp, read_scannetpp),
    ("tum", looks_like_tum, read_tum),
    ("redwood", looks_like_redwood, read_redwood),
    ("replica", looks_like_replica, read_replica),
    ("scannet", looks_like_scannet, read_scannet),
    ("7scenes", looks_like_seven_scenes, read_seven_scenes),
    ("stray", looks_like_stray, read_stray),
    ("polycam", looks_like_polycam, read_polycam),
    ("record3d", looks_like_record3d, read_record3d),
    ("scanner3d", looks_like_scanner3d, read_scanner3d),
    ("arkitscenes", looks_like_arkitscenes, read_arkitscenes),
    ("dtu", looks_like_dtu, read_dtu),
    ("metashape", looks_like_metashape, read_metashape),
    ("realitycapture", looks_like_realitycapture, read_realitycapture),
    ("opensfm", looks_like_opensfm, read_opensfm),
    ("meshroom", looks_like_meshroom, read_meshroom),
    ("bundler", looks_like_bundler, read_bundler),
    ("colmap", _colmap_without_llff, read_colmap),
    ("llff", looks_like_llff, read_llff),
    ("rgbd", looks_like_rgbd, read_rgbd),
    ("photos", _photos_without_film, read_photos),
)


def detect_kind(folder: Path) -> str | None:
    """The name of the first layout that `folder` has, None when it has none of them."""
    return next((kind for kind, looks_like, _ in READERS if looks_like(folder)), None)


def read_source(path: Path) -> Capture:
    """The capture at `path`: a folder of any known layout, a video, a recording or scan in one file, or a `transforms*.json`.

    Raises:
        InputError: nothing there, nothing known, or the layout's own files are broken.
    """
    path = path.absolute()
    if path.exists():
        require_utf8(path)
    return _read_file(path) if path.is_file() else _read_folder(require_folder(path))


def _read_file(path: Path) -> Capture:
    suffix = path.suffix.lower()
    for suffixes, what in PROJECTS.items():
        if suffix in suffixes:
            raise InputError(f"{path} is {what}")
    exported = {".xml": read_metashape, ".csv": read_realitycapture, ".sfm": read_meshroom, ".out": read_bundler}.get(suffix)
    exported = read_opensfm if path.name == OPENSFM else exported
    if exported is not None:
        return exported(path)
    if suffix == ".json":
        return read_blender(path.parent) if path.name.startswith("transforms_") else read_transforms(path)
    if suffix in IMAGES:
        raise InputError(f"{path} is one image, and one cannot show depth; give the folder that holds all of them")
    if suffix in ARCHIVES:  # only Record3D's recordings are read from a zip file, since the app itself writes it so
        if suffix != RECORD3D and not holds_record3d(path):
            raise InputError(f"{path} is a zip file; unpack it, and give the folder that comes of it")
        return read_record3d(path)
    return read_sens(path) if is_sens(path) else read_video(path)


def _best_of(folder: Path, first: str) -> Capture:
    """The best of the captures of posed images in a folder, of which `first` is the first in order; the others are named in a warning."""
    start = [kind for kind, _, _ in READERS].index(first)
    rest = [(kind, read) for kind, looks_like, read in READERS[start + 1 :] if kind in POSED_IMAGES and looks_like(folder)]
    if not rest:
        return READERS[start][2](folder)
    captures: dict[str, Capture] = {}
    errors: dict[str, InputError] = {}
    for kind, read in ((first, READERS[start][2]), *rest):
        try:
            captures[kind] = read(folder)
        except InputError as error:
            errors[kind] = error
    if not captures:
        raise errors[first]
    most = max(len(capture.frames) for capture in captures.values())
    best = next(kind for kind, capture in captures.items() if len(capture.frames) >= FEWER * most)
    others = [f"{kind} ({counted(len(one.frames), 'image')})" for kind, one in captures.items() if kind != best]
    remarks = [f"the folder also holds poses of {', '.join(others)}; those of {best} are used"] if others else []
    remarks += [f"the poses of {kind} in the folder cannot be used: {error}" for kind, error in errors.items()]
    return captures[best].with_frames(captures[best].frames, *remarks)


def _read_folder(folder: Path) -> Capture:
    try:
        for kind, looks_like, read in READERS:
            if looks_like(folder):
                if kind in POSED_IMAGES:
                    return _best_of(folder, kind)
                if kind == "photos":
                    return _posed_below(folder) or _photos_of(folder)
                return read(folder)
        videos = images_in(folder, FILMS)
    except OSError as error:
        raise InputError(f"cannot read {error.filename or folder}: {error.strerror or error}") from error
    if len(videos) == 1:
        video = read_source(videos[0])
        cover = [f"the video {videos[0].name} is used; the one image beside it, {one.name}, is left out" for one in photo_files(folder)[:1]]
        return video.with_frames(video.frames, *cover)
    if videos:
        raise InputError(f"{folder} holds {len(videos)} videos; give one of them, for instance {videos[0]}")
    below = _read_below(folder)
    if below is not None:
        return below
    if alembic := scenes_of(folder, ".abc"):
        raise InputError(f"{alembic[0]} {ALEMBIC}")
    held = ", ".join(sorted(child.name for child in folder.iterdir())[:4])
    raise InputError(
        f"{folder} holds no capture of a known kind (it holds {held}); "
        "give a video, a folder of photos, a phone's recording (.r3d, …), or a posed capture as the README lists"
    )
