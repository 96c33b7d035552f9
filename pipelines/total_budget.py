"""`fieldfuse run --total-budget SECONDS`: settings chosen so that the whole run takes so long, and what was predicted beside what it took.

Decided step by step, each time from what is known by then: pictures when the capture is known, the fit's seconds and its finest lattice
when everything before it is done, the exports when the field can be rendered. What the machine's self-test takes, which is made once and
has most of the compiling in it, comes on top: within the seconds given it would leave a first run next to none for its fit.
"""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import Any

import psutil

from fieldfuse.capture.convert import to_convert
from fieldfuse.capture.prepare import held_out
from fieldfuse.capture.types import Capture
from fieldfuse.config import DEFAULT_EXPORTS, Settings, settings_dict
from fieldfuse.errors import FieldfuseError
from fieldfuse.evaluation import budget as model
from fieldfuse.evaluation.budget_probe import self_test
from fieldfuse.files import fingerprint, read_json, write_json
from fieldfuse.pipelines.exports import SURFACES, TEXTURE
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.pictures import PAGE
from fieldfuse.pipelines.prepare import Prepared
from fieldfuse.pipelines.source import picture_size
from fieldfuse.pipelines.textured import TSDF_TEXTURE
from fieldfuse.training.start import MARGIN, ROOM_MARGIN, finest_resolution, make_space, worth_a_level

FILE = "plan.json"
LONGEST_START = 60.0  # seconds; a process that is older was not started for this command
NOT_FITTED = ("capture", "frames", "poses", "effects", "scene", "views", "tsdf", TSDF_TEXTURE, "render", "export", "evaluate", "report")
TOO_FEW = " The smallest choice needs about {:.0f} s on this machine as busy as it is; give more, or expect that."
BESIDES = " Before that, this machine was measured, which is done once, and took {:.0f} s besides."
WORTH_LEARNING = 0.3  # seconds; shorter stages say little


