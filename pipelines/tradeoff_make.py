"""Fields and surfaces made from a run's prepared views, with what they cost: the work behind one point of a sweep."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.config import Settings, TsdfSettings
from fieldfuse.errors import InputError
from fieldfuse.files import read_json
from fieldfuse.pipelines.rendered import Picture, to_picture
from fieldfuse.pipelines.stages import PeakMemory, own_bytes

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.render.image import Rendered
    from fieldfuse.tsdf.volume import TsdfVolume

Show = Callable[[Intrinsics, Array], Picture]
SMALL_PART = 0.002  # components of a mesh with less than this share of its area are specks


@dataclass
class Ground:
    """What a point stands on.

    Attributes:
        views: all views. chosen: those that this point may use, test views among them.
        used: indices of its training views. resident: bytes of the process, but for pages of files, before the views were loaded.
        test_depths: exact depth of the test views, where the capture brings it.
    """

    folder: Path
    settings: Settings
    posed: Capture
    scene: Scene
    views: Views
    chosen: Views
    used: Array
    test_depths: list[Array | None] | None
    resident: int


def open_ground(folder: Path, settings: Settings, share: float) -> Ground:
    """Load what a run's folder holds; libraries and kernels first, so that memory is that of the work.

    Raises:
        InputError: a stage's file is missing or damaged.
    """
    from fieldfuse.capture.storage import capture_from_dict, load_views
    from fieldfuse.evaluation.compare_truth import find_truth, true_depths
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene
    from fieldfuse.progress import SILENT
    from fieldfuse.training.engine import warm_up

    warm_up(settings, SILENT)
    resident = own_bytes(psutil.Process().memory_info())
    chosen_frames = folder / "frames" / "capture.json"
    capture = capture_from_dict(read_json(chosen_frames if chosen_frames.is_file() else folder / "capture.json"))
    poses = PoseResult.from_dict(read_json(folder / "poses.json"))
    posed, scene, views = poses.apply(capture), Scene.from_dict(read_json(folder / "scene.json")), load_views(folder / "views.safetensors")
    test = np.flatnonzero(views.test)
    truth = find_truth(posed) if poses.source == "given" else None
    depths = None if truth is None or not truth.depths else true_depths(truth, posed, views, test, scene.working_from_input.scale)
    training = np.flatnonzero(~views.test)
    used = training[spread(len(training), share)]
    chosen = views if share == 1 else views.subset(np.sort(np.concatenate([used, test])))
    return Ground(folder, settings, posed, scene, views, chosen, used, depths, resident)


def spread(count: int, share: float) -> Array:
    """Indices of about `share` of `count` things, evenly spread, at least two."""
    return np.unique(np.linspace(0, count - 1, max(min(2, count), round(share * count))).round().astype(int))


class Cost:
    """Memory of a piece of work, and the seconds of its parts."""

    def __init__(self, ground: Ground) -> None:
        self.ground, self.stages = ground, dict[str, float]()
        self._memory = PeakMemory()

    def __enter__(self) -> Cost:
        self._memory.__enter__()
        self._since = time.monotonic()
        return self

    def __exit__(self, *error: Any) -> None:
        self._memory.__exit__(*error)

    def lap(self, name: str) -> None:
        """What was done since the last lap is the stage `name`."""
        now = time.monotonic()
        self.stages[name], self._since = self.stages.get(name, 0.0) + now - self._since, now

    def facts(self) -> dict[str, Any]:
        own = max(0.0, self._memory.own - self.ground.resident / 2**20)
        return {"stages": self.stages, "peak_memory_mb": round(self._memory.megabytes, 1), "memory_mb": round(own, 1)}


def make_field(ground: Ground, spec: dict[str, Any], scratch: Path) -> list[dict[str, Any]]:
    """Fit a field, then show it as it is kept (16-bit features) and in each of the variants."""
    from fieldfuse.render.field import Field
    from fieldfuse.training.fit import Begin
    from fieldfuse.training.guided import fit_guided
    from fieldfuse.volume.grid import host_for

    settings, wanted = ground.settings, spec["wanted"]
    settings.fit = replace(settings.fit, budget=float(wanted["iterations"]), patience=False)
    asked, voxel = asked_resolution(ground, float(wanted["voxel_size"]))
    settings.field = replace(
        settings.field, decoder=wanted["decoder"], resolution=asked if wanted["voxel_size"] != 1 else settings.field.resolution
    )
    path = scratch / "field.safetensors"
    with Cost(ground) as cost:
        result = fit_guided(ground.chosen, ground.scene, settings, begin=Begin(host_for(settings.device)))
        cost.lap("fit")
        result.field.save(path, ground.scene.working_from_input)
        cost.lap("save")
    field = Field.load(path).to(settings.device)
    setting = {
        "iterations": wanted["iterations"],
        "voxel_size": voxel,
        "views": len(ground.used),
        "samples": field.fine,
        "decoder": wanted["decoder"],
        "precision": "float16",
        "resolution": field.resolution,
        "steps": result.steps,
        "rays": result.rays,
        "voxels": field.voxels,
    }
    first = {"setting": setting, **cost.facts(), "disk_bytes": path.stat().st_size, "show": shown_field(field, settings.engine)}
    out = [first]
    for variant in spec.get("variants") or []:
        changed = {key: value for key, value in variant.items() if key != "axis"}
        show, size = vary(ground, result.field, field, path, changed, scratch)
        facts = {"setting": {**setting, **changed}, "disk_bytes": size, "show": show, "changed": changed, "variant": variant["axis"]}
        out.append({**first, **facts})
    return out


def asked_resolution(ground: Ground, factor: float) -> tuple[int, float]:
    """Voxels a side for voxels `factor` times as large as the automatic ones, and their size in the input's unit."""
    from fieldfuse.training.start import MARGIN, ROOM_MARGIN, finest_resolution, make_space

    scene, views, settings = ground.scene, ground.views, ground.settings.field
    background = scene.has_background if settings.background == "auto" else settings.background == "on"
    space = make_space(scene, background and views.background is None, MARGIN if views.background is not None else ROOM_MARGIN)
    base = settings.resolution or finest_resolution(space, views.subset(np.flatnonzero(~views.test)), scene)
    asked = base if factor == 1 else max(32, round(base / factor / 32) * 32)
    return asked, 2 * space.extent / asked * space.half / scene.working_from_input.scale


