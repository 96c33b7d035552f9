"""Settings: typed dataclasses with defaults; YAML files and `key=value` pairs are merged over them and checked by pydantic.

Only what differs from these defaults stands in `configs/*.yaml`. Settings of simulation and training are read by the same functions.
"""

from __future__ import annotations

import difflib
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from dataclasses import field as default
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from fieldfuse.errors import InputError, brief, first_line
from fieldfuse.measures import parse_marker, parse_scale, stored_per_metre

MAX_YAML = 2**18  # characters
MAX_NESTING = 16
T = TypeVar("T")

Positive = Annotated[int, Field(gt=0, lt=10**9)]
NotNegative = Annotated[int, Field(ge=0, lt=2**63)]
PositiveNumber = Annotated[float, Field(gt=0, lt=1e9, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, lt=2**63, allow_inf_nan=False)]  # any number that is not below 0


def nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """` (did you mean 'x'?)` for the nearest of the known names; empty where none is near."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f" (did you mean {near[0]!r}?)" if near else ""


def one_of(*choices: str) -> BeforeValidator:
    """For `Annotated[str, …]`. YAML reads a bare on and off as true and false; they are what was written where `off` is a choice."""

    def check(value: Any) -> Any:
        if isinstance(value, bool) and "off" in choices:
            value = "on" if value else "off"
        if value not in choices:
            sentence = f"it must be one of {', '.join(choices)}{nearest(str(value), choices)}"
            raise PydanticCustomError("choice", "{sentence}", {"sentence": sentence})
        return value

    return BeforeValidator(check)


def names_of(kind: str, known: tuple[str, ...]) -> BeforeValidator:
    """For a list of names."""

    def check(values: Any) -> Any:
        for value in values if isinstance(values, list) else ():
            if value not in known:
                sentence = f"there is no {kind} {brief(repr(value))}{nearest(str(value), known)}; known are {', '.join(known)}"
                raise PydanticCustomError("name", "{sentence}", {"sentence": sentence})
        return values

    return BeforeValidator(check)


def read_by(parse: Callable[[Any], Any]) -> AfterValidator:
    """For a value that `parse` reads when it is used: what it refuses is refused here."""

    def check(value: Any) -> Any:
        try:
            parse(value)
        except InputError as error:
            raise PydanticCustomError("name", "{sentence}", {"sentence": str(error)}) from error
        return value

    return AfterValidator(check)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def checked(kind: type[T], data: Mapping[str, Any], where: str) -> T:
    """An instance of the dataclass `kind` from plain data. Numbers are not made of text, nor whole ones of fractions.

    Raises:
        InputError: a key that does not exist (with the nearest that does), or a value that does not fit.
    """
    _require_names(kind, data, where)
    try:
        made: T = _adapter(kind).validate_json(json.dumps(data, default=str), strict=True)  # type: ignore[arg-type]
        return made
    except ValidationError as error:
        raise InputError(f"{where}: {_sentence(data, error)}") from error


def _require_names(kind: Any, data: Mapping[str, Any], where: str, prefix: str = "") -> None:
    groups = {entry.name: entry.default_factory for entry in fields(kind) if is_dataclass(entry.default_factory)}
    known = [entry.name for entry in fields(kind)]
    for name, value in data.items():
        if name not in known:
            raise InputError(f"{where}: {unknown(prefix + name, [prefix + one for one in known])}")
        if name in groups and not isinstance(value, Mapping):
            raise InputError(f"{where}: {prefix}{name} must hold `key: value` pairs")
        if name in groups:
            _require_names(groups[name], value, where, f"{prefix}{name}.")


WORDING = {"input should be": "it must be", "greater than or equal to": "at least", "less than or equal to": "at most"}


def _sentence(data: Any, error: ValidationError) -> str:
    """What is wrong with the first value that does not fit."""
    first = error.errors(include_url=False)[0]
    name, value = "", data
    for part in first["loc"]:
        if isinstance(part, int) and isinstance(value, list) and part < len(value):
            name, value = f"{name}[{part}]", value[part]
        elif isinstance(value, Mapping) and part in value:  # what else stands there names pydantic's own branches
            name, value = f"{name}.{part}" if name else str(part), value[part]
    said = first["msg"][:1].lower() + first["msg"][1:]
    for theirs, ours in WORDING.items():
        said = said.replace(theirs, ours)
    if not name:
        return f"a value cannot be written as UTF-8 ({said})"
    if first["type"] == "name":
        return f"{name}: {said}"
    return f"{name} is {brief(repr(value))}; {said}"


def unknown(name: str, known: Iterable[str]) -> str:
    """A sentence on a setting that does not exist."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.3)
    return f"there is no setting {brief(repr(name))}" + (f"; did you mean {near[0]!r}?" if near else "")


