"""Fieldfuse from Python: what `import fieldfuse` offers.

    import fieldfuse as ff

    scene = ff.load("fox/")                         # images, poses, corrections
    field = ff.fit(scene, budget=30)                # a radiance field, 30 seconds of fitting
    image = field.render(scene.test.cameras[0])     # .rgb .depth .opacity as NumPy
    scores = ff.evaluate(field, scene)              # at the held-out views
    field.to_mesh().save("mesh.glb")

Cameras, depth, meshes and points are in the source's own frame and unit of length, with OpenCV's axes (x right, y down, z forward). Nothing
here prints, or changes the threads or random generators of the caller; remarks go to the logger "fieldfuse". Functions take settings by the
names that `--set` has: the short ones as keywords (`image_size=320`), all of them in `settings={"field.channels": 8}`.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from fieldfuse import steps
from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.config import Settings, load_settings, settings_dict
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Bar, Callback, Progress
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene as Geometry
    from fieldfuse.render.field import Field as SparseField
    from fieldfuse.tsdf.volume import TsdfVolume

log = logging.getLogger("fieldfuse")
Listener = Progress | Callable[[str, float, float, str], "bool | None"] | bool | None
OF_FIT = ("field", "fit", "network", "keyframes", "engine", "device", "threads", "seed")  # settings that a scene does not depend on
OF_TSDF = ("tsdf", "export")


# ---------------------------------------------------------------------------------------------------- cameras and images


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the source's frame.

    Attributes:
        world_from_camera: (4, 4) float64, OpenCV's axes.
    """

    intrinsics: Intrinsics
    world_from_camera: Array

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for images of another size."""
        return replace(self, intrinsics=self.intrinsics.scaled(width, height))


@dataclass(frozen=True)
class Render:
    """What a camera sees of a field or surface.

    Attributes:
        rgb: (H, W, 3) uint8, as bright as the training images were taken.
        depth: (H, W) float32 along z, the source's unit of length; 0: none.
        opacity: (H, W) float32, share of the light that is stopped.
    """

    rgb: Array
    depth: Array
    opacity: Array


@dataclass(frozen=True)
class Split:
    """The training or the test views of a scene.

    Attributes:
        images: (H, W, 3) uint8 each, undistorted and resized: those of test views in the colours in which they were taken, those of
            training views with what was corrected taken out.
    """

    names: list[str]
    cameras: list[Camera]
    images: list[Array]

    def __len__(self) -> int:
        return len(self.names)


@dataclass
class Scene:
    """A source made ready: its images with poses and corrections, in memory.

    Attributes:
        capture: the source's frames that take part, with poses and lenses as they are used.
        poses: where these came from, and how sure they are.
        views: what fits and measures: images, pinhole cameras and masks in the working frame.
        geometry: the working frame, and the region of interest in it.
        corrections: of camera and light.
        effects: evidence and decision for each effect; empty where none was looked for.
        settings: everything that was chosen.
    """

    capture: Capture
    poses: PoseResult
    views: Views
    geometry: Geometry
    corrections: Corrections
    effects: list[dict[str, Any]]
    settings: Settings
    _files: tempfile.TemporaryDirectory[str] | None = field(default=None, repr=False)  # images of a video, as long as the scene lives

    @property
    def train(self) -> Split:
        return self._split(False)

    @property
    def test(self) -> Split:
        """Held-out views: no fit looks at them."""
        return self._split(True)

    @property
    def working_from_input(self) -> Similarity:
        return self.geometry.working_from_input

    @property
    def warnings(self) -> list[str]:
        """What a user has to be aware of, a sentence each."""
        return list(dict.fromkeys([*self.capture.warnings, *self.poses.warnings, *self.geometry.warnings]))

    def _split(self, test: bool) -> Split:
        views, back = self.views, self.working_from_input.inverse()
        indices = [int(index) for index in np.flatnonzero(np.asarray(views.test) == test)]
        cameras = [Camera(views.intrinsics[index], back.poses(views.world_from_camera[index])) for index in indices]
        return Split([views.names[index] for index in indices], cameras, [views.photo(index) for index in indices])


# ---------------------------------------------------------------------------------------------------- results


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the source's frame.

    Attributes:
        vertices: (V, 3) float64.
        triangles: (T, 3) int32.
        colours: (V, 3) uint8 sRGB.
        normals: (V, 3) float64, or None.
    """

    vertices: Array
    triangles: Array
    colours: Array
    normals: Array | None = None

    def save(self, path: Path | str) -> None:
        """Write .ply, .obj or .glb, as the suffix says.

        Raises:
            InputError: another suffix.
            OutputError: the file cannot be written.
        """
        from fieldfuse.export.mesh import write_mesh
        from fieldfuse.tsdf.mesh import Mesh as Triangles

        write_mesh(path, Triangles(self.vertices, self.triangles, self.colours, self.normals))


