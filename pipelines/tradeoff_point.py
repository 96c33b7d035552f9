"""The process that makes and measures one point of a sweep: `python -m fieldfuse.pipelines.tradeoff_point JOB.json`.

A process of its own, so that its peak memory is its own, and so that running out of memory ends this point and not the sweep.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.config import Settings, TsdfSettings
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.rendered import Picture, to_picture
from fieldfuse.pipelines.stages import PeakMemory, own_bytes

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.tsdf.volume import TsdfVolume

Show = Callable[[Intrinsics, Array], Picture]
SCORES = ("psnr", "ssim", "lpips", "coverage", "psnr_masked", "acc_1", "acc_5")


@dataclass
class Ground:
    """What a point is made of.

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


@dataclass
class Made:
    """A result, what it cost, and how it shows a view; a variant of one has what was `changed`, and its axis."""

    setting: dict[str, Any]
    cost: dict[str, Any]  # `stages`, name → seconds, and memory
    disk_bytes: int
    show: Show
    changed: dict[str, Any] = field(default_factory=dict)
    variant: str | None = None


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
    test, training = np.flatnonzero(views.test), np.flatnonzero(~views.test)
    truth = find_truth(posed) if poses.source == "given" else None
    depths = None if truth is None or not truth.depths else true_depths(truth, posed, views, test, scene.working_from_input.scale)
    count = max(min(2, len(training)), round(len(training) * share))
    used = training[np.unique(np.linspace(0, len(training) - 1, count).round().astype(int))]
    chosen = views if share == 1 else views.subset(np.sort(np.concatenate([used, test])))
    return Ground(folder, settings, posed, scene, views, chosen, used, depths, resident)


def make_field(ground: Ground, spec: dict[str, Any], scratch: Path) -> list[Made]:
    """Fit a field, then show it as it is kept (16-bit features) and in each of the variants."""
    from fieldfuse.render.field import Field
    from fieldfuse.training.fit import Begin
    from fieldfuse.training.guided import fit_guided
    from fieldfuse.volume.grid import host_for

    settings, wanted = ground.settings, spec["wanted"]
    settings.fit = replace(settings.fit, budget=float(wanted["iterations"]), patience=False)
    wished, voxel = wanted_resolution(ground, float(wanted["voxel_size"]))
    resolution = wished if wanted["voxel_size"] != 1 else settings.field.resolution
    settings.field = replace(settings.field, decoder=wanted["decoder"], resolution=resolution)
    path = scratch / "field.safetensors"
    with Cost(ground) as cost:
        result = fit_guided(ground.chosen, ground.scene, settings, begin=Begin(host_for(settings.device)))
        cost.lap("fit")
        result.field.save(path, ground.scene.working_from_input)
        cost.lap("save")
    kept = Field.load(path).to(settings.device)
    setting = {
        "iterations": wanted["iterations"],
        "voxel_size": voxel,
        "views": len(ground.used),
        "samples": kept.fine,
        "decoder": wanted["decoder"],
        "precision": "float16",
        "resolution": kept.resolution,
        "steps": result.steps,
        "rays": result.rays,
        "voxels": kept.voxels,
    }
    out = [Made(setting, cost.facts(), path.stat().st_size, shown_field(kept, settings.engine))]
    for variant in spec["variants"]:
        changed = {key: value for key, value in variant.items() if key != "axis"}
        if "samples" in changed:
            field, stored = replace(kept, fine=int(changed["samples"])), path
        elif changed["precision"] == "float32":
            from fieldfuse.volume.store import read_field, write_field

            field, stored = result.field, scratch / "float32.safetensors"
            write_field(stored, read_field(path), precision="float32")
        else:
            from fieldfuse.render.bake import bake
            from fieldfuse.render.bake_file import read_baked, write_baked

            stored = scratch / "baked.safetensors"
            write_baked(stored, bake(kept.to("cpu")), ground.scene.working_from_input)
            field = read_baked(stored).to_field()
        show = shown_field(field, settings.engine)
        out.append(Made({**setting, **changed}, out[0].cost, stored.stat().st_size, show, changed, variant["axis"]))
    return out


def wanted_resolution(ground: Ground, factor: float) -> tuple[int, float]:
    """Voxels a side for voxels `factor` times as large as the automatic ones, and their size in the input's unit."""
    from fieldfuse.training.start import MARGIN, ROOM_MARGIN, finest_resolution, make_space

    scene, views, settings = ground.scene, ground.views, ground.settings.field
    background = scene.has_background if settings.background == "auto" else settings.background == "on"
    space = make_space(scene, background and views.background is None, MARGIN if views.background is not None else ROOM_MARGIN)
    base = settings.resolution or finest_resolution(space, views.subset(np.flatnonzero(~views.test)), scene)
    wanted = base if factor == 1 else max(32, round(base / factor / 32) * 32)
    return wanted, 2 * space.extent / wanted * space.half / scene.working_from_input.scale


