"""`fieldfuse train`: train the NeRFusion networks across scenes; under `torchrun`, on many devices."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fieldfuse.pipelines.options import Options, bound_threads, takes


@takes("threads pairs quiet")
def train(
    config: Annotated[Path | None, typer.Option(help="Training settings (YAML); see configs/train/ and docs/training.md.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of checkpoints, learning curve, validation pictures and weights.")] = Path("training"),
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the newest checkpoint in the folder.")] = False,
    steps: Annotated[int | None, typer.Option(help="Stop after so many steps in all; the schedule stays.", min=1)] = None,
    *,
    options: Options,
) -> None:
    """Train the networks that turn pictures into a field without fitting; writes `weights.safetensors`."""
    bound_threads({"flags": {"threads": options.threads}})
    from fieldfuse.errors import Interrupted
    from fieldfuse.nerfusion.training.distributed import join_crew
    from fieldfuse.nerfusion.training.settings import load_train_settings
    from fieldfuse.nerfusion.training.train import WEIGHTS, Trainer
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.job import set_threads

    settings = load_train_settings(config, pairs=options.pairs or ())
    set_threads(options.threads or settings.threads)
    with join_crew(settings.device) as crew:
        trainer = Trainer(settings, out, crew, resume)
        quiet = options.quiet or not crew.leads
        if not quiet:
            for note in trainer.notes:
                typer.echo(f"note: {note}")
        progress = make_progress(quiet)
        with progress.listening():
            progress.begin("training")
            taken = trainer.run(steps, progress)
        stopped = progress.stopping() and taken < min(steps or settings.total_steps, settings.total_steps)
    if not quiet:
        if trainer.state.policy.met:
            typer.echo(f"note: {trainer.state.policy.met} steps were not finite and moved nothing, the last at {trainer.state.policy.last}")
        typer.echo(f"{out / WEIGHTS} ({taken} steps)")
    if stopped:
        raise Interrupted(f"stopped after {taken} steps; go on with --resume")