@dataclass(frozen=True)
class Points:
    """Coloured surface points (P, 3) in the source's frame, with colours (P, 3) uint8 and unit normals (P, 3)."""

    points: Array
    colours: Array
    normals: Array

    def save(self, path: Path | str) -> None:
        """Write .ply.

        Raises:
            InputError: another suffix.
            OutputError: the file cannot be written.
        """
        from fieldfuse.export.ply import write_points

        write_points(path, self.points, self.colours, self.normals)


@dataclass(frozen=True)
class Surface:
    """A fused surface (a truncated signed distance field in Open3D's hash map), with the way back to the source's frame."""

    volume: TsdfVolume
    working_from_input: Similarity
    exposure: float = 1.0  # how much brighter than the volume's colours the images were taken
    smooth: int = 2  # rounds in which the mesh's vertices go to the mean of their neighbours

    @property
    def mesh(self) -> Mesh:
        from fieldfuse.export.field_surface import whole_mesh

        made = whole_mesh(self.volume, self.smooth).transformed(self.working_from_input.inverse())
        return Mesh(made.vertices, made.triangles, exposed(made.colours, self.exposure), made.normals)

    @property
    def points(self) -> Points:
        back, found = self.working_from_input.inverse(), self.volume.points()
        return Points(back.points(found.points), exposed(found.colours, self.exposure), back.directions(found.normals))

    @overload
    def render(self, camera: Camera) -> Render: ...
    @overload
    def render(self, camera: Iterable[Camera]) -> list[Render]: ...
    def render(self, camera: Camera | Iterable[Camera]) -> Render | list[Render]:
        """What one or several cameras see."""
        return _render(self, camera)

    def working(self, intrinsics: Intrinsics, world_from_camera: Array) -> Any:
        """The same in the working frame: `rgb`, `depth`, `opacity`, and `mask` (H, W) where there is surface."""
        return self.volume.render(intrinsics, world_from_camera)