class TotalBudget:
    """The plan of one run: the target, what was chosen, what was predicted.

    Attributes:
        speed: of this machine. work: of the capture. choice: what was decided so far; all three from `choose_pictures` on.
        predicted: stage → seconds. self_test: seconds that the machine's self-test took, once; most of them are compiling.
        all_wanted: exports are what they are by default. again: an earlier run of the same plan has decided everything.
    """

    speed: model.Speed
    work: model.Work
    choice: model.Choice

    def __init__(self, seconds: float) -> None:
        self.target = seconds
        started = time.time() - psutil.Process().create_time()
        self._began = time.monotonic() - (started if started < LONGEST_START else 0.0)
        self.predicted: dict[str, float] = {}
        self.self_test = self.export_planned = 0.0
        self.all_wanted = self.again = False
        self.name = self.given = ""  # of the machine, and a hash of what else the plan depends on: settings, machine, capture

    def elapsed(self) -> float:
        return time.monotonic() - self._began

    def choose_pictures(self, job: Job, capture: Capture) -> None:
        """Decide picture size and a video's frames; predict every stage."""
        settings = job.settings
        threads = settings.threads or psutil.cpu_count() or 1
        self.name = model.signature(threads, settings.device)
        speed = model.remembered(self.name)
        if speed is None:
            start = time.monotonic()
            with job.progress.stage("self-test"):
                speed = self_test(settings)
            self.self_test = time.monotonic() - start
            self._began += self.self_test
            model.remember(self.name, speed)
        self.speed = speed
        self.work = work_of(capture, settings)
        self.given = fingerprint(settings_dict(settings), self.name, asdict(self.work))
        self.all_wanted = list(settings.export.formats) == list(DEFAULT_EXPORTS)
        kept = self._kept(job)
        self._decide_effects(settings, kept)
        for extra in (TEXTURE, PAGE) if self.all_wanted else ():
            if self._left_out_early(extra, kept):
                self._leave_out(settings, extra)
        if kept is not None:
            self.choice, self.again = kept, True
        else:
            self.choice = model.choose(self.speed, self.work, self.target - self.elapsed(), settings.capture.max_frames)
            self.choice.effects = self.work.effects
        settings.capture.image_size = self.choice.image_size
        if self.choice.max_frames is not None:
            settings.capture.max_frames = self.choice.max_frames
        before = self.elapsed() - job.stages.records["capture"].seconds * (not job.stages.cached["capture"])
        parts = model.predict(self.speed, self.work, self.choice)
        parts["export"] = self._for_exports(job, self.target - before - sum(parts.values()))
        parts["start"] = before
        parts["fit"] = model.fit_seconds(self.target, 0.0, sum(parts.values()))
        self.predicted = parts

    def _decide_effects(self, settings: Settings, kept: model.Choice | None) -> None:
        """Looking for them is left out, unless settings name some, when it would take most of so short a run."""
        if not self.work.effects or settings.effects.on:
            return
        looking = self.speed.seconds("effects", model.effects_work(self.work))
        wanted = looking <= model.EFFECTS_SHARE * self.target if kept is None or kept.effects is None else kept.effects
        if not wanted:
            settings.effects.mode = "off"
            self.work = replace(self.work, effects=False)

    @property
    def _least_fit(self) -> float:
        """Seconds that a fit should have: textures, then the page to walk through, are left out of a run in which they would take them."""
        return min(model.FIT_SHARE * self.target, model.ENOUGH)

    def _left_out_early(self, extra: str, kept: model.Choice | None) -> bool:
        """Whether it is already known now that this is left out: an earlier run decided so, or the TSDF, which is made before the field,
        would take too long for its texture. Everything else is decided when the fit is."""
        if kept is not None:
            return getattr(kept, extra) is False
        early = extra == TEXTURE and self.work.depth
        return early and model.left_for_fit(self.speed, self.work, self.target - self.elapsed()) < self._least_fit

    def _leave_out(self, settings: Settings, extra: str) -> None:
        """Exports are made without it."""
        settings.export.formats = [name for name in settings.export.formats if name != extra]
        self.work = replace(self.work, **{extra: False})

    def _left(self, job: Job) -> float:
        """Seconds that are left for the fit, with all exports that are still wanted after it."""
        left = self._before(job, "render", "evaluate", "report")
        return left - self._for_exports(job, left) - self.speed.seconds("beside", 1.0)

    def choose_fit(self, job: Job, ready: Prepared) -> None:
        """Decide the fit's seconds and its finest lattice from what is left, and whether meshes get textures and the field its page."""
        if not self.again:
            for extra in (TEXTURE, PAGE) if self.all_wanted else ():
                if getattr(self.work, extra) and self._left(job) < self._least_fit:
                    self._leave_out(job.settings, extra)
            self.choice.texture, self.choice.page = self.work.texture, self.work.page
            self.choice.fit_seconds = round(max(model.LEAST_FIT, self._left(job)), 2)
            pace = self.speed.units["fit"] * self._pace(job)
            possible = model.resolution_for(self.choice.fit_seconds, pace, finest(job, ready))
            self.choice.resolution = possible if job.settings.field.resolution is not None else worth_a_level(possible)
        job.settings.fit.budget = self.choice.fit_seconds
        job.settings.fit.passes = None  # the budget counts
        job.settings.field.resolution = self.choice.resolution

    def choose_exports(self, job: Job) -> None:
        """Decide how much is rendered for mesh and video, at the pace that the test views were rendered at."""
        export = job.settings.export
        if not self.again:
            rays = model.amounts(self.work, self.choice)["render"]
            spent = job.stages.records["render"].seconds
            factor = self.speed.factors.get("export", 1.0)
            a_ray = factor * model.EXPORT_RAY * (spent / rays if rays else self.speed.seconds("export", 1.0))
            a_frame = a_ray * model.video_rays(self.work, replace(self.choice, video_frames=1))
            left = self._before(job, "evaluate", "report")
            for size in (export.mesh_size, None):  # finer depth where that costs no view
                self.choice.mesh_size = size
                once, each = (factor * amount * self.speed.units["features"] for amount in model.mesh_work(self.work, self.choice))
                views, frames = model.exports_for(left - once, each, a_frame)
                if views >= min(export.mesh_views, model.MESH_VIEWS[1]):
                    break
            self.choice.mesh_views, self.choice.video_frames = min(views, export.mesh_views), min(frames, export.video_frames)
            self.export_planned = once + self.choice.mesh_views * each + self.choice.video_frames * a_frame
            self._keep(job)
        assert self.choice.mesh_views is not None and self.choice.video_frames is not None
        export.mesh_views = self.choice.mesh_views
        export.mesh_size = self.choice.mesh_size or min(export.mesh_size, model.MESH_SIDE, self.choice.image_size)
        if self.choice.video_frames:
            export.video_frames = self.choice.video_frames
        else:
            export.formats = [name for name in export.formats if name != "video"]

    def report(self, job: Job) -> dict[str, Any]:
        """The report's part `budget`: seconds given, predicted and real, in all and by stage, and what was chosen."""
        real = {record.name: record.seconds for record in job.stages.records.values()}
        names = {**dict.fromkeys(self.predicted), **dict.fromkeys(name for name in real if name not in ("field", "keyframes"))}
        shown = {
            name: {"predicted": _round(self.predicted.get(name)), "real": _round(real.get("field" if name == "fit" else name))}
            for name in names
        }
        return {
            "asked_seconds": self.target,
            "predicted_seconds": _round(sum(self.predicted.values())),
            "real_seconds": _round(self.elapsed()),
            "self_test_seconds": _round(self.self_test),
            "stages": shown,
            "choice": self.choice.to_dict(),
            "reused": any(job.stages.cached.values()),
        }

    def note(self, report: dict[str, Any]) -> str:
        """One sentence for the page."""
        chosen = self.choice
        parts = [f"pictures of {chosen.image_size} pixels", f"{chosen.fit_seconds:g} s of fitting", f"at most {chosen.resolution}³ voxels"]
        if chosen.max_frames is not None:
            parts.append(f"{chosen.max_frames} frames")
        parts.append("no video" if not chosen.video_frames else f"{chosen.video_frames} video frames")
        if chosen.effects is False:
            parts.append("effects not looked for")
        extras = (("textures", chosen.texture), ("page to walk through", chosen.page))
        parts += [f"no {name}" for name, wanted in extras if wanted is False]
        return (
            f"Of the total budget of {report['asked_seconds']:g} s, {report['predicted_seconds']:.0f} s were predicted and"
            f" {report['real_seconds']:.0f} s spent until this page was written; chosen: {', '.join(parts)}."
            + (BESIDES.format(report["self_test_seconds"]) if report.get("self_test_seconds") else "")
            + (TOO_FEW.format(report["predicted_seconds"]) if report["predicted_seconds"] > (1 + model.AGREES) * self.target else "")
        )

    def finish(self, job: Job, report_seconds: float) -> dict[str, Any]:
        """After the report: correct its total, and learn from stages that took other than predicted."""
        report = self.report(job)
        report["stages"]["report"] = {"predicted": _round(self.predicted.get("report")), "real": _round(report_seconds)}
        if not report["reused"]:
            for name in NOT_FITTED:
                real, predicted = report["stages"].get(name, {}).get("real"), self.predicted.get(name)
                if real and predicted and max(real, predicted) > WORTH_LEARNING and name not in ("export", "effects"):
                    self.speed.learn(name, predicted, real)
            fitted = report["stages"].get("fit", {}).get("real")
            if fitted and self.choice.fit_seconds:
                beside = self.speed.seconds("beside", 1.0)
                self.speed.learn("beside", beside, max(fitted - self.choice.fit_seconds, 0.2 * beside))
            self._learn_effects(job, report["stages"].get("effects", {}).get("real"))
            made = report["stages"].get("export", {}).get("real")
            if made and self.export_planned > WORTH_LEARNING:
                self.speed.learn("export", self.export_planned, made)
            if abs(report["real_seconds"] - self.target) > 2 * model.AGREES * self.target:
                model.remember(self.name, None)  # so far off that the machine must have changed: measured again next time
            else:
                model.remember(self.name, self.speed)
        return report

    def _for_exports(self, job: Job, left: float) -> float:
        """Seconds that are set aside for exports: a share of what is left, no more than all of them can take, no less
        than the fewest."""
        export = job.settings.export
        video = export.video_frames if "video" in export.formats else 0
        finest = replace(self.choice, mesh_size=export.mesh_size)
        most = model.most_export_seconds(self.speed, self.work, finest, export.mesh_views, video)
        surface = bool(SURFACES & set(export.formats))
        least = min(most, model.least_export_seconds(self.speed, self.work, self.choice)) if surface else 0.0
        return max(least, min(model.EXPORT_SHARE * max(0.0, left), most))

    def _learn_effects(self, job: Job, real: float | None) -> None:
        """Looking for effects takes less when none is corrected: what is learnt is what a picture takes. Where all were looked at, and none
        was corrected after all, only the seconds count."""
        path = job.folder / "effects.json"
        if not real or real < WORTH_LEARNING or not path.is_file():
            return
        made = read_json(path).get("corrections") or {}
        some, all_of_them = (self.speed.seconds("effects", model.effects_work(self.work, self.choice, every)) for every in (0.0, 1.0))
        corrected = bool(made.get("gain") or made.get("poses"))
        self.speed.learn("effects", all_of_them if corrected else min(max(real, some), all_of_them), real)

    def _before(self, job: Job, *later: str) -> float:
        """Seconds that are left before these stages must begin."""
        return self.target - self.elapsed() - sum(self.predicted.get(stage, 0.0) for stage in later) * self._pace(job)

    def _pace(self, job: Job) -> float:
        """How much slower than predicted the stages were so far; other work on the machine slows the rest, too."""
        done = [name for name in ("capture", "scene", "views") if name in self.predicted and not job.stages.cached.get(name, True)]
        real = sum(job.stages.records[name].seconds for name in done)
        predicted = sum(self.predicted[name] for name in done)
        return min(max((real + model.STEADY) / (predicted + model.STEADY), 0.5), 3.0)

    def _keep(self, job: Job) -> None:
        kept = {"asked": self.target, "source": str(job.source), "given": self.given, "choice": self.choice.to_dict()}
        write_json(job.folder / FILE, kept)

    def _kept(self, job: Job) -> model.Choice | None:
        """What an earlier run of this very plan decided; None: there was none, or what it left is damaged."""
        path = job.folder / FILE
        if not path.is_file():
            return None
        try:
            kept = read_json(path)
            if (kept["asked"], kept["source"], kept["given"]) == (self.target, str(job.source), self.given):
                return model.Choice.of(kept["choice"])
        except (FieldfuseError, KeyError, TypeError, ValueError):
            pass
        return None


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def work_of(capture: Capture, settings: Any) -> model.Work:
    """What the capture asks for, from what its headers say."""
    width, height = picture_size(capture)
    video = capture.filmed
    frames = settings.capture.max_frames if video else len(capture.frames)
    test = (
        round(frames / settings.capture.holdout)
        if video and settings.capture.holdout
        else int(held_out(capture, settings.capture.holdout).sum())
    )
    posed = settings.poses.source == "given" or (settings.poses.source == "auto" and capture.posed)
    outlined = not posed or capture.has_depth or capture.alpha or (capture.points is not None and len(capture.points) > 0)
    total = int(capture.extra.get("frames") or len(capture.frames)) if video else frames
    depth = settings.tsdf.enabled != "off" and capture.has_depth
    effects = settings.effects.mode != "off" or bool(settings.effects.on)
    return model.Work(
        frames,
        width or 640,
        height or 480,
        test,
        posed,
        depth,
        bool(outlined),
        video=video,
        total=total,
        effects=effects,
        alpha=capture.alpha,
        texture=TEXTURE in settings.export.formats,
        page=PAGE in settings.export.formats,
        converted=len(to_convert(capture)),
    )


def finest(job: Job, ready: Prepared) -> int:
    """The lattice that a fit would end at without a budget."""
    settings, scene, views = job.settings.field, ready.scene, ready.views
    if settings.resolution is not None:
        return settings.resolution
    background = scene.has_background if settings.background == "auto" else settings.background == "on"
    space = make_space(scene, background and views.background is None, MARGIN if views.background is not None else ROOM_MARGIN)
    return finest_resolution(space, ready.training, scene)
