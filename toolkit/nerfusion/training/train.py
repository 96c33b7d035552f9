"""The training loop: samples → gradients → Adam; learning curve, health, validation, checkpoints. Can be stopped and gone on with."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.average import Average
from fieldfuse.nerfusion.training.caution import MOST, Caution, where_not_finite
from fieldfuse.nerfusion.training.checkpoint import checkpoint_settings, checkpoints, load_caution, load_checkpoint, save_checkpoint
from fieldfuse.nerfusion.training.curve import Curve
from fieldfuse.nerfusion.training.distributed import Crew
from fieldfuse.nerfusion.training.gates import GateWatch
from fieldfuse.nerfusion.training.mixture import Mixture
from fieldfuse.nerfusion.training.real import Case, load_cases
from fieldfuse.nerfusion.training.settings import TrainSettings, train_settings_dict
from fieldfuse.nerfusion.training.step import Outcome, Stepper, seeded
from fieldfuse.nerfusion.training.validate import validate
from fieldfuse.nerfusion.weights import SHIPPED, config_from, load_model, save_model
from fieldfuse.progress import SILENT, Progress

WEIGHTS = "weights.safetensors"
BETAS = (0.9, 0.999)


def make_model(settings: TrainSettings) -> NerfusionModel:
    """The networks as the settings ask, started from `start_from` or by chance from `seed`.

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