def all_names(kind: Any, prefix: str = "") -> list[str]:
    """Full names of all settings of a dataclass of dataclasses."""
    found: list[str] = []
    for entry in fields(kind):
        nested = entry.default_factory if is_dataclass(entry.default_factory) else None
        found += [prefix + entry.name] if nested is None else all_names(nested, f"{prefix}{entry.name}.")
    return found


# --------------------------------------------------------------------------------------------------- YAML


class _Loader(yaml.SafeLoader):
    """`1e-3` is a number, as in YAML 1.2, and a key stands once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        made = super().construct_mapping(node, deep)
        if len(made) < len(node.value):
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            twice = next(key for key, count in Counter(keys).items() if count > 1)
            raise yaml.YAMLError(f"the key {brief(repr(twice))} stands there twice")
        return made


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:\d[\d_]*)(?:\.[\d_]*)?[eE][-+]?\d+$|^[-+]?\.\d+(?:[eE][-+]?\d+)?$|^[-+]?\d+\.\d*$|^[-+]?\.(?:inf|nan)$"),
    list("-+0123456789."),
)


def read_yaml(text: str, where: str) -> dict[str, Any]:
    """`key: value` pairs of YAML that may come from anybody.

    Raises:
        InputError: it is no YAML, or not such pairs.
    """
    try:
        refuse_traps(text, where)
        data = yaml.load(text, Loader=_Loader)  # noqa: S506 (a SafeLoader)
    except InputError:
        raise
    except Exception as error:  # the parser raises its own family
        raise InputError(f"{where} is not valid YAML: {first_line(error)}") from error
    if not isinstance(data := {} if data is None else data, dict):
        raise InputError(f"{where}: settings must be `key: value` pairs")
    return _named(data)


def _named(data: Any) -> Any:
    """Keys as text. YAML reads a bare on and off as true and false."""
    if not isinstance(data, dict):
        return data
    return {{True: "on", False: "off"}[key] if isinstance(key, bool) else str(key): _named(value) for key, value in data.items()}


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


def put(data: dict[str, Any], name: str, value: Any) -> None:
    """Set `group.key` in nested plain data."""
    *groups, key = name.split(".")
    for group in groups:
        if not isinstance(data.get(group), dict):
            data[group] = {}
        data = data[group]
    data[key] = value


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """`{"group": {"key": 1}}` → `{"group.key": 1}`."""
    found: dict[str, Any] = {}
    for key, value in data.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found


# --------------------------------------------------------------------------------------------------- settings of a run

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
    # Stored depth values to a metre (5000), or what one stands for (0.25mm); None: as the source has it, or as fits its poses
    depth_scale: Annotated[float | str, read_by(stored_per_metre)] | None = None
    # auto: 360° panoramas are recognised, and these and fisheye images are cut into views | perspective: neither | equirectangular: all are
    # panoramas
    projection: Annotated[str, one_of("auto", "perspective", "equirectangular")] = "auto"
    # What floating-point images hold. auto: by format, profile and values | linear: light | display: values for screens (sRGB)
    light: Annotated[str, one_of("auto", "linear", "display")] = "auto"


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
    # Distances measured between points that are marked in images, and markers of known size: either makes poses metric (docs/scale.md)
    scale: Annotated[str, read_by(parse_scale)] | None = None
    marker: Annotated[str, read_by(parse_marker)] | None = None
    # auto: the images' GPS places poses of structure from motion on earth, where it fits | off
    gps: Annotated[str, one_of("auto", "off")] = "auto"


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


MOST_CELLS = 10_000


def _check_cells(value: Any) -> Any:
    value = "off" if value is False else int(value) if isinstance(value, str) and value.isdigit() else value
    whole = isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MOST_CELLS
    if not whole and value not in ("off", "auto"):
        sentence = f"it must be off, auto, or a number of cells from 1 to {MOST_CELLS:,}"
        raise PydanticCustomError("choice", "{sentence}", {"sentence": sentence})
    return value


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
    # A large scene as cells that are fitted one by one, or side by side on a cluster (docs/cluster.md): off, a number, or auto (by the
    # pixels of the images). The budget counts as if this machine's cores did all of it
    cells: Annotated[int | str, BeforeValidator(_check_cells)] = "off"


@dataclass
class TsdfSettings:
    enabled: Annotated[str, one_of("auto", "on", "off")] = "auto"  # auto (when the capture has depth) | on | off
    voxel_size: PositiveNumber | None = None  # working units; None: from the capture's depth
    depth_max: PositiveNumber | None = None  # working units; None: from the capture's depth


# Files for other programs: "texture" is a mesh with one (textured.glb), "page" the field itself for any browser (field.html), the others
# are named as they end, or as what they hold.
DEFAULT_EXPORTS = ("points", "ply", "obj", "glb", "texture", "page", "cameras", "video")
# Made when they are named: points as LAS, LAZ or E57, the textured mesh as USDZ (these need extras), pinhole images with cameras,
# Gaussian splats.
MORE_EXPORTS: tuple[str, ...] = ("las", "laz", "e57", "usdz", "undistorted", "splat", "spz")
EXPORTS: tuple[str, ...] = (*DEFAULT_EXPORTS, *MORE_EXPORTS)


def crop_box(text: str) -> tuple[list[float], list[float]] | None:
    """Lowest and highest corner (3,) of a box that is given by six numbers, `x0,y0,z0,x1,y1,z1`; None where the text is something else."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    if len(values) != 6 or not all(abs(value) < 1e12 for value in values):  # not of what is not a number
        return None
    ends = [sorted(pair) for pair in zip(values[:3], values[3:], strict=True)]
    return [low for low, _ in ends], [high for _, high in ends]


