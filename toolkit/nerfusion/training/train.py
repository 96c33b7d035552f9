"""The training loop: samples → gradients → Adam; learning curve, health, validation, checkpoints. Can be stopped and resumed."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training import optimiser
from fieldfuse.nerfusion.training.checkpoint import TrainState, checkpoints, load_checkpoint, save_checkpoint
from fieldfuse.nerfusion.training.curve import Curve, GateWatch
from fieldfuse.nerfusion.training.distributed import Crew
from fieldfuse.nerfusion.training.mixture import Mixture
from fieldfuse.nerfusion.training.settings import TrainSettings
from fieldfuse.nerfusion.training.step import Stepper, seeded
from fieldfuse.nerfusion.training.validate import Validation, load_cases, validate
from fieldfuse.nerfusion.weights import SHIPPED, config_from, load_model, save_model
from fieldfuse.progress import SILENT, Progress

WEIGHTS = "weights.safetensors"
BETAS = (0.9, 0.999)


def make_model(settings: TrainSettings) -> NerfusionModel:
    """The networks as the settings want them, started from `start_from` or by chance from `seed`.

    Raises:
        InputError: a setting of the networks is not known or not that of the weights to start from, or these cannot be read.
    """
    if settings.start_from is not None:
        started = load_model(SHIPPED if settings.start_from == "shipped" else settings.start_from).train()
        own = asdict(started.config)
        for name, value in settings.model.items():
            if own.get(name) != value:
                raise InputError(f"model: {name} is {value}, and {own.get(name)} in the weights that start_from names; leave one out")
        if settings.pretrained:
            raise InputError("pretrained and start_from are both set; each says where the encoder's weights come from, leave one out")
        return started
    try:
        config = config_from(dict(settings.model))
    except ValueError as error:
        raise InputError(f"model: {error}; see docs/training.md") from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        model = NerfusionModel(config).train()
    if settings.pretrained:
        model.encoder.load_imagenet()
    return model


def _changes(before: dict[str, Any], now: dict[str, Any], of: str = "") -> list[str]:
    """What differs between two runs' settings, but for where and how they run and what they record."""
    out = []
    for name, value in now.items():
        if of + name in ("device", "threads", "record"):
            continue
        old = before.get(name)
        if isinstance(value, dict) and isinstance(old, dict) and name != "model":
            out += _changes(old, value, f"{of}{name}.")
        elif old != value:
            out.append(f"{of}{name} {old} → {value}")
    return out


