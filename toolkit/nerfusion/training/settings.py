"""Settings of a training run: typed defaults, and YAML files that hold only what differs from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from fieldfuse.config import NotNegative, Positive, PositiveNumber, Share, checked, flat, one_of, put, read_yaml
from fieldfuse.errors import InputError, brief

LEAST_SIDE = 16  # pixels; sides are rounded to multiples of 8, and less than one would be no image
KINDS = ("procedural", "shards", "scannet", "dtu", "scanned_objects", "synthetic")
Bounds = Annotated[list[float], Field(min_length=2, max_length=2)]
Part = Annotated[float, Field(ge=0, lt=1)]


@dataclass
class SourceSettings:
    """One source of training scenes and how often it is drawn."""

    kind: Annotated[str, one_of(*KINDS)] = "procedural"
    weight: Share = 1.0
    path: str | None = None  # folder of a data set; not for procedural scenes
    scene: str = "any"  # procedural scenes: object | room | any


@dataclass
class PictureSettings:
    """Pictures of a sample; each range is drawn from once a sample."""

    long_side: Annotated[list[int], Field(min_length=2, max_length=2)] = default(default_factory=lambda: [96, 160])  # pixels
    views: Positive = 3  # K: the images behind one local volume
    key_frames: Positive = 3  # key frames fused in stage 2
    targets: Positive = 2  # images rendered for the loss
    frames: int = 24  # images along a procedural path (only those that are used are drawn)


@dataclass
class VolumeSettings:
    """Where the lattice of a sample lies and how fine it is; ranges are drawn from once a sample."""

    voxels_to_median: Bounds = default(default_factory=lambda: [20.0, 36.0])  # voxels that make up the median depth
    region: Bounds = default(default_factory=lambda: [0.4, 0.95])  # share of the surfaces inside the region of interest
    closed: float = 0.3  # chance of a bare box around everything instead
    most: int = 96  # voxels along the side of the lattice at most


@dataclass
class LossSettings:
    rays: Positive = 1024  # a step, over all targets
    opacity: float = 0.02  # weight of (1 − opacity)² where the truth is opaque
    local: float = 1.0  # weights of the two losses of stage 2
    fused: float = 1.0
    depth: float = 0.2  # auxiliary −log likelihood of the true depth, at the start
    depth_steps: int = 2000  # steps over which it falls to zero


@dataclass
class StageSettings:
    steps: NotNegative = 4000  # of stage 1, then of stage 2
    fused_steps: NotNegative = 2000
    truncate: Positive = 3  # stage 2: key frames between two cuts of the gradient through the recurrent state
    levels: Positive = 2  # stage 2: lattices, each of half the voxel size of the one before (1: the paper's single one)
    gamma: float = 0.95  # coarse cells in which exp(−optical thickness) exceeds this are not looked at finer
    most_split: Positive = 6000  # coarse cells that are looked at finer, a key frame at most
    prune_from: float = 0.5  # share of stage 2 after which the fused volume is pruned
    witnesses: bool = False  # stage 2 and validation: key frames of a sample are checked against each other, as in direct inference


@dataclass
class OptimiserSettings:
    rate: Annotated[float, Field(gt=0, lt=1)] = 3e-3  # Adam, as in the paper
    warmup: int = 100  # steps
    final: float = 0.05  # share of the rate at the end; cosine in between
    clip: PositiveNumber = 1.0  # largest norm of the gradient
    average: Part = 0.0  # weights that are validated and shipped: the average along the run, of about 1 / (1 − this) steps; 0: the newest
    start_share: Part = 0.0  # share in them of the weights before the first step
    reduced: bool = False  # bfloat16 autocast


@dataclass
class RecordSettings:
    log_every: Positive = 20
    health_every: Positive = 100
    checkpoint_minutes: float = 5.0
    checkpoint_every: Positive = 500
    validate_every: Positive = 500
    keep: Positive = 2  # checkpoints
    captures: list[str] = default(default_factory=list)  # folders of real captures to validate on; never trained on
    validation_views: int = 6  # held-out images a capture
    validation_side: int = 128  # pixels


@dataclass
class TrainSettings:
    """All settings of a training run."""

    seed: int = 0
    device: str = "auto"
    threads: int | None = None
    reuse: Positive = 4  # steps that one scene serves
    window: Positive = 8  # scenes that take turns
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
    where, given = str(path or "the training settings"), asdict(TrainSettings())
    try:
        text = "" if path is None else Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the training settings {path}: {getattr(error, 'strerror', None) or error}") from error
    for layer in (read_yaml(text, where), data or {}):
        for name, value in flat(layer).items():
            put(given, name, value)
    for pair in pairs:
        name, separator, value = pair.partition("=")
        if not separator:
            raise InputError(f"--set {brief(repr(pair))} is not key=value")
        put(given, name.strip(), read_yaml(f"value: {value}", f"--set {brief(repr(pair))}")["value"])
    settings = checked(TrainSettings, given, where)
    _check(settings)
    return settings


def _check(settings: TrainSettings) -> None:
    for source in settings.sources:
        if source.kind != "procedural" and not source.path:
            raise InputError(f"training data of kind {source.kind!r} need a path to their folder")
    if not any(source.weight > 0 for source in settings.sources):
        raise InputError("no source of training data has a weight above 0; give at least one")
    for name, pair in (
        ("pictures.long_side", settings.pictures.long_side),
        ("volume.voxels_to_median", settings.volume.voxels_to_median),
        ("volume.region", settings.volume.region),
    ):
        if not 0 < pair[0] <= pair[1]:
            raise InputError(f"{name} is {list(pair)}; it must be a lower and an upper bound, both positive")
    if settings.pictures.long_side[0] < LEAST_SIDE:
        raise InputError(f"pictures.long_side begins at {settings.pictures.long_side[0]} pixels; at least {LEAST_SIDE} are needed")
    if settings.total_steps < 1:
        raise InputError("stage.steps and stage.fused_steps are both 0; at least one step is needed")