def _check_crop(value: Any) -> Any:
    value = "off" if value is False else value
    box = crop_box(value) if isinstance(value, str) else None
    if value not in CROPS and (box is None or not all(low < high for low, high in zip(*box, strict=True))):
        sentence = f"it must be one of {', '.join(CROPS)}, or a box as x0,y0,z0,x1,y1,z1 in the frame of the input"
        raise PydanticCustomError("choice", "{sentence}", {"sentence": sentence})
    return value


CROPS = ("off", "auto", "box", "hull")


@dataclass
class ExportSettings:
    formats: Annotated[list[str], names_of("format", EXPORTS)] = default(default_factory=lambda: list(DEFAULT_EXPORTS))
    mesh_views: NotNegative = 60  # views whose rendered depth is fused into the mesh
    # Long side in pixels, at most, of that depth, and of the pictures, as they were taken, that it is polished by
    mesh_size: Positive = 640
    # Rounds in which vertices of meshes, a TSDF's too, go to the mean of their neighbours; 0: never
    smooth: Annotated[int, Field(ge=0, le=100)] = 2
    texture_size: Positive = 1280  # long side in pixels, at most, of the pictures that a texture is made of
    video_frames: NotNegative = 90
    splats: Positive = 150_000  # Gaussians at most, of voxels that training views see
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 1  # of the spherical harmonics of their colours
    splat_seconds: Annotated[float, Field(ge=0, lt=10**9)] = 30.0  # of steps on the training images; 0: none
    # What is exported of the field. off: all | box: what lies in the region of interest | hull: what half of the cameras see of that
    # | auto: the box where the cameras look at an object, else all | x0,y0,z0,x1,y1,z1: a box in the frame of the input
    crop: Annotated[str, BeforeValidator(_check_crop)] = "off"
    clean: bool = False  # without parts that are connected to nothing that two cameras see


@dataclass
class EffectsSettings:
    mode: Annotated[str, one_of("auto", "off")] = "auto"  # auto: correct what the evidence shows | off: look for nothing
    on: EffectNames = default(default_factory=list)  # effects to correct whatever the evidence says
    off: EffectNames = default(default_factory=list)  # effects to leave as they are


@dataclass
class Settings:
    """All settings of a run. `budget`, `image_size` and friends of the command line land here too."""

    preset: Annotated[str, one_of(*PRESETS)] = "balanced"
    engine: Annotated[str, one_of(*ENGINES)] = "auto"  # auto (numba on the CPU, triton on CUDA) | numba | triton | torch
    device: Annotated[str, one_of("auto", "cpu", "cuda")] = "auto"
    threads: Positive | None = None  # None: all cores
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    address: str | None = None  # of a Ray cluster for cells and their poses: auto or HOST:PORT; None: this machine
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
    "depth_scale": "capture.depth_scale",
    "scale": "poses.scale",
    "marker": "poses.marker",
    "image_size": "capture.image_size",
    "holdout": "capture.holdout",
    "budget": "fit.budget",
    "decoder": "field.decoder",
    "background": "field.background",
    "init": "field.init",
    "finetune": "fit.finetune",
    "cells": "fit.cells",
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
    if settings.poses.scale is not None and settings.poses.marker is not None:
        raise InputError("scale and marker both give the unit of length; give one of them")
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