def shown_field(field: Field, engine: str) -> Show:
    from fieldfuse.render.image import make_renderer, render_view

    view = make_renderer(field, engine)
    return lambda lens, pose: to_picture(render_view(field, lens, pose, view))


def make_direct(ground: Ground, spec: dict[str, Any], scratch: Path) -> list[Made]:
    """The networks' field of some of the key frames, or with other voxels, not fitted."""
    from fieldfuse.pipelines.direct_field import direct_field
    from fieldfuse.progress import SILENT
    from fieldfuse.render.field import Field

    settings, wanted = ground.settings, spec["wanted"]
    path = scratch / "field.safetensors"
    with Cost(ground) as cost:
        made = direct_field(settings, ground.chosen, ground.scene, SILENT, float(wanted["keyframes"]), float(wanted["voxel_size"]))
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
    return [Made(setting, cost.facts(), path.stat().st_size, shown_field(field, settings.engine))]


def make_surface(ground: Ground, spec: dict[str, Any], scratch: Path) -> list[Made]:
    """Fuse depth into a surface: the sensor's, or what matching found for the run."""
    from fieldfuse.export.mesh import write_mesh
    from fieldfuse.export.surface import whole_mesh

    voxel = ground.settings.tsdf.voxel_size if spec["base_voxel"] is None else spec["base_voxel"] * spec["wanted"]["voxel_size"]
    path = scratch / "mesh.ply"
    with Cost(ground) as cost:
        volume = fuse(ground, spec["method"], TsdfSettings(voxel_size=voxel, depth_max=ground.settings.tsdf.depth_max))
        cost.lap("fuse")
        mesh = whole_mesh(volume, 0)
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
    volume.render(ground.views.intrinsics[0].scaled(2, 2), ground.views.world_from_camera[0])  # the first render prepares the ray casting
    return [Made(setting, cost.facts(), path.stat().st_size, lambda lens, pose: to_picture(volume.render(lens, pose)))]


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
        raise InputError(f"the depth by matching in {ground.folder} is of other images; run the command again")
    return fuse_stereo(training, depths, settings.voxel_size, settings.depth_max)


def load_average() -> float | None:
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def measure(spec: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of one job: the result, and its variants.

    Raises:
        InputError: the point cannot be made (a voxel too fine for the memory, say).
    """
    from fieldfuse.pipelines.job import read_settings, set_threads

    settings = read_settings({}, spec["settings"])
    settings.seed = spec["seed"]
    set_threads(settings.threads)
    settings.field.decoder = spec["wanted"].get("decoder", settings.field.decoder)  # its kernels are compiled before clocks run
    before = load_average()
    ground = open_ground(Path(spec["folder"]), settings, spec["wanted"]["views"])
    make = {"direct": make_direct, "tsdf": make_surface, "tsdf_stereo": make_surface}.get(spec["method"], make_field)
    with tempfile.TemporaryDirectory(prefix="fieldfuse-") as scratch:
        rows = [row_of(ground, spec, made) for made in make(ground, spec, Path(scratch))]
    stamp, load = datetime.now(UTC).isoformat(timespec="seconds"), [before, load_average()]
    return [{**row, "seed": spec["seed"], "load": load, "measured": stamp, "error": None} for row in rows]


def row_of(ground: Ground, spec: dict[str, Any], made: Made) -> dict[str, Any]:
    """Scores of one result at the test views, beside what it cost."""
    from fieldfuse.evaluation.score import compare_views

    indices = np.flatnonzero(ground.views.test)
    renders, seconds = [], []
    for index in indices:
        start = time.monotonic()
        renders.append(made.show(ground.views.intrinsics[index], ground.views.world_from_camera[index]))
        seconds.append(time.monotonic() - start)
    score = compare_views({"it": renders}, ground.views, indices, {"it": seconds}, ground.test_depths)["it"]
    stages = made.cost["stages"]
    return {
        "method": spec["method"],
        "wanted": {**spec["wanted"], **made.changed},
        "variant": made.variant,
        "setting": made.setting,
        **made.cost,
        "stages": {name: round(value, 3) for name, value in stages.items()},
        "seconds": round(sum(stages.values()), 3),
        "disk_bytes": made.disk_bytes,
        "seconds_per_view": score["seconds_per_view"],
        **{key: score[key] for key in SCORES},
        "depth_error": score["abs_err"],
        "depth_median_rel": (score["depth"] or {}).get("median_rel"),
    }


def main(path: str) -> int:
    """Measure the job in the file, write its answer beside it; 0 when there is one."""
    from fieldfuse.evaluation.report import plain
    from fieldfuse.poses.child import die_with_parent

    die_with_parent()
    spec = read_json(path)
    try:
        answer = {"rows": plain(measure(spec))}
    except FieldfuseError as error:
        answer = {"error": " ".join(str(error).split())}
    except MemoryError:
        answer = {"error": "there is not enough memory for this"}
    write_json(spec["answer"], answer)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