class Trainer:
    """One training run in a folder.

    Args:
        out: folder of checkpoints, `curve.csv`, `curve.png`, `validation-*.png` and `weights.safetensors`; only the crew's leader writes.
        resume: go on from the newest checkpoint in `out`, when there is one.

    Raises:
        InputError: data, weights or checkpoint cannot be used.
    """

    def __init__(self, settings: TrainSettings, out: Path, crew: Crew, resume: bool = False) -> None:
        self.settings, self.out, self.crew = settings, out, crew
        self.model = make_model(settings).to(crew.device)
        wanted = settings.optimiser
        adam = torch.optim.Adam(self.model.parameters(), lr=wanted.rate, betas=BETAS)
        self.average = optimiser.Average(self.model, wanted.average, wanted.start_share)
        self.state = TrainState(self.model, adam, self.average)
        self.mixture = Mixture(settings, crew.rank, crew.device)
        self.stepper, self.gates, self.curve = Stepper(self.model, settings), GateWatch(self.model), Curve(out)
        self.notes: list[str] = []
        found = checkpoints(out)
        if resume and found:
            changed = _changes(load_checkpoint(found[-1], self.state), asdict(settings))
            self.curve.load(self.state.step)
            if changed:
                self.notes.append(f"settings are not those of the steps before, and go on as they are now: {', '.join(changed)}")
        elif found and crew.leads:
            raise InputError(f"{out} already holds a training run; go on with it by --resume, or choose another --out folder")
        self.cases = [case for folder in settings.record.captures for case in load_cases(folder, settings)] if crew.leads else []
        self._gathered: list[dict[str, float]] = []

    def run(self, until: int | None = None, progress: Progress = SILENT) -> int:
        """Train up to step `until` (the settings' total by default); answers the steps taken in all.

        A request to stop is honoured after the step at hand; what there is is saved.

        Raises:
            InputError: no finite gradient for many steps (what was learnt before is saved), or the data cannot be read.
            OutputError: results cannot be written.
        """
        state, record = self.state, self.settings.record
        last = min(until or self.settings.total_steps, self.settings.total_steps)
        saved_at, saved_step = time.monotonic(), -1
        while state.step < last:
            row = self.one_step()
            self._gathered.append(row)
            state.step += 1
            if state.step % record.log_every == 0 or state.step == last:
                self._log()
            if self.cases and (state.step % record.validate_every == 0 or state.step == self.settings.total_steps):
                self._validate()
            stop = self.crew.any(progress.stopping())
            due = time.monotonic() - saved_at > 60 * record.checkpoint_minutes
            if self.crew.leads and (due or stop or state.step % record.checkpoint_every == 0 or state.step == last):
                self.save()
                saved_at, saved_step = time.monotonic(), state.step
            progress.update(state.step, last, f"loss {row['loss']:.4f}, {row.get('psnr_local', float('nan')):.1f} dB")
            if stop:
                break
        if self.crew.leads and saved_step != state.step:
            self.save()
        self.crew.wait()
        return state.step

    def one_step(self) -> dict[str, float]:
        """Take one step; answers its row of the learning curve."""
        settings, state, crew, step = self.settings, self.state, self.crew, self.state.step
        start = time.monotonic()
        second = step >= settings.stage.steps
        sample = self.mixture.sample(step, settings.pictures.key_frames if second else 1).to(crew.device)
        drawn = time.monotonic()
        state.adam.zero_grad(set_to_none=True)
        generator = seeded(settings.seed, crew.rank, step)
        # Measured in one step of each row of the curve: it costs another pass through the encoder.
        self.stepper.watched = self.gates.on = (step + 1) % settings.record.log_every == 0
        with torch.autocast(crew.device.type, torch.bfloat16, enabled=settings.optimiser.reduced):
            outcome = (self.stepper.stage_two if second else self.stepper.stage_one)(sample, step, generator)
        self.gates.on = False  # what is validated in between counts in no row
        crew.average_gradients(self.model.parameters())
        norm = optimiser.clipped(self.model, settings.optimiser.clip)
        rate = optimiser.learning_rate(settings, step) * state.policy.slower
        # The same on all processes, so that their weights stay equal.
        good = math.isfinite(norm) and not crew.any(not math.isfinite(outcome.loss))
        if good:
            for group in state.adam.param_groups:
                group["lr"] = rate
            state.adam.step()
            self.average.update(self.model, step)
            state.policy.well()
        else:
            self._skip(outcome.loss)
        row = {"loss": outcome.loss, "gradient_norm": norm, "rate": rate, "skipped": float(not good)}
        row |= outcome.means() | self.gates.shares()
        return row | {"seconds_data": drawn - start, "seconds": time.monotonic() - start, "voxels": float(sample.resolution)}

    def _skip(self, loss: float) -> None:
        """One bad sample must not end a run of days; many in a row mean that the settings cannot work."""
        step, policy = self.state.step + 1, self.state.policy
        where = optimiser.where_not_finite(loss, self.model.named_parameters())
        policy.bad(f"step {step}: {where}")
        if policy.gives_up:
            if self.crew.leads:
                self.save()
            raise InputError(
                f"{optimiser.MOST} steps in a row were not finite, the last at step {step} in {where}; the weights of the last good step "
                f"are in {self.out}, lower optimiser.rate and go on from them by start_from"
            )

    def _log(self) -> None:
        step, (rows, self._gathered) = self.state.step, (self._gathered, [])
        mean = {}
        for name in dict.fromkeys(name for row in rows for name in row):
            values = [row[name] for row in rows if name in row and math.isfinite(row[name])]
            if values:
                mean[name] = sum(values) / len(values)
        stage = 2.0 if step > self.settings.stage.steps else 1.0
        self.curve.add({"step": float(step), "stage": stage, "depth_weight": self.stepper.depth_weight(step), **self.crew.mean(mean)})
        if self.crew.leads and step % self.settings.record.health_every == 0:
            self.curve.write()

    def _validate(self) -> None:
        step, stage = self.state.step, self.settings.stage
        how = Validation(self.stepper.prunes(step), stage.levels if step > stage.steps else 1, stage.witnesses)
        with self.average.applied(self.model):
            numbers, each = validate(self.model, self.cases, self.crew.device, how, self.out / f"validation-{step:07d}.png")
        for name, values in each.items():
            numbers |= {f"{key} {name}": value for key, value in values.items()}
        self.curve.add({"step": float(step), **numbers})
        self.curve.write()

    def save(self) -> None:
        """Write the curve, a checkpoint and the weights so far.

        The curve goes first: a run that is resumed from the checkpoint before cuts what it has too much, and what it lacks is lost.

        Raises:
            OutputError: the folder is not writable.
        """
        self.curve.write()
        save_checkpoint(self.out, self.state, asdict(self.settings), self.settings.record.keep)
        with self.average.applied(self.model):
            save_model(self.out / WEIGHTS, self.model, {"steps": self.state.step})
