"""Settings: typed dataclasses with defaults, YAML files and `key=value` pairs merged over them by OmegaConf.

Only what differs from these defaults stands in `configs/*.yaml`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from dataclasses import field as default
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from fieldfuse.errors import InputError, brief, first_line

MAX_YAML = 2**18  # characters
MAX_NESTING = 16


@dataclass
class CaptureSettings:
    image_size: int | None = None  # long side in pixels; None: 640, or the picture's own when smaller
    holdout: int = 8  # every n-th frame by name is a test view; 0: none (the source's own split wins)
    max_frames: int = 150  # frames taken from a video
    masks: str = "auto"  # auto: black is left out | inverted: white is | off: masks beside the images are not used


@dataclass
class PosesSettings:
    source: str = "auto"  # auto | given | sfm: `sfm` ignores poses that the capture brings
    # Of poses that the capture brings. auto: held against the images; what is read wrongly is corrected, what is wrong is left out or
    # refused | as_is: kept as they came, with a warning where they do not fit
    convention: str = "auto"
    matching: str = "auto"  # auto | exhaustive | sequential
    image_size: int = 1600  # long side for feature extraction
    max_features: int = 4096
    features: str = "auto"  # auto (SIFT, and XFeat where SIFT places too few) | sift | xfeat (learned; needs its weights)


@dataclass
class ViewsSettings:
    limit: int | None = None  # this many evenly spread training views; held-out views stay the same; None: all


@dataclass
class KeyframesSettings:
    method: str = "parallax"  # parallax (with overlap and sharpness) | uniform: every n-th training view, as in the paper
    every: int = 10  # n of `uniform`
    most: int = 24  # key frames that the networks fuse at most


@dataclass
class NetworkSettings:
    weights: str | None = None  # file of trained networks; None: the shipped ones
    voxels: float | None = None  # finest ones to the median depth; None: 48, or more: a voxel to some pixels there
    levels: int = 2  # lattices, each of half the voxel size of the one before; 1: the paper's single one
    gamma: float = 0.95  # voxels with exp(−optical thickness) above it are pruned; the paper's 0.6 cuts holes where networks are in doubt
    depth_from: str = "sensor"  # sensor (if the capture has one; the paper has none) | off
    agreement: bool = True  # key frames' plane sweeps are held against each other, but where there is alpha (not in the paper)
    recolour: bool = True  # colours of the result are looked up again in the training pictures, on finer lattices (not in the paper)
    precision: str = "auto"  # of the networks' arithmetic: auto (bfloat16 where the processor multiplies it) | float32 | bfloat16


WIDTHS = {"deferred": 96, "per_sample": 64}  # a ray is decoded once, or at every sample


@dataclass
class FieldSettings:
    channels: int = 16  # features a voxel
    decoder: str = "deferred"  # deferred | per_sample (the paper's)
    hidden: int | None = None  # width of the decoder; None: 96, of the paper's 64
    # Of the direction, what the decoder sees: auto (by the evidence of the effects stage) | full (third order) | low (first order) | none
    view: str = "auto"
    background: str = "auto"  # auto | on | off: contract what lies outside the region of interest
    resolution: int | None = None  # voxels along the longest side of the volume; None: by preset and picture size
    init: str = "auto"  # auto (network: few training views) | network | classical
    start_resolution: int = 32  # voxels a side at which the networks' field enters a fit: what few images tell is smooth first

    @property
    def width(self) -> int:
        """Hidden units of a layer of the decoder."""
        return self.hidden or WIDTHS[self.decoder]


@dataclass
class FitSettings:
    finetune: bool = True  # False: the networks' field is the result, nothing is fitted
    budget: float | None = None  # seconds; None: by preset
    iterations: int | None = None  # at most; None: as many as the budget has (the paper: 25,000)
    split_every: int | None = None  # iterations from one prune-and-split to the next (the paper: 10,000); None: as the validation views say
    max_rays: int = 4096  # rays a step at most, which the fifth level reaches; many small steps beat few large ones
    rate_density: float = 0.15
    rate_feature: float = 0.05
    rate_decoder: float = 5e-3
    distortion: float = 0.015  # weight of the distortion loss
    opacity: float = 0.05  # weight of (1 - opacity)² where every ray must end somewhere (captures without alpha)
    slow_within: float = 0.5  # median depths; what is nearer to a camera moves slowly, so that nothing grows right before it; 0: off
    depth: float = 0.03  # weight of the depth term where the depth of a picture is known (quickly matched: twice as much); 0: colours alone
    # Where depth comes from. auto: a sensor, or without one quick matching of the pictures in a share of the fit's seconds | any: a sensor,
    # or without one matching in full, which takes time of its own | sensor | off
    depth_from: str = "auto"
    # Training pictures' pixels that show something else than several others agree on (people who pass, one's own shadow). auto: left out
    # where depth is known and alpha cuts nothing out | off
    moving: str = "auto"
    patience: bool = False  # end before the budget when the validation views stop improving
    passes: float | None = 50.0  # over the pixels, where there are too few views to keep some aside for validation; None: the whole budget
    # On coarse lattices colours of training pictures are means over a Gaussian of so many times a voxel of theirs (in pixels, where a voxel
    # of the finest lattice is one): what voxels cannot show is not asked of them. With few views, and 0: colours as they are
    soften: float = 0.25
    prune_weight: float = 0.05  # voxels whose largest seen weight stays below are removed


@dataclass
class TsdfSettings:
    enabled: str = "auto"  # auto (when the capture has depth) | on | off
    voxel_size: float | None = None  # working units; None: from the capture's depth
    depth_max: float | None = None  # working units; None: from the capture's depth


# Files for other programs: "texture" is a mesh with one (textured.glb), "page" the field itself for any browser (field.html), the others
# are named as they end, or as what they hold.
EXPORTS = ("points", "ply", "obj", "glb", "texture", "page", "cameras", "video")


@dataclass
class ExportSettings:
    formats: list[str] = default(default_factory=lambda: list(EXPORTS))
    mesh_views: int = 60  # views whose rendered depth is fused into the mesh
    mesh_size: int = 640  # long side in pixels, at most, of that depth, and of the pictures, as they were taken, that it is polished by
    smooth: int = 2  # rounds in which vertices of meshes, a TSDF's too, go to the mean of their neighbours; 0: never
    texture_size: int = 1280  # long side in pixels, at most, of the pictures that a texture is made of
    video_frames: int = 90


@dataclass
class EffectsSettings:
    mode: str = "auto"  # auto: correct what the evidence shows | off: look for nothing
    on: list[str] = default(default_factory=list)  # effects to correct whatever the evidence says
    off: list[str] = default(default_factory=list)  # effects to leave as they are


@dataclass
class Settings:
    """Everything that a run can be told. `budget`, `image_size` and friends of the command line land here too."""

    preset: str = "balanced"
    engine: str = "auto"  # auto (numba on the CPU, triton on CUDA) | numba | triton | torch
    device: str = "auto"
    threads: int | None = None  # None: all cores
    seed: int = 0
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
CHOICES = {
    "preset": ("fast", "balanced", "quality", "paper"),
    "engine": ("auto", "numba", "triton", "torch"),
    "device": ("auto", "cpu", "cuda"),
    "capture.masks": ("auto", "inverted", "off"),
    "poses.source": ("auto", "given", "sfm"),
    "poses.convention": ("auto", "as_is"),
    "poses.matching": ("auto", "exhaustive", "sequential"),
    "poses.features": ("auto", "sift", "xfeat"),
    "field.decoder": ("deferred", "per_sample"),
    "network.depth_from": ("sensor", "off"),
    "network.precision": ("auto", "float32", "bfloat16"),
    "fit.depth_from": ("auto", "any", "sensor", "off"),
    "fit.moving": ("auto", "off"),
    "field.background": ("auto", "on", "off"),
    "field.view": ("auto", "full", "low", "none"),
    "field.init": ("auto", "network", "classical"),
    "keyframes.method": ("parallax", "uniform"),
    "tsdf.enabled": ("auto", "on", "off"),
    "effects.mode": ("auto", "off"),
}


def _keys(node: DictConfig, prefix: str = "") -> list[str]:
    out = []
    for key, value in node.items():
        name = f"{prefix}{key!s}"
        out += _keys(value, f"{name}.") if isinstance(value, DictConfig) else [name]
    return out


def _set(config: DictConfig, known: list[str], key: str, value: Any, where: str) -> None:
    full = SHORT_NAMES.get(key, key)
    if full not in known:
        near = difflib.get_close_matches(key, known + list(SHORT_NAMES), n=1, cutoff=0.3)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(f"{where}: there is no setting {brief(repr(key))}{hint}")
    if isinstance(value, bool) and "off" in CHOICES.get(full, ()):
        value = "on" if value else "off"  # YAML reads a bare on and off as true and false
    try:
        OmegaConf.update(config, full, value)
    except (OmegaConfBaseException, ValueError, OverflowError) as error:
        raise InputError(f"{where}: {brief(repr(value))} does not fit the setting {key!r} ({first_line(error)})") from error


def _flatten(data: Any, where: str, prefix: str = "") -> list[tuple[str, Any]]:
    if not isinstance(data, dict):
        raise InputError(f"{where}: settings must be `key: value` pairs")
    pairs: list[tuple[str, Any]] = []
    for key, value in data.items():
        key = {True: "on", False: "off"}[key] if isinstance(key, bool) else key  # YAML reads a bare on and off as true and false
        name = f"{prefix}{key}"
        pairs += _flatten(value, where, f"{name}.") if isinstance(value, dict) else [(name, value)]
    return pairs


def _read_yaml(text: str, where: str) -> list[tuple[str, Any]]:
    try:
        refuse_traps(text, where)
        data = OmegaConf.to_container(OmegaConf.create(text or "{}"), resolve=False)
    except InputError:
        raise
    except Exception as error:  # the YAML parser raises its own family
        raise InputError(f"{where} is not valid YAML: {first_line(error)}") from error
    return _flatten(data, where)


def refuse_traps(text: str, where: str) -> None:
    """Look at YAML that may come from anybody before a parser does, for what breaks the parser itself.

    That is nesting (it recurses in C and takes the process with it) and aliases that multiply. Call it where errors of the parser are
    caught: this one raises them too.

    Raises:
        InputError: too long, nested too deeply, or with aliases.
    """
    if len(text) > MAX_YAML:
        raise InputError(f"{where} holds {len(text)} characters, more than the {MAX_YAML} that settings may have")
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):  # one event after the other, without recursion
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{where} refers to the anchor {event.anchor[:40]!r}, which settings cannot; write the value out")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_NESTING:
            raise InputError(f"{where} is nested more than {MAX_NESTING} levels deep; settings are `group: {{key: value}}`")


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
    if preset not in CHOICES["preset"]:
        raise InputError(f"there is no preset {preset!r}; known are {', '.join(CHOICES['preset'])}")
    config: DictConfig = OmegaConf.structured(Settings)
    source = resources.files("fieldfuse.configs").joinpath(f"{preset}.yaml")
    layers = [(f"configs/{preset}.yaml", _read_yaml(source.read_text(encoding="utf-8"), f"configs/{preset}.yaml"))]
    if stored is not None:
        layers.append(("run.json", _flatten(stored, "run.json")))
    if file is not None:
        try:
            layers.append((str(file), _read_yaml(Path(file).read_text(encoding="utf-8"), str(file))))
        except OSError as error:
            raise InputError(f"cannot read the settings file {file}: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise InputError(f"the settings file {file} is not text in UTF-8; check how it was written") from error
    for pair in pairs or []:
        key, separator, value = pair.partition("=")
        if not separator:
            raise InputError(f"--set {pair!r} must have the form key=value")
        layers.append(("--set", [(key.strip(), _read_yaml(f"value: {value}", f"--set {pair!r}")[0][1])]))
    layers.append(("command line", [(key, value) for key, value in (flags or {}).items() if value is not None]))
    known = _keys(config)
    for where, entries in layers:
        for key, value in entries:
            _set(config, known, key, value, where)
    config.preset = preset
    for key, choices in CHOICES.items():
        value = OmegaConf.select(config, key)
        if value not in choices:
            near = difflib.get_close_matches(str(value), choices, n=1)
            raise InputError(
                f"{key} is {brief(repr(value))}; it must be one of {', '.join(choices)}" + (f" (did you mean {near[0]!r}?)" if near else "")
            )
    try:
        settings = OmegaConf.to_object(config)
    except OmegaConfBaseException as error:  # what "${…}" stands for is looked up now
        raise InputError(f"a setting refers to what is not there, or does not fit: {first_line(error)}") from error
    assert isinstance(settings, Settings)
    _check_ranges(settings)
    return settings


def _numbers(part: Any, of: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of the settings with their full names."""
    for one in fields(part):
        name, value = of + one.name, getattr(part, one.name)
        if is_dataclass(value):
            yield from _numbers(value, f"{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield name, value


def require_formats(names: Iterable[str], where: str = "export.formats") -> None:
    """Refuse what is no export.

    Raises:
        InputError: naming the nearest one.
    """
    _check_names(where, names, "format", EXPORTS)


def _check_names(where: str, names: Iterable[str], kind: str, known: tuple[str, ...]) -> None:
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise InputError(f"{where}: there is no {kind} {brief(repr(name))}{hint}; known are {', '.join(known)}")


def _check_ranges(settings: Settings) -> None:
    positive = {
        "capture.image_size": settings.capture.image_size,
        "fit.budget": settings.fit.budget,
        "fit.passes": settings.fit.passes,
        "fit.iterations": settings.fit.iterations,
        "fit.split_every": settings.fit.split_every,
        "fit.max_rays": settings.fit.max_rays,
        "poses.image_size": settings.poses.image_size,
        "poses.max_features": settings.poses.max_features,
        "threads": settings.threads,
        "field.channels": settings.field.channels,
        "field.hidden": settings.field.hidden,
        "field.resolution": settings.field.resolution,
        "field.start_resolution": settings.field.start_resolution,
        "capture.max_frames": settings.capture.max_frames,
        "tsdf.voxel_size": settings.tsdf.voxel_size,
        "tsdf.depth_max": settings.tsdf.depth_max,
        "views.limit": settings.views.limit,
        "export.texture_size": settings.export.texture_size,
        "export.mesh_size": settings.export.mesh_size,
        "keyframes.every": settings.keyframes.every,
        "keyframes.most": settings.keyframes.most,
        "network.voxels": settings.network.voxels,
    }
    for name, value in positive.items():
        if value is not None and not 0 < value < 1e9:
            raise InputError(f"{name} is {value:g}; it must be a positive number")
    for name, number in _numbers(settings):
        if not 0 <= number < 2**63:
            raise InputError(f"{name} is {brief(str(number))}; it must be a number, and not below 0")
    _check_names("effects.on", settings.effects.on, "effect", EFFECTS)
    _check_names("effects.off", settings.effects.off, "effect", EFFECTS)
    require_formats(settings.export.formats)
    both = sorted(set(settings.effects.on) & set(settings.effects.off))
    if both:
        raise InputError(f"effects.on and effects.off both name {both[0]!r}; it can be in one of them")
    if settings.capture.holdout < 0 or settings.capture.holdout == 1:
        raise InputError(f"holdout is {settings.capture.holdout}; it must be 0 (no test views) or at least 2")
    if not 0 <= settings.export.smooth <= 100:
        raise InputError(f"export.smooth is {settings.export.smooth}; it must lie between 0 and 100")
    if settings.seed >= 2**31:
        raise InputError(f"seed is {brief(str(settings.seed))}; it must be less than {2**31}")
    if settings.field.channels < 3:
        raise InputError(f"field.channels is {settings.field.channels}; at least 3 are needed, since the first three stand for a colour")
    if not 0 < settings.network.gamma < 1:
        raise InputError(f"network.gamma is {settings.network.gamma:g}; it must lie between 0 and 1")
    if not 1 <= settings.network.levels <= 4:
        raise InputError(f"network.levels is {settings.network.levels}; it must lie between 1 and 4")
    if settings.capture.image_size is not None and settings.capture.image_size < 16:
        raise InputError(f"image_size is {settings.capture.image_size}; at least 16 pixels are needed")


def settings_dict(settings: Settings) -> dict[str, Any]:
    """Plain data of all settings, for stage keys and reports."""
    data = OmegaConf.to_container(OmegaConf.structured(settings))
    assert isinstance(data, dict)
    return {str(key): value for key, value in data.items()}
