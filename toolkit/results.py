"""What the API's functions give: a scene, and what is made from it. Everything is in the source's frame unless it says otherwise."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
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
    from fieldfuse.render.splats import Splats as Gaussians
    from fieldfuse.tsdf.volume import TsdfVolume

Listener = Progress | Callable[[str, float, float, str], "bool | None"] | bool | None
OF_FIT = ("field", "fit", "network", "keyframes", "engine", "device", "threads", "seed")  # settings that a scene does not depend on
OF_SURFACE = ("tsdf", "export")


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


class Renderable(ABC):
    """What cameras see: a field or a surface, with the transform to the source's frame."""

    working_from_input: Similarity
    exposure: float

    @abstractmethod
    def working(self, intrinsics: Intrinsics, world_from_camera: Array) -> Any:
        """What a camera of the working frame sees: `rgb`, `depth`, `opacity`."""

    @overload
    def render(self, camera: Camera) -> Render: ...
    @overload
    def render(self, camera: Iterable[Camera]) -> list[Render]: ...
    def render(self, camera: Camera | Iterable[Camera]) -> Render | list[Render]:
        """What one or several cameras see.

        Raises:
            InputError: a camera with a distorting lens.
        """
        if not isinstance(camera, Camera):
            return [self.render(one) for one in camera]
        if camera.intrinsics.distorted:
            raise InputError("a render is a pinhole camera's; use camera.intrinsics.pinhole()")
        made = self.working(camera.intrinsics, self.working_from_input.poses(camera.world_from_camera))
        rgb = np.asarray(made.rgb)
        rgb = rgb if rgb.dtype == np.uint8 else np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
        depth = (np.asarray(made.depth) / self.working_from_input.scale).astype(np.float32)
        return Render(exposed(rgb, self.exposure), depth, np.asarray(made.opacity, dtype=np.float32))


@dataclass(frozen=True)
class Surface(Renderable):
    """A fused surface (a truncated signed distance field in Open3D's hash map), with the transform to the source's frame."""

    volume: TsdfVolume
    working_from_input: Similarity
    exposure: float = 1.0  # how much brighter than the volume's colours the images were taken
    smooth: int = 2  # rounds in which the mesh's vertices go to the mean of their neighbours

    @property
    def mesh(self) -> Mesh:
        from fieldfuse.export.surface import whole_mesh

        made = whole_mesh(self.volume, self.smooth).transformed(self.working_from_input.inverse())
        return Mesh(made.vertices, made.triangles, exposed(made.colours, self.exposure), made.normals)

    @property
    def points(self) -> Points:
        back, found = self.working_from_input.inverse(), self.volume.points()
        return Points(back.points(found.points), exposed(found.colours, self.exposure), back.directions(found.normals))

    def working(self, intrinsics: Intrinsics, world_from_camera: Array) -> Any:
        """The same in the working frame: `rgb`, `depth`, `opacity`, and `mask` (H, W) where there is surface."""
        return self.volume.render(intrinsics, world_from_camera)