@dataclass(frozen=True)
class Field:
    """A radiance field on sparse voxel blocks, with the way back to the source's frame.

    Attributes:
        sparse: blocks, features and decoder, in the working frame.
        exposure: how much brighter than the field's colours the training images were taken.
        scene: what it was made from; None for a field that was opened from a file without its scene.
        timeline: seconds and validation PSNR while it was fitted.
        notes: what a reader of its scores has to be aware of.
    """

    sparse: SparseField
    working_from_input: Similarity
    exposure: float = 1.0
    scene: Scene | None = None
    timeline: Sequence[Mapping[str, Any]] = ()
    notes: Sequence[str] = ()
    _renderers: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @overload
    def render(self, camera: Camera) -> Render: ...
    @overload
    def render(self, camera: Iterable[Camera]) -> list[Render]: ...
    def render(self, camera: Camera | Iterable[Camera]) -> Render | list[Render]:
        """What one or several cameras see."""
        return _render(self, camera)

    def working(self, intrinsics: Intrinsics, world_from_camera: Array) -> Any:
        """The same in the working frame: `rgb` (H, W, 3) float32 in [0, 1], `depth`, `opacity`."""
        from fieldfuse.render.image import make_renderer, render_view

        engine = "auto" if self.scene is None else self.scene.settings.engine
        view = self._renderers.setdefault(engine, None) or make_renderer(self.sparse, engine)
        self._renderers[engine] = view
        return render_view(self.sparse, intrinsics, world_from_camera, view)

    def to_surface(self, progress: Listener = None, **options: Any) -> Surface:
        """The field's depth at the training cameras, polished by their images and fused; options are those of `export` (`mesh_views`,
        `mesh_size`, `smooth`).

        Raises:
            InputError: it was opened without its scene, or has no surface.
        """
        from fieldfuse.export.field_surface import Originals, surface_of_field

        if self.scene is None:
            raise InputError("a surface is made at the training cameras, and this field has no scene; use Field.open(path, scene)")
        scene = self.scene
        settings = _changed(scene.settings, {f"export.{name}": value for name, value in options.items()}, OF_TSDF)
        originals = Originals(scene.capture, scene.corrections)
        volume = surface_of_field(self.sparse, scene.views, scene.geometry, settings, originals, _listening(progress, "surface"))
        return Surface(volume, self.working_from_input, self.exposure, settings.export.smooth)

    def to_mesh(self, progress: Listener = None, **options: Any) -> Mesh:
        """The mesh of `to_surface`."""
        return self.to_surface(progress, **options).mesh

    def save(self, path: Path | str) -> None:
        """Write the field (`.safetensors`).

        Raises:
            OutputError: the file cannot be written.
        """
        self.sparse.save(path, self.working_from_input, {"exposure": self.exposure})

    @classmethod
    def open(cls, path: Path | str, scene: Scene | None = None, device: str = "auto") -> Field:
        """A field from its file; with its scene it can be meshed.

        Raises:
            InputError: the file is not a field, or damaged.
        """
        from fieldfuse.render.field import Field as SparseField
        from fieldfuse.volume.store import read_field

        data = read_field(path)
        exposure = data.meta.get("exposure", 1.0 if scene is None else scene.views.exposure)
        if not isinstance(exposure, int | float) or not 0 < exposure < np.inf:
            raise InputError(f"{path} is damaged (its exposure is {exposure!s:.40}); fit it again")
        sparse = SparseField.from_file(data, str(path)).to(steps.choose_device(device))
        return cls(sparse, data.working_from_input, float(exposure), scene)


@dataclass(frozen=True)
class Scores:
    """Means over the test views; None where there is nothing to measure.

    Attributes:
        psnr: decibels, in the colours in which images were taken. ssim, lpips: as published.
        depth: measures of depth against a sensor's, working units.
        nearest_image: PSNR of the nearest training image shown unchanged: the floor under `psnr`.
        per_view: the same for each view, with its name.
    """

    psnr: float | None
    ssim: float | None
    lpips: float | None
    depth: dict[str, float] | None
    nearest_image: float | None
    per_view: list[dict[str, Any]]


# ---------------------------------------------------------------------------------------------------- functions


def load(
    source: Path | str,
    *,
    workdir: Path | str | None = None,
    progress: Listener = None,
    **options: Any,
) -> Scene:
    """Read a capture, find or check its poses, estimate what camera and light did to its images, and prepare them.

    Args:
        source: a video, a folder of images, or a capture of any known layout.
        workdir: where frames of a video and structure from motion's database go; None: a temporary folder that goes with the scene.
        progress: called with stage, done, total and a remark, and asks to stop by returning False; or True for a bar on the terminal.
        options: `image_size`, `holdout`, `poses` ("auto", "given", "sfm"), `effects` ("auto", "off"), `seed`, `threads`, `preset`, …, and
            `settings` for those with full names.

    Raises:
        InputError: the source or a setting is not usable.
        PoseError: poses cannot be estimated, or those given do not fit the images.
        Interrupted: the listener asked to stop.
    """
    from fieldfuse.capture.photos import with_unposed
    from fieldfuse.capture.subset import limited
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.poses.points import Features
    from fieldfuse.poses.scene import describe_scene

    path = Path(source)
    if not path.exists():
        raise InputError(f"{path} does not exist; give a video, a folder of images, or a capture folder")
    chosen = _settings(options)
    chosen.device = steps.choose_device(chosen.device, chosen.engine)
    files = tempfile.TemporaryDirectory(prefix="fieldfuse-") if workdir is None else None
    folder = Path(files.name if files is not None else workdir or ".")

    with steps.seeded(chosen.seed):
        capture = steps.read_capture(path.absolute(), chosen, _listening(progress, "capture"))
        if chosen.poses.source == "sfm":
            capture = with_unposed(capture)
        if steps.needs_frames(capture):
            capture = steps.write_frames(capture, folder, chosen, _listening(progress, "frames"))
        features: dict[str, Features] = {}
        poses = steps.camera_poses(capture, folder, chosen, _listening(progress, "poses"), features)
        posed = limited(poses.apply(capture), chosen.capture.holdout, chosen.views.limit)
        corrections, effects = Corrections(), []
        if steps.looks_for_effects(chosen):
            found = steps.find_effects(posed, chosen, _listening(progress, "effects"))
            corrections, effects = steps.apply_effects(found, chosen), found["effects"]
        poses, posed = steps.refined(poses, corrections), corrections.on_capture(posed)
        steps.set_seeds(chosen.seed)
        geometry = describe_scene(posed, _listening(progress, "scene"), features)
        views = steps.prepared(posed, geometry, chosen, _listening(progress, "views"), corrections)
    scene = Scene(posed, poses, views, geometry, corrections, effects, chosen, files)
    for warning in scene.warnings:
        log.warning("%s: %s", path, warning)
    return scene


