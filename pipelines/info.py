"""`fieldfuse info SOURCE`: what a source is, before anything long is started; or what an earlier run has made."""

from __future__ import annotations

import json as writer
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse.pipelines.options import Options, takes

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture
    from fieldfuse.progress import Progress


OUTDATED = (
    ({"field"}, "the field is of earlier pictures or poses; `fieldfuse finetune {}` fits it to those that are there now"),
    ({"tsdf", "tsdf_texture"}, "the TSDF surface is of earlier pictures or poses; `fieldfuse tsdf {}` renews it"),
    ({"render", "evaluate"}, "scores, pictures and the report are of an earlier field or surface; `fieldfuse evaluate {}` renews them"),
    ({"splats", "splats_render"}, "the splats are of an earlier field; `fieldfuse export {} --formats splat` renews them"),
    ({"export"}, "the exports are of an earlier field; `fieldfuse export {}` renews them"),
)
LENGTHS = {True: "in metres", False: "without a unit; --scale, --marker, or the images' GPS give metres"}
STAGE = ("name", "seconds", "peak_memory_mb", "stopped")
BESIDE = 140  # characters that a line must have for the evidence to stand in the table
SHOWN = {"views": "views {}", "psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.3f}", "lpips": "LPIPS {:.3f}"}


@takes("depth_scale quiet json")
def info(
    target: Annotated[Path, typer.Argument(metavar="SOURCE", help="A source, or the folder of an earlier run.", show_default=False)],
    fast: Annotated[bool, typer.Option("--fast", help="Read headers only; pictures are not looked at for damage.")] = False,
    effects: Annotated[bool, typer.Option("--effects", help="Look for effects of camera and light, with the evidence of each.")] = False,
    *,
    options: Options,
) -> None:
    """Tell what was detected: kind, counts, sizes, lenses, depth, warnings."""
    from fieldfuse.capture.unpack import unpacked
    from fieldfuse.pipelines.folder import is_run_folder

    quiet = options.quiet or options.json
    with unpacked(target) as place:
        data = run_facts(target) if is_run_folder(target) else source_facts(place, fast, quiet, options.depth_scale)
        if effects:
            data["effects"] = effects_facts(place, quiet)
    if place != target:
        data["source"] = str(target)
        data["warnings"] = [text.replace(str(place), str(target)) for text in data["warnings"]]
    if options.json:
        typer.echo(writer.dumps(data, indent=1))
        return
    if effects:
        show_effects(data.pop("effects"))
    for key, value in for_people(data).items():
        for line in lines(key, value):
            typer.echo(line)


def source_facts(source: Path, fast: bool, quiet: bool, depth_scale: str | None = None) -> dict[str, Any]:
    """Facts of a capture; with `fast` no pixel is decoded."""
    from fieldfuse.capture import open_capture
    from fieldfuse.capture.checks import check_capture
    from fieldfuse.capture.depth_checks import with_depth_scale
    from fieldfuse.capture.photos import unused
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.source import describe_capture
    from fieldfuse.poses.check_given import best_fitting

    capture, agreement = with_depth_scale(open_capture(source, choose=None if fast else best_fitting), depth_scale), None
    if not fast:
        progress = make_progress(quiet)
        with progress.listening():
            progress.begin("checking")
            capture = check_capture(capture, progress)
            agreement, doubts = check_poses(capture, progress)
            capture = capture.with_frames(capture.frames, *doubts)
    return {
        "source": str(source),
        **describe_capture(capture),
        "intrinsics": lenses(capture),
        "focal_prior": len([frame for frame in capture.frames if frame.focal_prior is not None]),
        "test": sum(frame.split == "test" for frame in capture.frames),
        "points": 0 if capture.points is None else len(capture.points),
        "ordered": capture.ordered,
        "gps": with_gps(capture),
        "lengths": LENGTHS[capture.metric or (capture.has_depth and not capture.posed)],
        "depth_scale": capture.depth_scale if capture.has_depth else None,
        "unused": unused(capture),
        "alpha": None if fast else see_through(capture),
        "poses": agreement,
        "warnings": list(capture.warnings),
    }


def with_gps(capture: Capture) -> str | None:
    """How many images have a place with altitude, in words; None: no image has."""
    import numpy as np

    from fieldfuse.capture.gps import gps_of_images

    images = [frame.image for frame in capture.frames if frame.video_index is None]
    count = int(np.isfinite(gps_of_images(images)).all(axis=1).sum())
    return f"{count} of {len(images)} images have a place on earth" if count else None