@dataclass(frozen=True)
class Field(Renderable):
    """A radiance field on sparse voxel blocks, with the transform to the source's frame.

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

    def working(self, intrinsics: Intrinsics, world_from_camera: Array) -> Any:
        """The same in the working frame: `rgb` (H, W, 3) float32 in [0, 1], `depth`, `opacity`."""
        from fieldfuse.render.image import render_view

        return render_view(self.sparse, intrinsics, world_from_camera, self._renderer)

    @cached_property
    def _renderer(self) -> Any:
        from fieldfuse.render.image import make_renderer

        return make_renderer(self.sparse, "auto" if self.scene is None else self.scene.settings.engine)

    def to_surface(self, progress: Listener = None, **options: Any) -> Surface:
        """The field's depth at the training cameras, polished by their images and fused; options are those of `export` (`mesh_views`,
        `mesh_size`, `smooth`).

        Raises:
            InputError: it was opened without its scene, or has no surface.
        """
        from fieldfuse.export.surface import Originals, surface_of_field

        if self.scene is None:
            raise InputError("a surface is made at the training cameras, and this field has no scene; use Field.open(path, scene)")
        scene = self.scene
        settings = changed_settings(scene.settings, {f"export.{name}": value for name, value in options.items()}, OF_SURFACE)
        originals = Originals(scene.capture, scene.corrections)
        volume = surface_of_field(self.sparse, scene.views, scene.geometry, settings, originals, listening(progress, "surface"))
        return Surface(volume, self.working_from_input, self.exposure, settings.export.smooth)

    def to_mesh(self, progress: Listener = None, **options: Any) -> Mesh:
        """The mesh of `to_surface`."""
        return self.to_surface(progress, **options).mesh

    def to_splats(self, progress: Listener = None, **options: Any) -> Splats:
        """Gaussian splats that show what the field shows, fitted to the training images; options are those of `export` (`splats`,
        `sh_degree`, `splat_seconds`).

        Raises:
            InputError: it was opened without its scene, or has another decoder than the deferred one.
            Interrupted: the listener asked to stop before the first step.
        """
        from fieldfuse.training.splats import SplatSettings, splats_of_field

        if self.scene is None:
            raise InputError("splats are fitted to the training images, and this field has no scene; use Field.open(path, scene)")
        scene = self.scene
        chosen = changed_settings(scene.settings, {f"export.{name}": value for name, value in options.items()}, OF_SURFACE)
        export, listener = chosen.export, listening(progress, "splats")
        settings = SplatSettings(export.splats, export.sh_degree, export.splat_seconds, chosen.seed)
        return Splats(splats_of_field(self.sparse, scene.views, self.working_from_input, settings, listener))

    def cropped(self, region: str = "auto") -> Field:
        """The part in a region, as the setting `export.crop` has it: "box", "hull", "auto", or "x0,y0,z0,x1,y1,z1" in the source's frame.

        Raises:
            InputError: it was opened without its scene, there is no such region, or nothing lies in it.
        """
        from fieldfuse.export.crop import cropped, region_of

        scene, views = self._trained()
        found = region_of(load_settings(flags={"export.crop": region}).export.crop, scene.geometry, views)
        part = self.sparse if found is None else cropped(self.sparse, found)
        if part.voxels == 0:
            raise InputError(f"nothing of the field lies in the region {region}; its numbers are in the frame of the source")
        return replace(self, sparse=part)

    def cleaned(self, progress: Listener = None) -> Field:
        """Without floaters: parts that are connected to nothing that two cameras see, and what no camera sees.

        Raises:
            InputError: it was opened without its scene.
        """
        from fieldfuse.export.crop import cleaned

        _, views = self._trained()
        return replace(self, sparse=cleaned(self.sparse, views.intrinsics, views.world_from_camera, listening(progress, "floaters")))

    def _trained(self) -> tuple[Scene, Views]:
        """The scene, and its training views."""
        if self.scene is None:
            raise InputError("this is decided at the training cameras, and this field has no scene; use Field.open(path, scene)")
        return self.scene, self.scene.views.subset(np.flatnonzero(~np.asarray(self.scene.views.test)))

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
        sparse = SparseField.from_file(data, Path(path)).to(steps.choose_device(device))
        return cls(sparse, data.working_from_input, float(exposure), scene)


@dataclass(frozen=True)
class Splats(Renderable):
    """Gaussian splats in the source's frame, as bright as the training images were taken: ours, or others' (`Splats.open`).

    Attributes:
        gaussians: their parameters.
        background: (3,) uint8 colour behind them.
    """

    gaussians: Gaussians
    background: tuple[int, int, int] = (0, 0, 0)
    working_from_input: Similarity = field(default_factory=Similarity.identity)
    exposure: float = 1.0

    def __len__(self) -> int:
        return len(self.gaussians)

    def working(self, intrinsics: Intrinsics, world_from_camera: Array) -> Any:
        return self.gaussians.render(intrinsics, world_from_camera, np.array(self.background) / 255)

    def save(self, path: Path | str) -> None:
        """Write `.ply` or `.spz`.

        Raises:
            InputError: another suffix.
            OutputError: the file cannot be written.
        """
        from fieldfuse.render.splat_files import save_splats

        save_splats(path, self.gaussians)

    @classmethod
    def open(cls, path: Path | str) -> Splats:
        """Splats from a `.ply` or `.spz` file, also one that another program wrote.

        Raises:
            InputError: the file holds no splats, or is damaged.
        """
        from fieldfuse.render.splat_files import open_splats

        return cls(open_splats(path))


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


def chosen_settings(options: Mapping[str, Any]) -> Settings:
    """Those of a preset, changed.

    Raises:
        InputError: there is no such setting, or its value does not fit.
    """
    given = flattened(options)
    preset = given.pop("preset", "balanced")
    return load_settings(preset, flags=given)


def flattened(options: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords, and by their full names those in `settings`."""
    return {**(options.get("settings") or {}), **{name: value for name, value in options.items() if name != "settings"}}


def changed_settings(settings: Settings, options: Mapping[str, Any], allowed: tuple[str, ...]) -> Settings:
    """The settings of a scene with some changed that the scene itself does not depend on.

    Raises:
        InputError: a setting that decides the scene, or one that is not usable.
    """
    before = settings_dict(settings)
    made = load_settings(settings.preset, flags=flattened(options), stored=before)
    after = settings_dict(made)
    fixed = sorted(name for name in after if after[name] != before[name] and name not in allowed)
    if fixed:
        raise InputError(f"the settings {', '.join(fixed)} decide the scene; give them to load()")
    made.device = steps.choose_device(made.device, made.engine)
    return made


def listening(progress: Listener, stage: str) -> Progress:
    if isinstance(progress, Progress):
        return progress
    if progress is None or progress is False:
        return SILENT
    return Bar(stage) if progress is True else Callback(progress, stage)
