"""Settings: typed dataclasses with defaults; YAML files and `key=value` pairs are merged over them and checked (`fieldfuse.checked`).

Only what differs from these defaults stands in `configs/*.yaml`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from dataclasses import field as default
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from fieldfuse.checked import (
    NotNegative,
    Positive,
    PositiveNumber,
    Share,
    all_names,
    checked,
    flat,
    names_of,
    nearest,
    one_of,
    put,
    read_yaml,
    unknown,
)
from fieldfuse.errors import InputError, brief

PRESETS = ("fast", "balanced", "quality", "paper")
ENGINES = ("auto", "numba", "triton", "torch")
EFFECTS = (
    "exposure",
    "vignetting",
    "distortion",
    "rolling_shutter",
    "view_dependence",
    "background",
    "motion_blur",
    "poses",
    "depth_offset",
)
EffectNames = Annotated[list[str], names_of("effect", EFFECTS)]


@dataclass
class CaptureSettings:
    image_size: Annotated[int, Field(ge=16, lt=10**9)] | None = None  # long side in pixels; None: 640, or the picture's own when smaller
    holdout: NotNegative = 8  # every n-th frame by name is a test view; 0: none (the source's own split wins)
    max_frames: Positive = 150  # frames taken from a video
    # auto: black is left out | inverted: white is | off: masks beside the images are not used
    masks: Annotated[str, one_of("auto", "inverted", "off")] = "auto"


@dataclass
class PosesSettings:
    source: Annotated[str, one_of("auto", "given", "sfm")] = "auto"  # auto | given | sfm: `sfm` ignores poses that the capture brings
    # Of poses that the capture brings. auto: held against the images; what is read wrongly is corrected, what is wrong is left out or
    # refused | as_is: kept as they came, with a warning where they do not fit
    convention: Annotated[str, one_of("auto", "as_is")] = "auto"
    matching: Annotated[str, one_of("auto", "exhaustive", "sequential")] = "auto"  # auto | exhaustive | sequential
    image_size: Positive = 1600  # long side for feature extraction
    max_features: Positive = 4096
    # auto (SIFT, and XFeat where SIFT places too few) | sift | xfeat (learned; needs its weights)
    features: Annotated[str, one_of("auto", "sift", "xfeat")] = "auto"


@dataclass
class ViewsSettings:
    limit: Positive | None = None  # this many evenly spread training views; held-out views stay the same; None: all


@dataclass
class KeyframesSettings:
    # parallax (with overlap and sharpness) | uniform: every n-th training view, as in the paper
    method: Annotated[str, one_of("parallax", "uniform")] = "parallax"
    every: Positive = 10  # n of `uniform`
    most: Positive = 24  # key frames that the networks fuse at most


@dataclass
class NetworkSettings:
    weights: str | None = None  # file of trained networks; None: the shipped ones
    voxels: PositiveNumber | None = None  # finest ones to the median depth; None: 48, or more: a voxel to some pixels there
    levels: Annotated[int, Field(ge=1, le=4)] = 2  # lattices, each of half the voxel size of the one before; 1: the paper's single one
    # Voxels with exp(−optical thickness) above it are pruned; the paper's 0.6 cuts holes where networks are in doubt
    gamma: Annotated[float, Field(gt=0, lt=1)] = 0.95
    depth_from: Annotated[str, one_of("sensor", "off")] = "sensor"  # sensor (if the capture has one; the paper has none) | off
    agreement: bool = True  # key frames' plane sweeps are held against each other, but where there is alpha (not in the paper)
    recolour: bool = True  # colours of the result are looked up again in the training pictures, on finer lattices (not in the paper)
    # Of the networks' arithmetic: auto (bfloat16 where the processor multiplies it) | float32 | bfloat16
    precision: Annotated[str, one_of("auto", "float32", "bfloat16")] = "auto"


WIDTHS = {"deferred": 96, "per_sample": 64}  # a ray is decoded once, or at every sample


@dataclass
class FieldSettings:
    channels: Annotated[int, Field(ge=3, lt=10**9)] = 16  # features a voxel
    decoder: Annotated[str, one_of("deferred", "per_sample")] = "deferred"  # deferred | per_sample (the paper's)
    hidden: Positive | None = None  # width of the decoder; None: 96, of the paper's 64
    # Of the direction, what the decoder sees: auto (by the evidence of the effects stage) | full (third order) | low (first order) | none
    view: Annotated[str, one_of("auto", "full", "low", "none")] = "auto"
    background: Annotated[str, one_of("auto", "on", "off")] = "auto"  # auto | on | off: contract what lies outside the region of interest
    resolution: Positive | None = None  # voxels along the longest side of the volume; None: by preset and picture size
    init: Annotated[str, one_of("auto", "network", "classical")] = "auto"  # auto (network: few training views) | network | classical
    start_resolution: Positive = 32  # voxels a side at which the networks' field enters a fit: what few images tell is smooth first

    @property
    def width(self) -> int:
        """Hidden units of a layer of the decoder."""
        return self.hidden or WIDTHS[self.decoder]


@dataclass
class FitSettings:
    finetune: bool = True  # False: the networks' field is the result, nothing is fitted
    budget: PositiveNumber | None = None  # seconds; None: by preset
    iterations: Positive | None = None  # at most; None: as many as the budget has (the paper: 25,000)
    split_every: Positive | None = None  # iterations from one prune-and-split to the next (the paper: 10,000); None: by validation views
    max_rays: Positive = 4096  # rays a step at most, which the fifth level reaches; many small steps beat few large ones
    rate_density: Share = 0.15
    rate_feature: Share = 0.05
    rate_decoder: Share = 5e-3
    distortion: Share = 0.015  # weight of the distortion loss
    opacity: Share = 0.05  # weight of (1 - opacity)² where every ray must end somewhere (captures without alpha)
    slow_within: Share = 0.5  # median depths; what is nearer to a camera moves slowly, so that nothing grows right before it; 0: off
    depth: Share = 0.03  # weight of the depth term where the depth of a picture is known (quickly matched: twice as much); 0: colours alone
    # Where depth comes from. auto: a sensor, or without one quick matching of the pictures in a share of the fit's seconds | any: a sensor,
    # or without one matching in full, which takes time of its own | sensor | off
    depth_from: Annotated[str, one_of("auto", "any", "sensor", "off")] = "auto"
    # Training pictures' pixels that show something else than several others agree on (people who pass, one's own shadow). auto: left out
    # where depth is known and alpha cuts nothing out | off
    moving: Annotated[str, one_of("auto", "off")] = "auto"
    patience: bool = False  # end before the budget when the validation views stop improving
    # Over the pixels, where there are too few views to keep some aside for validation; None: the whole budget
    passes: PositiveNumber | None = 50.0
    # On coarse lattices colours of training pictures are means over a Gaussian of so many times a voxel of theirs (in pixels, where a voxel
    # of the finest lattice is one): what voxels cannot show is not asked of them. With few views, and 0: colours as they are
    soften: Share = 0.25
    prune_weight: Share = 0.05  # voxels whose largest seen weight stays below are removed


@dataclass
class TsdfSettings:
    enabled: Annotated[str, one_of("auto", "on", "off")] = "auto"  # auto (when the capture has depth) | on | off
    voxel_size: PositiveNumber | None = None  # working units; None: from the capture's depth
    depth_max: PositiveNumber | None = None  # working units; None: from the capture's depth


# Files for other programs: "texture" is a mesh with one (textured.glb), "page" the field itself for any browser (field.html), the others
# are named as they end, or as what they hold.
EXPORTS = ("points", "ply", "obj", "glb", "texture", "page", "cameras", "video")


@dataclass
class ExportSettings:
    formats: Annotated[list[str], names_of("format", EXPORTS)] = default(default_factory=lambda: list(EXPORTS))
    mesh_views: NotNegative = 60  # views whose rendered depth is fused into the mesh
    # Long side in pixels, at most, of that depth, and of the pictures, as they were taken, that it is polished by
    mesh_size: Positive = 640
    # Rounds in which vertices of meshes, a TSDF's too, go to the mean of their neighbours; 0: never
    smooth: Annotated[int, Field(ge=0, le=100)] = 2
    texture_size: Positive = 1280  # long side in pixels, at most, of the pictures that a texture is made of
    video_frames: NotNegative = 90


@dataclass
class EffectsSettings:
    mode: Annotated[str, one_of("auto", "off")] = "auto"  # auto: correct what the evidence shows | off: look for nothing
    on: EffectNames = default(default_factory=list)  # effects to correct whatever the evidence says
    off: EffectNames = default(default_factory=list)  # effects to leave as they are


@dataclass
class Settings:
    """Everything that a run can be told. `budget`, `image_size` and friends of the command line land here too."""

    preset: Annotated[str, one_of(*PRESETS)] = "balanced"
    engine: Annotated[str, one_of(*ENGINES)] = "auto"  # auto (numba on the CPU, triton on CUDA) | numba | triton | torch
    device: Annotated[str, one_of("auto", "cpu", "cuda")] = "auto"
    threads: Positive | None = None  # None: all cores
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    capture: CaptureSettings = default(default_factory=CaptureSettings)
    poses: PosesSettings = default(default_factory=PosesSettings)
    views: ViewsSettings = default(default_factory=ViewsSettings)
    keyframes: KeyframesSettings = default(default_factory=KeyframesSettings)
    network: NetworkSettings = default(default_factory=NetworkSettings)
    field: FieldSettings = default(default_factory=FieldSettings)
    fit: FitSettings = default(default_factory=FitSettings)
    tsdf: TsdfSettings = default(default_factory=TsdfSettings)
    export: ExportSettings = default(default_factory=ExportSettings)
    effects: EffectsSettings = default(default_factory=EffectsSettings)


# Flags of the command line that have a home in a group: both names work in --set.
SHORT_NAMES = {
    "effects": "effects.mode",
    "poses": "poses.source",
    "image_size": "capture.image_size",
    "holdout": "capture.holdout",
    "budget": "fit.budget",
    "decoder": "field.decoder",
    "background": "field.background",
    "init": "field.init",
    "finetune": "fit.finetune",
}


def _full(name: str) -> str:
    return SHORT_NAMES.get(name, name)


def load_settings(
    preset: str = "balanced",
    file: Path | None = None,
    pairs: list[str] | None = None,
    flags: dict[str, Any] | None = None,
    stored: dict[str, Any] | None = None,
) -> Settings:
    """Defaults, then the preset's YAML, then `stored` (an earlier run's), then `file`, then `key=value` pairs, then flags if not None.

    Raises:
        InputError: unknown key (with the nearest name), a value that does not fit, an unreadable file.
    """
    wanted = [pair for pair in pairs or [] if pair.startswith("preset=")]
    preset = wanted[-1].split("=", 1)[1] if wanted else preset
    if preset not in PRESETS:
        raise InputError(f"there is no preset {preset!r}; known are {', '.join(PRESETS)}")
    source = resources.files("fieldfuse.configs").joinpath(f"{preset}.yaml")
    layers = [(f"configs/{preset}.yaml", flat(read_yaml(source.read_text(encoding="utf-8"), f"configs/{preset}.yaml")))]
    if stored is not None:
        layers.append(("run.json", flat(stored)))
    if file is not None:
        layers.append((str(file), flat(read_yaml(_text(file), str(file)))))
    for pair in pairs or []:
        key, separator, value = pair.partition("=")
        if not separator:
            raise InputError(f"--set {pair!r} must have the form key=value")
        layers.append(("--set", {key.strip(): read_yaml(f"value: {value}", f"--set {pair!r}")["value"]}))
    layers.append(("command line", {key: value for key, value in (flags or {}).items() if value is not None}))
    known, data = all_names(Settings), asdict(Settings())
    for where, entries in layers:
        for name, value in entries.items():
            if _full(name) not in known:
                raise InputError(f"{where}: {unknown(name, [*known, *SHORT_NAMES])}")
            put(data, _full(name), value)
        data["preset"] = preset
        settings = checked(Settings, data, where)
    both = sorted(set(settings.effects.on) & set(settings.effects.off))
    if both:
        raise InputError(f"effects.on and effects.off both name {both[0]!r}; it can be in one of them")
    if settings.capture.holdout == 1:
        raise InputError(f"holdout is {settings.capture.holdout}; it must be 0 (no test views) or at least 2")
    return settings


def _text(file: Path) -> str:
    try:
        return Path(file).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read the settings file {file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"the settings file {file} is not text in UTF-8; check how it was written") from error


def require_formats(names: Iterable[str], where: str) -> None:
    """Refuse what is no export.

    Raises:
        InputError: naming the nearest one.
    """
    for name in names:
        if name not in EXPORTS:
            raise InputError(
                f"{where}: there is no format {brief(repr(name))}{nearest(name, EXPORTS)}; known are {', '.join(EXPORTS)}"
            )


def settings_dict(settings: Settings) -> dict[str, Any]:
    """Plain data of all settings, for stage keys and reports."""
    return asdict(settings)