def learning_rate(settings: TrainSettings, step: int) -> float:
    """Linear warm-up, then half a cosine from the full rate to `final` of it at the last step."""
    asked = settings.optimiser
    if step < asked.warmup:
        return asked.rate * (step + 1) / asked.warmup
    done = (step - asked.warmup) / max(1, settings.total_steps - asked.warmup)
    return asked.rate * (asked.final + (1 - asked.final) * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


def clipped(model: NerfusionModel, most: float) -> float:
    """Scale the gradients down to the norm `most`; answers the norm that they had. Those that are not finite stay as they are: NaN."""
    try:
        return float(torch.nn.utils.clip_grad_norm_(model.parameters(), most, error_if_nonfinite=True))
    except RuntimeError as error:
        if "non-finite" not in str(error):
            raise
        return math.nan


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
        self.adam = torch.optim.Adam(self.model.parameters(), lr=settings.optimiser.rate, betas=BETAS)
        self.average = Average(self.model, settings.optimiser.average, settings.optimiser.start_share)
        self.mixture = Mixture(settings, crew.rank, crew.device)
        self.stepper = Stepper(self.model, settings)
        self.curve = Curve(out)
        self.gates = GateWatch(self.model)
        self.step, self.caution, self.notes = 0, Caution(), list[str]()
        found = checkpoints(out)
        if resume and found:
            self.step = load_checkpoint(found[-1], self.model, self.adam, self.average)
            self.caution = load_caution(found[-1])
            self.curve.load(self.step)
            changed = _changes(checkpoint_settings(found[-1]), train_settings_dict(settings))
            if changed:
                self.notes.append(f"settings are not those of the steps before, and go on as they are now: {', '.join(changed)}")
        elif found and crew.leads:
            raise InputError(f"{out} already holds a training run; go on with it by --resume, or choose another --out folder")
        self.cases: list[Case] = []
        if crew.leads:
            self.cases = [case for folder in settings.record.captures for case in load_cases(folder, settings)]
        self._gathered: list[dict[str, float]] = []

    def run(self, until: int | None = None, progress: Progress = SILENT) -> int:
        """Train up to step `until` (the settings' total by default); answers the steps taken in all.

        A request to stop is honoured after the step at hand; what there is is kept.

        Raises:
            InputError: no finite gradient for many steps (what was learnt before is kept), or the data cannot be read.
            OutputError: results cannot be written.
        """
        last = min(until or self.settings.total_steps, self.settings.total_steps)
        record = self.settings.record
        saved_at, saved_step = time.monotonic(), -1
        while self.step < last:
            row = self.one_step()
            self._gathered.append(row)
            self.step += 1
            if self.step % record.log_every == 0 or self.step == last:
                self._log()
            if self.cases and (self.step % record.validate_every == 0 or self.step == self.settings.total_steps):
                self._validate()
            stop = self.crew.any(progress.stopping())
            due = time.monotonic() - saved_at > 60 * record.checkpoint_minutes
            if self.crew.leads and (due or stop or self.step % record.checkpoint_every == 0 or self.step == last):
                self.save()
                saved_at, saved_step = time.monotonic(), self.step
            progress.update(self.step, last, f"loss {row['loss']:.4f}, {row.get('psnr_local', float('nan')):.1f} dB")
            if stop:
                break
        if self.crew.leads and saved_step != self.step:
            self.save()
        self.crew.wait()
        return self.step

    def one_step(self) -> dict[str, float]:
        """Take one step; answers its row of the learning curve."""
        settings, step = self.settings, self.step
        start = time.monotonic()
        second = step >= settings.stage.steps
        sample = self.mixture.sample(step, settings.pictures.key_frames if second else 1).to(self.crew.device)
        drawn = time.monotonic()
        self.adam.zero_grad(set_to_none=True)
        generator = seeded(settings.seed, self.crew.rank, step)
        # Measured in one step of each row of the curve: it costs another pass through the encoder.
        self.stepper.watched = self.gates.on = (step + 1) % settings.record.log_every == 0
        with torch.autocast(self.crew.device.type, torch.bfloat16, enabled=settings.optimiser.reduced):
            outcome: Outcome = (self.stepper.stage_two if second else self.stepper.stage_one)(sample, step, generator)
        self.gates.on = False  # what is validated in between counts in no row
        self.crew.average_gradients(self.model.parameters())
        norm = clipped(self.model, settings.optimiser.clip)
        rate = learning_rate(settings, step) * self.caution.slower
        # The same on all processes, so that their weights stay equal.
        good = math.isfinite(norm) and not self.crew.any(not math.isfinite(outcome.loss))
        if good:
            for group in self.adam.param_groups:
                group["lr"] = rate
            self.adam.step()
            self.average.update(self.model, step)
            self.caution.well()
        else:
            self._skip(outcome.loss)
        row = {"loss": outcome.loss, "gradient_norm": norm, "rate": rate, "skipped": float(not good)}
        row |= outcome.means() | self.gates.shares()
        row |= {"seconds_data": drawn - start, "seconds": time.monotonic() - start, "voxels": float(sample.resolution)}
        return row

    def _skip(self, loss: float) -> None:
        """One bad sample must not end a run of days; many in a row mean that the settings cannot work."""
        where = where_not_finite(loss, self.model.named_parameters())
        self.caution.bad(f"step {self.step + 1}: {where}")
        if self.caution.gives_up:
            if self.crew.leads:
                self.save()
            raise InputError(
                f"{MOST} steps in a row were not finite, the last at step {self.step + 1} in {where}; the weights of the last good step "
                f"are in {self.out}, lower optimiser.rate and go on from them by start_from"
            )

    def _log(self) -> None:
        rows, self._gathered = self._gathered, []
        names = dict.fromkeys(name for row in rows for name in row)
        mean = {}
        for name in names:
            values = [row[name] for row in rows if name in row and math.isfinite(row[name])]
            if values:
                mean[name] = sum(values) / len(values)
        mean = self.crew.mean(mean)
        stage = 2.0 if self.step > self.settings.stage.steps else 1.0
        self.curve.add({"step": float(self.step), "stage": stage, "depth_weight": self.stepper.depth_weight(self.step), **mean})
        if self.crew.leads and self.step % self.settings.record.health_every == 0:
            self.curve.write()

    def _validate(self) -> None:
        sheet = self.out / f"validation-{self.step:07d}.png"
        levels = self.settings.stage.levels if self.step > self.settings.stage.steps else 1
        witnesses = self.settings.stage.witnesses
        with self.average.applied(self.model):
            numbers, each = validate(self.model, self.cases, self.crew.device, sheet, self.stepper.prunes(self.step), levels, witnesses)
        for name, values in each.items():
            numbers |= {f"{key} {name}": value for key, value in values.items()}
        self.curve.add({"step": float(self.step), **numbers})
        self.curve.write()

    def save(self) -> None:
        """Write the curve, a checkpoint and the weights so far.

        The curve goes first: whoever goes on from the checkpoint before cuts what it has too much, and what it lacks is lost.

        Raises:
            OutputError: the folder is not writable.
        """
        self.curve.write()
        save_checkpoint(
            self.out,
            self.step,
            self.model,
            self.adam,
            train_settings_dict(self.settings),
            self.settings.record.keep,
            self.caution,
            self.average,
        )
        with self.average.applied(self.model):
            save_model(self.out / WEIGHTS, self.model, {"steps": self.step})