def fit(scene: Scene, budget: float | None = None, *, progress: Listener = None, start: Field | None = None, **options: Any) -> Field:
    """Fit a field to the training views.

    Args:
        budget: seconds; None: as the preset has it.
        progress: as in `load`; asked to stop, the field as far as it came is returned.
        start: a field to go on from, of the same scene; None: chosen by `init` ("classical", "network", "auto").
        options: settings of the field and the fit (`init`, `decoder`, `engine`, `seed`, …).

    Raises:
        InputError: a setting is not usable, or there are no training views.
    """
    from fieldfuse.training.guided import fit_guided
    from fieldfuse.training.network_start import network_start
    from fieldfuse.volume.grid_host import host_for

    settings = _changed(scene.settings, {**options, **({} if budget is None else {"budget": budget})}, OF_FIT)
    with steps.seeded(settings.seed):
        first = None if start is None else start.sparse
        if first is None and steps.starts_from_networks(scene.views, settings):
            made = _inferred(scene, settings, progress).field()
            first = network_start(made, scene.views, scene.geometry, settings)
        result = fit_guided(
            scene.views,
            scene.geometry,
            settings,
            _listening(progress, "fit"),
            host=host_for(settings.device),
            start=first,
            coarse=first is not None and start is None,
        )
    for note in result.notes:
        log.warning("%s", note)
    exposure = scene.views.exposure
    return Field(result.field, scene.working_from_input, exposure, scene, tuple(result.timeline), tuple(result.notes))


def infer(scene: Scene, *, progress: Listener = None, **options: Any) -> Field:
    """The field that trained networks give without any fitting: key frames fused one after the other.

    Raises:
        InputError: there are no training views, or no trained networks.
        Interrupted: the listener asked to stop.
    """
    settings = _changed(scene.settings, options, OF_FIT)
    with steps.seeded(settings.seed):
        made = _inferred(scene, settings, progress).result(_listening(progress, "colours"), settings.engine)
    return Field(made, scene.working_from_input, scene.views.exposure, scene)


def fuse_tsdf(scene: Scene, *, depth_from: str = "auto", progress: Listener = None, **options: Any) -> Surface:
    """Fuse the training frames' depth into a surface.

    Args:
        depth_from: "sensor", "matching" (depth by matching the images with each other), or "auto": the sensor's where there is one.
        options: `voxel_size` and `depth_max` in working units.

    Raises:
        InputError: there is no depth, or the voxels are too fine for the memory.
        Interrupted: the listener asked to stop.
    """
    from fieldfuse.stereo.bare import continued
    from fieldfuse.stereo.match import stereo_depths
    from fieldfuse.tsdf.fuse import fuse_capture
    from fieldfuse.tsdf.stereo_frames import fuse_stereo

    if depth_from not in ("auto", "sensor", "matching"):
        raise InputError(f"depth_from is {depth_from!r}; it must be auto, sensor or matching")
    settings = _changed(scene.settings, {f"tsdf.{name}": value for name, value in options.items()}, OF_TSDF)
    views, geometry, listener = scene.views, scene.geometry, _listening(progress, "tsdf")
    train = np.flatnonzero(~np.asarray(views.test))
    if depth_from == "sensor" or (depth_from == "auto" and scene.capture.has_depth):
        measured = [int(index) for index in train if scene.capture.frames[index].depth is not None]
        volume = fuse_capture(scene.capture, scene.working_from_input, measured, settings.tsdf, listener, views.toned())
    else:
        shown = views.subset(train)
        found = stereo_depths(shown, geometry.near, geometry.far, geometry.median_depth, progress=listener)
        found = continued(found, shown, geometry.median_depth, listener)
        volume = fuse_stereo(shown, found, settings.tsdf.voxel_size, settings.tsdf.depth_max, progress=listener)
    return Surface(volume, scene.working_from_input, views.exposure, settings.export.smooth)


