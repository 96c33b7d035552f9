"""Settings of a training run: typed defaults, and YAML files that hold only what differs from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from dataclasses import field as default
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from fieldfuse.config import refuse_traps
from fieldfuse.errors import InputError, brief, first_line

LEAST_SIDE = 16  # pixels; sides are rounded to multiples of 8, and less than one would be no picture
KINDS = ("procedural", "shards", "scannet", "dtu", "scanned_objects", "synthetic")


@dataclass
class SourceSettings:
    """One source of training scenes and how often it is drawn."""

    kind: str = "procedural"
    weight: float = 1.0
    path: str | None = None  # folder of a data set; not for procedural scenes
    scene: str = "any"  # procedural scenes: object | room | any


@dataclass
class PictureSettings:
    """Pictures of a sample; each range is drawn from once a sample."""

    long_side: list[int] = default(default_factory=lambda: [96, 160])  # pixels
    views: int = 3  # K: the pictures behind one local volume
    key_frames: int = 3  # key frames fused in stage 2
    targets: int = 2  # pictures rendered for the loss
    frames: int = 24  # pictures along a procedural path (only those that are used are drawn)


@dataclass
class VolumeSettings:
    """Where the lattice of a sample lies and how fine it is; ranges are drawn from once a sample."""

    voxels_to_median: list[float] = default(default_factory=lambda: [20.0, 36.0])  # voxels that make up the median depth
    region: list[float] = default(default_factory=lambda: [0.4, 0.95])  # share of the surfaces inside the region of interest
    closed: float = 0.3  # chance of a bare box around everything instead
    most: int = 96  # voxels along the side of the lattice at most


@dataclass
class LossSettings:
    rays: int = 1024  # a step, over all targets
    opacity: float = 0.02  # weight of (1 − opacity)² where the truth is opaque
    local: float = 1.0  # weights of the two losses of stage 2
    fused: float = 1.0
    depth: float = 0.2  # auxiliary −log likelihood of the true depth, at the start
    depth_steps: int = 2000  # steps over which it falls to zero


@dataclass
class StageSettings:
    steps: int = 4000  # of stage 1, then of stage 2
    fused_steps: int = 2000
    truncate: int = 3  # stage 2: key frames between two cuts of the gradient through the recurrent state
    levels: int = 2  # stage 2: lattices, each of half the voxel size of the one before (1: the paper's single one)
    gamma: float = 0.95  # coarse cells in which exp(−optical thickness) exceeds this are not looked at finer
    most_split: int = 6000  # coarse cells that are looked at finer, a key frame at most
    prune_from: float = 0.5  # share of stage 2 after which the fused volume is pruned
    witnesses: bool = False  # stage 2 and validation: key frames of a sample are each other's witnesses, as in direct inference


@dataclass
class OptimiserSettings:
    rate: float = 3e-3  # Adam, as in the paper
    warmup: int = 100  # steps
    final: float = 0.05  # share of the rate at the end; cosine in between
    clip: float = 1.0  # largest norm of the gradient
    average: float = 0.0  # weights that are validated and shipped: the average along the run, of about 1 / (1 − this) steps; 0: the newest
    start_share: float = 0.0  # share in them of the weights before the first step
    reduced: bool = False  # bfloat16 autocast


@dataclass
class RecordSettings:
    log_every: int = 20
    health_every: int = 100
    checkpoint_minutes: float = 5.0
    checkpoint_every: int = 500
    validate_every: int = 500
    keep: int = 2  # checkpoints
    captures: list[str] = default(default_factory=list)  # folders of real captures to validate on; never trained on
    validation_views: int = 6  # held-out pictures a capture
    validation_side: int = 128  # pixels


@dataclass
class TrainSettings:
    """Everything that a training run can be told."""

    seed: int = 0
    device: str = "auto"
    threads: int | None = None
    reuse: int = 4  # steps that one scene serves
    window: int = 8  # scenes that take turns
    start_from: str | None = None  # weights (safetensors) to start from; shipped: those that come with the toolkit
    pretrained: bool = False  # ImageNet start of the encoder; wants model: {encoder: lite0} and the package that holds the weights
    model: dict[str, Any] = default(default_factory=dict)  # what differs from the networks' own defaults
    sources: list[SourceSettings] = default(default_factory=lambda: [SourceSettings()])
    pictures: PictureSettings = default(default_factory=PictureSettings)
    volume: VolumeSettings = default(default_factory=VolumeSettings)
    loss: LossSettings = default(default_factory=LossSettings)
    stage: StageSettings = default(default_factory=StageSettings)
    optimiser: OptimiserSettings = default(default_factory=OptimiserSettings)
    record: RecordSettings = default(default_factory=RecordSettings)

    @property
    def total_steps(self) -> int:
        return self.stage.steps + self.stage.fused_steps


def load_train_settings(
    path: Path | str | None = None, data: dict[str, Any] | None = None, pairs: Sequence[str] = ()
) -> TrainSettings:
    """Defaults, then the YAML file, then `data`, then `pairs` (key=value).

    Raises:
        InputError: the file cannot be read, a key is not known, or a value does not fit.
    """
    config = OmegaConf.structured(TrainSettings)
    try:
        if path is not None:
            text = Path(path).read_text(encoding="utf-8")
            refuse_traps(text, str(path))
            config = OmegaConf.merge(config, OmegaConf.create(text))
        if data is not None:
            config = OmegaConf.merge(config, OmegaConf.create(data))
        for pair in pairs:
            if "=" not in pair:
                raise InputError(f"--set {brief(repr(pair))} is not key=value")
            config = OmegaConf.merge(config, OmegaConf.from_dotlist([pair]))
        settings = OmegaConf.to_object(config)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the training settings {path}: {getattr(error, 'strerror', None) or error}") from error
    except InputError:
        raise
    except (OmegaConfBaseException, ValueError, TypeError) as error:
        raise InputError(f"{path or 'the training settings'}: {first_line(error)}; see docs/training.md") from error
    except Exception as error:  # the YAML parser raises its own family
        raise InputError(f"{path or 'the training settings'} is not valid YAML: {first_line(error)}") from error
    assert isinstance(settings, TrainSettings)
    _check(settings)
    return settings


def _check(settings: TrainSettings) -> None:
    for source in settings.sources:
        if source.kind not in KINDS:
            raise InputError(f"there is no kind of training data {source.kind!r}; known are {', '.join(KINDS)}")
        if source.kind != "procedural" and not source.path:
            raise InputError(f"training data of kind {source.kind!r} need a path to their folder")
        if not source.weight >= 0:
            raise InputError(f"the weight of {source.kind!r} is {source.weight}; it must be 0 or more")
    if not any(source.weight > 0 for source in settings.sources):
        raise InputError("no source of training data has a weight above 0; give at least one")
    for name, pair in (
        ("pictures.long_side", settings.pictures.long_side),
        ("volume.voxels_to_median", settings.volume.voxels_to_median),
        ("volume.region", settings.volume.region),
    ):
        if len(pair) != 2 or not 0 < pair[0] <= pair[1]:
            raise InputError(f"{name} is {list(pair)}; it must be a lower and an upper bound, both positive")
    least = {
        "pictures.views": settings.pictures.views,
        "pictures.key_frames": settings.pictures.key_frames,
        "pictures.targets": settings.pictures.targets,
        "loss.rays": settings.loss.rays,
        "stage.truncate": settings.stage.truncate,
        "stage.levels": settings.stage.levels,
        "stage.most_split": settings.stage.most_split,
        "reuse": settings.reuse,
        "window": settings.window,
        "total steps": settings.total_steps,
        "record.log_every": settings.record.log_every,
        "record.health_every": settings.record.health_every,
        "record.checkpoint_every": settings.record.checkpoint_every,
        "record.validate_every": settings.record.validate_every,
        "record.keep": settings.record.keep,
    }
    for name, value in least.items():
        if value < 1:
            raise InputError(f"{name} is {value}; it must be at least 1")
    if settings.pictures.long_side[0] < LEAST_SIDE:
        raise InputError(f"pictures.long_side begins at {settings.pictures.long_side[0]} pixels; at least {LEAST_SIDE} are needed")
    for name, steps in (("steps", settings.stage.steps), ("fused_steps", settings.stage.fused_steps)):
        if steps < 0:
            raise InputError(f"stage.{name} is {steps}; it must be 0 or more")
    if not 0 < settings.optimiser.rate < 1 or not settings.optimiser.clip > 0:
        raise InputError("optimiser.rate must lie between 0 and 1, and optimiser.clip above 0")
    for name, share in (("average", settings.optimiser.average), ("start_share", settings.optimiser.start_share)):
        if not 0 <= share < 1:
            raise InputError(f"optimiser.{name} is {share}; it must be 0 or more, and less than 1")


def train_settings_dict(settings: TrainSettings) -> dict[str, Any]:
    """Plain data of all settings, kept in checkpoints."""
    data = OmegaConf.to_container(OmegaConf.structured(settings))
    assert isinstance(data, dict) and len(data) == len(fields(TrainSettings))
    return {str(key): value for key, value in data.items()}