def see_through(capture: Capture) -> str | None:
    """How much of its images a capture's alpha cuts away, by a few of them."""
    import numpy as np

    from fieldfuse.capture.images import load_image, spread
    from fieldfuse.errors import InputError

    if not capture.alpha or capture.filmed:
        return None
    shares = []
    for frame in spread(capture.frames, 5):
        with suppress(InputError):
            image = load_image(frame)
            shares.append(float((image[..., 3] < 128).mean()) if image.shape[2] == 4 else 0.0)
    return f"{100 * np.mean(shares or [0.0]):.0f}% of the pixels are transparent (by {len(shares)} of {len(capture.frames)} images)"


def check_poses(capture: Capture, progress: Progress) -> tuple[str | None, list[str]]:
    """How well the poses that a capture brings fit its images, in a line, and what a run would warn of or refuse."""
    from fieldfuse.camera import EQUIRECTANGULAR
    from fieldfuse.errors import PoseError
    from fieldfuse.poses.check_given import Agreement, check_given
    from fieldfuse.poses.result import given_poses

    panoramas = any(frame.intrinsics is not None and frame.intrinsics.lens == EQUIRECTANGULAR for frame in capture.frames)
    if capture.filmed or not capture.posed or panoramas:
        return None, []
    try:
        result = check_given(capture, given_poses(capture), progress=progress)
    except PoseError as error:
        return None, [str(error)]
    found = result.agreement
    return None if found is None else str(Agreement(found["share"], found["matches"], found["pairs"])), result.warnings


def lenses(capture: Capture) -> list[dict[str, Any]]:
    """The different cameras that the source names, each with how many frames have it."""
    found = Counter(frame.intrinsics for frame in capture.frames if frame.intrinsics is not None)
    return [{"frames": count, **camera.to_dict()} for camera, count in found.items()]


def run_facts(folder: Path) -> dict[str, Any]:
    """What a run's folder holds."""
    from fieldfuse.pipelines.folder import RunFolder
    from fieldfuse.pipelines.stages import finished_stages, outdated

    run = RunFolder(folder)
    about = run.about()
    page, records = run / "report.html", finished_stages(run)
    old = outdated(records)
    return {
        "run": str(folder),
        "source": about["source"],
        "command": about.get("command"),
        "version": about.get("version"),
        "report": str(page) if page.is_file() else None,
        "lengths": lengths_of(run / "scaling.json") if any(record.name == "scaling" for record in records) else None,
        "scores": scores_of(run / "evaluation.json"),
        "outdated": [text.format(folder) for stages, text in OUTDATED if stages & old],
        "stages": [{**{name: getattr(record, name) for name in STAGE}, "outdated": record.name in old} for record in records],
    }


def lengths_of(path: Path) -> str | None:
    """What made the run's lengths metres; None: nothing did, or the file cannot be read."""
    from fieldfuse.errors import InputError
    from fieldfuse.files import read_json
    from fieldfuse.poses.scaling import Scaling

    try:
        facts = Scaling.from_dict(read_json(path)).facts
    except InputError:
        return None
    return None if facts is None else f"in metres: {facts['text']}"


def scores_of(path: Path) -> dict[str, dict[str, float]]:
    """What was scored, and how well; empty when nothing was, or the file cannot be read: the run's other facts are shown all the same."""
    from fieldfuse.errors import InputError
    from fieldfuse.pipelines.schemas import EVALUATION, read_checked

    try:
        scores = read_checked(path, EVALUATION)
    except InputError:
        return {}
    return {
        what: {name: score[name] for name in SHOWN if score.get(name) is not None}
        for what, score in scores.items()
        if score.get("psnr") is not None
    }


def for_people(data: dict[str, Any]) -> dict[str, Any]:
    """Facts without what would stand there twice; stages and scores in a line each."""
    shown = dict(data)
    if isinstance(shown.get("extra"), dict):
        shown["extra"] = {name: value for name, value in shown["extra"].items() if shown.get(name) != value}
    if "stages" in shown:
        words = {"stopped": " (stopped early)", "outdated": " (out of date)"}
        shown["stages"] = ", ".join(
            f"{one['name']} {one['seconds']:.1f} s" + "".join(words[name] for name in words if one[name]) for one in shown["stages"]
        )
    if "scores" in shown:
        shown["scores"] = [
            f"{what.replace('_', ' ')}: " + ", ".join(SHOWN[name].format(value) for name, value in of.items())
            for what, of in shown["scores"].items()
        ]
    return shown