def shown_field(field: Field, engine: str) -> Show:
    from fieldfuse.render.image import make_renderer, render_view

    view = make_renderer(field, engine)
    return lambda lens, pose: to_picture(render_view(field, lens, pose, view))


def vary(ground: Ground, fitted: Field, kept: Field, path: Path, changed: dict[str, Any], scratch: Path) -> tuple[Show, int]:
    """The same fit with other samples along a ray, or stored with another precision; and its size on disk.

    Raises:
        InputError: the field cannot be stored so.
    """
    if "samples" in changed:
        return shown_field(replace(kept, fine=int(changed["samples"])), ground.settings.engine), path.stat().st_size
    if changed["precision"] == "float32":
        from fieldfuse.volume.store import read_field, write_field

        write_field(scratch / "float32.safetensors", read_field(path), precision="float32")
        return shown_field(fitted, ground.settings.engine), (scratch / "float32.safetensors").stat().st_size
    from fieldfuse.render.bake import bake
    from fieldfuse.render.bake_file import read_baked, write_baked
    from fieldfuse.render.bake_image import BakedRenderer

    place = scratch / "baked.safetensors"
    write_baked(place, bake(kept.to("cpu")), ground.scene.working_from_input)
    renderer = BakedRenderer(read_baked(place))
    lens = ground.views.intrinsics[0]
    renderer.render(lens.scaled(2, 2), ground.views.world_from_camera[0])  # its kernels are compiled at the first picture

    def show(lens: Intrinsics, pose: Array) -> Picture:
        rendered: Rendered = renderer.render(lens, pose)
        return to_picture(rendered)

    return show, place.stat().st_size