def evaluate(result: Field | Surface, scene: Scene, *, progress: Listener = None) -> Scores:
    """Scores of a field or surface at the scene's test views.

    Raises:
        Interrupted: the listener asked to stop.
    """
    from fieldfuse.evaluation.baseline import nearest_image_scores
    from fieldfuse.evaluation.score import score_views

    listener, views, indices = _listening(progress, "evaluate"), scene.views, np.flatnonzero(scene.views.test)
    onto = result.working_from_input.after(scene.working_from_input.inverse())  # the same, unless it was made from another scene

    def shown() -> Iterator[Any]:
        for count, index in enumerate(indices):
            listener.check()
            listener.update(count, len(indices), views.names[index])
            made = result.working(views.intrinsics[index], onto.poses(views.world_from_camera[index]))
            yield made if onto.scale == 1 else replace(made, depth=made.depth / onto.scale)

    scores = score_views(shown(), views, indices)
    floor = nearest_image_scores(views, indices)["psnr"]
    return Scores(scores["psnr"], scores["ssim"], scores["lpips"], scores["depth"], floor, scores["per_view"])


# ---------------------------------------------------------------------------------------------------- inside


def _render(result: Field | Surface, camera: Camera | Iterable[Camera]) -> Render | list[Render]:
    if not isinstance(camera, Camera):
        return [_seen(result, one) for one in camera]
    return _seen(result, camera)


def _seen(result: Field | Surface, camera: Camera) -> Render:
    way = result.working_from_input
    if camera.intrinsics.distorted:
        raise InputError("a render is a pinhole camera's; use camera.intrinsics.pinhole()")
    made = result.working(camera.intrinsics, way.poses(camera.world_from_camera))
    rgb = np.asarray(made.rgb)
    rgb = rgb if rgb.dtype == np.uint8 else np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    depth = (np.asarray(made.depth) / way.scale).astype(np.float32)
    return Render(exposed(rgb, result.exposure), depth, np.asarray(made.opacity, dtype=np.float32))


def _inferred(scene: Scene, settings: Settings, progress: Listener) -> Any:
    """The networks with all key frames fused."""
    keys = steps.key_frames(scene.views, scene.geometry, settings)
    inference = steps.direct_inference(scene.views, scene.geometry, keys, settings)
    for _ in inference.frames(_listening(progress, "networks")):
        pass
    return inference


def _settings(options: Mapping[str, Any]) -> Settings:
    """Those of a preset, changed.

    Raises:
        InputError: there is no such setting, or its value does not fit.
    """
    given = _flat(options)
    preset = given.pop("preset", "balanced")
    return load_settings(preset, flags=given)


def _flat(options: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords, and by their full names those in `settings`."""
    return {**(options.get("settings") or {}), **{name: value for name, value in options.items() if name != "settings"}}


def _changed(settings: Settings, options: Mapping[str, Any], allowed: tuple[str, ...]) -> Settings:
    """The settings of a scene with some changed that the scene itself does not depend on.

    Raises:
        InputError: a setting that decides the scene, or one that is not usable.
    """
    before = settings_dict(settings)
    made = load_settings(settings.preset, flags=_flat(options), stored=before)
    after = settings_dict(made)
    fixed = sorted(name for name in after if after[name] != before[name] and name not in allowed)
    if fixed:
        raise InputError(f"the settings {', '.join(fixed)} decide the scene; give them to load()")
    made.device = steps.choose_device(made.device, made.engine)
    return made


def _listening(progress: Listener, stage: str) -> Progress:
    if isinstance(progress, Progress):
        return progress
    if progress is None or progress is False:
        return SILENT
    return Bar(stage) if progress is True else Callback(progress, stage)