def lines(key: str, value: Any) -> list[str]:
    """One fact as lines for people; what is empty or unknown is left out."""
    if value is None or value == [] or value == {} or value is False:
        return []
    if isinstance(value, dict):
        return [line for inner, entry in value.items() for line in lines(inner, entry)]
    shown = value if isinstance(value, list) else ["yes" if value is True else value]
    if isinstance(shown[0], dict):
        rest = [{"and": f"{len(shown) - 4} more"}] if len(shown) > 4 else []
        shown = [", ".join(f"{inner} {number(entry)}" for inner, entry in part.items()) for part in [*shown[:4], *rest]]
    return [f"{key.replace('_', ' '):<14} {number(entry)}" for entry in shown]


def number(value: Any) -> str:
    """Fractions with six digits, all else as it is."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def effects_facts(target: Path, quiet: bool) -> dict[str, Any]:
    """What an earlier run found, or what its pictures and given poses show now.

    Raises:
        InputError: a source without poses: without them shared points cannot be distinguished from wrong matches.
    """
    from fieldfuse.capture import open_capture
    from fieldfuse.effects.depth_camera import DEPTH_OFFSET, look_for_offset
    from fieldfuse.effects.diagnostics import diagnose
    from fieldfuse.errors import InputError
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.folder import is_run_folder
    from fieldfuse.pipelines.schemas import Effects, read_checked

    if is_run_folder(target):
        if not (target / "effects.json").is_file():
            raise InputError(f"{target} holds no effects.json; run the job again without effects=off")
        return {key: value for key, value in read_checked(target / "effects.json", Effects).items() if key != "corrections"}
    capture = open_capture(target)
    posed = [frame for frame in capture.frames if frame.world_from_camera is not None and frame.intrinsics is not None]
    if len(posed) < 3:
        raise InputError(
            f"{target} comes without camera poses, which the evidence needs; find them first: fieldfuse poses {target} --out DIR, "
            "copy DIR/exports/cameras/transforms.json into the capture's folder, then fieldfuse info THERE/transforms.json --effects"
        )
    progress = make_progress(quiet)
    with progress.listening():
        progress.begin("effects")
        shown = capture.with_frames(posed)
        found = diagnose(shown, progress=progress)
        findings = dict(found.findings)
        if shown.has_depth:
            with found.timing.by(DEPTH_OFFSET):
                findings[DEPTH_OFFSET] = look_for_offset(shown, range(len(posed)), found.seen, progress)[0]
    progress.finish("effects", found.seconds + found.timing.of(DEPTH_OFFSET), False)
    return {
        "effects": [{**finding.to_dict(), "seconds": found.timing.of(name)} for name, finding in findings.items()],
        "seconds": round(found.seconds + found.timing.of(DEPTH_OFFSET), 3),
        "looked_at": found.facts,
    }


def show_effects(data: dict[str, Any]) -> None:
    """The table on standard output, one effect a row; where lines are short what speaks for each stands below it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from fieldfuse.evaluation.words import significant

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=180)
    beside = console.width >= BESIDE
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("effect", "there", "number", "threshold", "held out", "s", *(["evidence"] if beside else [])):
        table.add_column(column, justify="right" if column in ("number", "threshold", "held out", "s") else "left", overflow="fold")
    for entry in data["effects"]:
        held = entry.get("held_out")
        change = "" if held is None else f"{significant(held['before'])} → {significant(held['after'])} {held['unit']}"
        there = "yes" if entry["there"] else "no"
        paid = f"{entry['seconds']:.2f}" if "seconds" in entry else ""
        last = [Text(entry["reason"])] if beside else []
        table.add_row(entry["effect"], there, f"{entry['number']:.3f}", f"{entry['threshold']:g}", change, paid, *last)
    console.print(table)
    if not beside:
        for entry in data["effects"]:
            console.print(f"\n{entry['effect']}: {entry['reason']}", markup=False)
        console.print()
    about = data["looked_at"]
    points = f", {about['points_seconds']:.1f} s of it for finding these points" if "points_seconds" in about else ""
    console.print(f"{about['frames']} pictures and {about['points']} shared points looked at in {data['seconds']:.1f} s{points}")