def make_direct(ground: Ground, spec: dict[str, Any], scratch: Path) -> list[dict[str, Any]]:
    """The networks' field of some of the key frames, or with other voxels, not fitted."""
    from fieldfuse.pipelines.direct_field import direct_field
    from fieldfuse.progress import SILENT
    from fieldfuse.render.field import Field

    settings, share = ground.settings, float(spec["wanted"]["keyframes"])
    path = scratch / "field.safetensors"
    with Cost(ground) as cost:
        made = direct_field(settings, ground.chosen, ground.scene, SILENT, share, float(spec["wanted"]["voxel_size"]))
        cost.lap("fuse")
        made.field.save(path, ground.scene.working_from_input)
        cost.lap("save")
    field = Field.load(path).to(settings.device)
    setting = {
        "keyframes": made.key_frames,
        "voxel_size": made.voxel_size / ground.scene.working_from_input.scale,
        "views": len(ground.used),
        "resolution": field.resolution,
        "voxels": field.voxels,
    }
    return [{"setting": setting, **cost.facts(), "disk_bytes": path.stat().st_size, "show": shown_field(field, settings.engine)}]


def make_surface(ground: Ground, spec: dict[str, Any], scratch: Path) -> list[dict[str, Any]]:
    """Fuse depth into a surface: the sensor's, or what matching found for the run."""
    from fieldfuse.export.mesh import write_mesh

    wanted = spec["wanted"]
    voxel = ground.settings.tsdf.voxel_size if spec.get("base_voxel") is None else spec["base_voxel"] * wanted["voxel_size"]
    settings = TsdfSettings(voxel_size=voxel, depth_max=ground.settings.tsdf.depth_max)
    path = scratch / "mesh.ply"
    with Cost(ground) as cost:
        volume = fuse(ground, spec["method"], settings)
        cost.lap("fuse")
        mesh = volume.mesh().cleaned(min_area_share=SMALL_PART)
        write_mesh(path, mesh)
        cost.lap("mesh")
    if spec["method"] == "tsdf_stereo":
        cost.stages["stereo"] = float(spec["stereo_seconds"])
    setting = {
        "voxel_size": volume.voxel_size / ground.scene.working_from_input.scale,
        "views": len(ground.used),
        "working_voxel": volume.voxel_size,
        "blocks": volume.blocks,
        "triangles": len(mesh.triangles),
    }
    lens = ground.views.intrinsics[0]
    volume.render(lens.scaled(2, 2), ground.views.world_from_camera[0])  # what rays are cast at is made once, at the first picture

    def show(lens: Intrinsics, pose: Array) -> Picture:
        return to_picture(volume.render(lens, pose))

    return [{"setting": setting, **cost.facts(), "disk_bytes": path.stat().st_size, "show": show}]


def fuse(ground: Ground, method: str, settings: TsdfSettings) -> TsdfVolume:
    """The training views' depth in one volume.

    Raises:
        InputError: no depth, or a voxel size too fine for the memory.
    """
    if method == "tsdf":
        from fieldfuse.tsdf.fuse import fuse_capture

        with_depth = [int(index) for index in ground.used if ground.posed.frames[int(index)].depth is not None]
        return fuse_capture(ground.posed, ground.scene.working_from_input, with_depth, settings, tones=ground.views.toned())
    from fieldfuse.stereo.maps import load_stereo
    from fieldfuse.tsdf.fuse import fuse_stereo

    names, depths = load_stereo(ground.folder / "stereo" / "depths.safetensors")
    training = ground.views.subset(np.flatnonzero(~ground.views.test))
    if names != training.names:
        raise InputError(f"the depth by matching in {ground.folder} is of other pictures; run the command again")
    return fuse_stereo(training, depths, settings.voxel_size, settings.depth_max)
