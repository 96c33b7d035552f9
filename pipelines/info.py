"""`fieldfuse info SOURCE`: what a source is, before anything long is started; or what an earlier run has made."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse.pipelines.options import Json, Quiet

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture
    from fieldfuse.progress import Progress


OUTDATED = (
    ({"field"}, "the field is of earlier pictures or poses; `fieldfuse finetune {}` fits it to those that are there now"),
    ({"tsdf", "tsdf_texture"}, "the TSDF surface is of earlier pictures or poses; `fieldfuse tsdf {}` renews it"),
    ({"render", "evaluate"}, "scores, pictures and the report are of an earlier field or surface; `fieldfuse evaluate {}` renews them"),
    ({"export"}, "the exports are of an earlier field; `fieldfuse export {}` renews them"),
)
SHOWN = {"views": "views {}", "psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.3f}", "lpips": "LPIPS {:.3f}"}


def info(
    target: Annotated[Path, typer.Argument(metavar="SOURCE", help="A source, or the folder of an earlier run.", show_default=False)],
    fast: Annotated[bool, typer.Option("--fast", help="Read headers only; pictures are not looked at for damage.")] = False,
    effects: Annotated[bool, typer.Option("--effects", help="Look for effects of camera and light, with the evidence of each.")] = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Tell what was detected: kind, counts, sizes, lenses, depth, warnings."""
    from fieldfuse.pipelines.folder import is_run_folder

    data = run_facts(target) if is_run_folder(target) else source_facts(target, fast, quiet or json)
    if effects:
        from fieldfuse.pipelines.effects_table import effects_facts

        data["effects"] = effects_facts(target, quiet or json)
    if json:
        import json as writer

        typer.echo(writer.dumps(data, indent=1))
    else:
        if effects:
            from fieldfuse.pipelines.effects_table import show

            show(data.pop("effects"))
        for key, value in for_people(data).items():
            for line in lines(key, value):
                typer.echo(line)


def source_facts(source: Path, fast: bool, quiet: bool) -> dict[str, Any]:
    """Facts of a capture; with `fast` no pixel is decoded."""
    from fieldfuse.capture import open_capture
    from fieldfuse.capture.beside import unused
    from fieldfuse.capture.checks import check_capture
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.summary import describe_capture
    from fieldfuse.poses.check_given import best_fitting

    capture, agreement = open_capture(source, choose=None if fast else best_fitting), None
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
        "depth_scale": capture.depth_scale if capture.has_depth else None,
        "unused": unused(capture),
        "poses": agreement,
        "warnings": list(capture.warnings),
    }


def check_poses(capture: Capture, progress: Progress) -> tuple[str | None, list[str]]:
    """How well the poses that a capture brings fit its images, in a line, and what a run would warn of or refuse."""
    from fieldfuse.errors import PoseError
    from fieldfuse.poses.check_given import Agreement, check_given
    from fieldfuse.poses.result import given_poses

    if capture.filmed or not capture.posed:
        return None, []
    try:
        result = check_given(capture, given_poses(capture), progress=progress)
    except PoseError as error:
        return None, [str(error)]
    found = result.agreement
    return None if found is None else str(Agreement(found["share"], found["matches"], found["pairs"])), result.warnings


def lenses(capture: Capture) -> list[dict[str, Any]]:
    """The different cameras that the source names, each with how many frames have it."""
    found: dict[Any, int] = {}
    for frame in capture.frames:
        if frame.intrinsics is not None:
            found[frame.intrinsics] = found.get(frame.intrinsics, 0) + 1
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
        "scores": scores_of(run / "evaluation.json"),
        "outdated": [text.format(folder) for stages, text in OUTDATED if stages & old],
        "stages": [
            {
                "name": record.name,
                "seconds": record.seconds,
                "peak_memory_mb": record.peak_memory_mb,
                "stopped": record.stopped,
                "outdated": record.name in old,
            }
            for record in records
        ],
    }


def scores_of(path: Path) -> dict[str, dict[str, float]]:
    """What was scored, and how well; empty when nothing was, or the file cannot be read: the run's other facts are told all the same."""
    from fieldfuse.errors import InputError
    from fieldfuse.pipelines.kept import EVALUATION, read_kept

    try:
        scores = read_kept(path, EVALUATION)
    except InputError:
        return {}
    return {
        what: {name: score[name] for name in SHOWN if score.get(name) is not None}
        for what, score in scores.items()
        if score is not None and score.get("psnr") is not None
    }


def for_people(data: dict[str, Any]) -> dict[str, Any]:
    """Facts without what would stand there twice; stages and scores in a line each."""
    shown = dict(data)
    if isinstance(shown.get("extra"), dict):
        shown["extra"] = {name: value for name, value in shown["extra"].items() if shown.get(name) != value}
    if "stages" in shown:
        words = {"stopped": " (stopped early)", "outdated": " (out of date)"}
        told = [f"{one['name']} {one['seconds']:.1f} s" + "".join(words[name] for name in words if one[name]) for one in shown["stages"]]
        shown["stages"] = ", ".join(told)
    if "scores" in shown:
        shown["scores"] = [
            f"{what.replace('_', ' ')}: " + ", ".join(SHOWN[name].format(value) for name, value in of.items())
            for what, of in shown["scores"].items()
        ]
    return shown


def lines(key: str, value: Any) -> list[str]:
    """One fact as lines for people; what is empty or unknown is left out."""
    name = key.replace("_", " ")
    if value is None or value == [] or value == {} or value is False:
        return []
    if isinstance(value, dict):
        return [line for inner, entry in value.items() for line in lines(inner, entry)]
    if isinstance(value, list) and isinstance(value[0], dict):
        shown = value[:4] + ([{"and": f"{len(value) - 4} more"}] if len(value) > 4 else [])
        return [f"{name:<14} " + ", ".join(f"{inner} {number(entry)}" for inner, entry in part.items()) for part in shown]
    if isinstance(value, list):
        return [f"{name:<14} {entry}" for entry in value]
    return [f"{name:<14} {'yes' if value is True else number(value)}"]


def number(value: Any) -> str:
    """Fractions with six digits, all else as it is."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
