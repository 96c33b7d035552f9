"""Arguments and options that commands share, each declared once, and what all commands do with them.

Nothing here imports NumPy before `bound_threads` has set the number of threads.
"""

from __future__ import annotations

import inspect
import json as writer
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SHORT_SPIN = "1000"  # turns, microseconds



def option(help: str, *names: str, **more: Any) -> Any:
    """An option whose default the help does not show: the text has it."""
    return typer.Option(*names, help=help, show_default=False, **more)


_SOURCE = "A video, a folder of photos, or a posed capture; its kind is found by looking."
_TARGET = "The folder of an earlier run; or a source, then --out is needed."
_TOTAL = "Seconds for the whole run: picture size, voxels, a video's frames, fitting time and exports are chosen for it."
_START = "Start of the fit: network, classical, or auto (default): the networks' with fewer than 24 training pictures."
_FINETUNE = "Whether the networks' field is fitted (default), or the result."
_SCALE = "Measured distance of two marked points: 'IMG_1:812,330 IMG_2:1204,341 = 1.20' (metres)."
_CELLS = "Fit a large scene as so many cells, side by side where there are cores or nodes; auto: by its size."
_ADDRESS = "Ray cluster that fits the cells: auto or HOST:PORT; default: this machine."
_MARKER = "ArUco markers in the images and their side in metres: DICT_4X4_50:0.05."
Source = Annotated[Path, typer.Argument(help=_SOURCE, show_default=False)]
Target = Annotated[Path, typer.Argument(help=_TARGET, show_default=False)]
Out = Annotated[Path, option("Folder for everything that the run makes.", "--out", "-o")]
OptionalOut = Annotated[Path | None, option("Folder of the run, when the first argument is a source.", "--out", "-o")]
Preset = Annotated[str | None, option("fast, balanced (default), quality, or paper (as NeRFusion does it).")]
Budget = Annotated[float | None, option("Seconds of optimisation.")]
TotalBudget = Annotated[float | None, option(_TOTAL, min=10)]
ImageSize = Annotated[int | None, option("Long side of the pictures in pixels.")]
Holdout = Annotated[int | None, option("Every n-th picture by name is kept for testing; 0: none. Default 8.")]
Device = Annotated[str | None, option("auto (default), cpu or cuda.")]
Threads = Annotated[int | None, option("Threads to use; default: all cores.")]
Seed = Annotated[int | None, option("Seed of all random numbers; default 0.")]
Engine = Annotated[str | None, option("auto (default): numba on the CPU, triton on CUDA; numba, triton or torch.")]
Decoder = Annotated[str | None, option("deferred (default) or per_sample (the paper's).")]
Init = Annotated[str | None, option(_START)]
Finetune = Annotated[bool | None, option(_FINETUNE, "--finetune/--no-finetune")]
PosesFrom = Annotated[str | None, option("auto (default), given, or sfm: ignore given poses.", "--poses")]
DepthScale = Annotated[str | None, option("Stored depth values to a metre, as 5000, or what one stands for, as 0.25mm.")]
Scale = Annotated[str | None, option(_SCALE)]
Marker = Annotated[str | None, option(_MARKER)]
CellCount = Annotated[str | None, option(_CELLS, "--cells")]
Address = Annotated[str | None, option(_ADDRESS)]
Baked = Annotated[bool, option("Take the baked field, as pages have it; it is made if need be.", "--baked")]
Config = Annotated[Path | None, option("YAML file with settings.")]
Pairs = Annotated[list[str] | None, option("Any setting as key=value; may be repeated.", "--set", metavar="KEY=VALUE")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]


@dataclass(frozen=True)
class Place:
    """The run that a command works on."""

    target: Target
    out: OptionalOut = None

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.out or self.target


@dataclass(frozen=True)
class Options:
    """What a command may be given besides; each has those that it names (`takes`)."""

    preset: Preset = None
    budget: Budget = None
    total_budget: TotalBudget = None
    image_size: ImageSize = None
    holdout: Holdout = None
    baked: Baked = False
    device: Device = None
    threads: Threads = None
    seed: Seed = None
    engine: Engine = None
    decoder: Decoder = None
    init: Init = None
    finetune: Finetune = None
    poses: PosesFrom = None
    depth_scale: DepthScale = None
    scale: Scale = None
    marker: Marker = None
    cells: CellCount = None
    address: Address = None
    config: Config = None
    pairs: Pairs = None
    quiet: Quiet = False
    json: Json = False

    def settings(self, *pairs: str, **flags: Any) -> dict[str, Any]:
        """The options that `fieldfuse.pipelines.job.read_settings` takes: `pairs` come before those of `--set`, `flags` are added."""
        given = {name: getattr(self, name) for name in FLAGS}
        return gather(self.preset, self.config, [*pairs, *(self.pairs or [])], **given, **flags)


FLAGS = (
    *("budget", "image_size", "holdout", "device", "threads", "seed", "engine", "decoder", "init", "finetune", "poses"),
    *("depth_scale", "scale", "marker", "cells", "address"),
)


@dataclass(frozen=True)
class ClusterOptions:
    """Where the tasks of a command run, and what is reserved for each."""

    address: Annotated[str | None, option("Ray cluster: auto, or HOST:PORT; default: this machine.")] = None
    cpus_per_run: Annotated[int | None, option("Cores for a run; default: as many as there are for each.", min=1)] = None
    gpus_per_run: Annotated[float | None, option("GPUs for a run, also parts of one; default 0, or 1 with --device cuda.", min=0)] = None
    memory_per_run: Annotated[float | None, option("GB reserved for a run; default: estimated from the capture.", min=0.01)] = None
    retries: Annotated[int, typer.Option(help="How often a run goes on elsewhere when its worker is lost.", min=0)] = 3
    timeout: Annotated[float | None, option("Seconds after which a run is ended and counts as failed.", min=1)] = None
    upload: Annotated[bool, typer.Option("--upload", help="Send captures and results through Ray, without shared storage.")] = False


RUN = (  # those of `run`, in the order of its help
    "preset budget total_budget image_size holdout device threads seed engine decoder init finetune poses depth_scale scale marker config "
    "pairs quiet json"
)


def words(options: Options) -> list[str]:
    """Options as a command line has them, without those that say how much is shown; what is not given is left out."""
    out: list[str] = []
    hints = get_type_hints(Options, include_extras=True)
    for name in RUN.split():
        value = getattr(options, name)
        if value is None or name in ("quiet", "json"):
            continue
        # In an annotation typer's first argument, `default`, is the option's name, if that is not its parameter's.
        named = next((one.default for one in hints[name].__metadata__ if isinstance(one.default, str)), f"--{name.replace('_', '-')}")
        if isinstance(value, bool):
            out.append(named.split("/")[0 if value else 1])
            continue
        for one in value if isinstance(value, list) else [value]:
            out += [named, str(one)]
    return out


def gather(preset: str | None = None, config: Path | None = None, pairs: list[str] | None = None, **flags: Any) -> dict[str, Any]:
    """Options by name → what `fieldfuse.pipelines.job.read_settings` takes."""
    return {"preset": preset, "config": config, "pairs": list(pairs or []), "flags": flags}


def takes(names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command of a function whose arguments may be groups (dataclasses): typer reads a signature with their fields one by one.

    Args:
        names: those of `Options` that the command has, in the order of its help.
    """

    def spread(command: Callable[..., None]) -> Callable[..., None]:
        groups: dict[str, tuple[Any, list[str]]] = {}
        parameters: list[inspect.Parameter] = []
        hints = get_type_hints(command, include_extras=True)
        for name, parameter in inspect.signature(command).parameters.items():
            kind = hints[name]
            if not is_dataclass(kind):
                parameters.append(parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY))
                continue
            inner, defaults = get_type_hints(kind, include_extras=True), {entry.name: entry.default for entry in fields(kind)}
            groups[name] = kind, names.split() if kind is Options else list(defaults)
            for one in groups[name][1]:
                default = inspect.Parameter.empty if defaults[one] is MISSING else defaults[one]
                parameters.append(inspect.Parameter(one, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=inner[one]))

        def run(**given: Any) -> None:
            made = {name: kind(**{one: given.pop(one) for one in members}) for name, (kind, members) in groups.items()}
            command(**given, **made)

        run.__name__, run.__doc__ = command.__name__, command.__doc__
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return spread


def bound_threads(options: dict[str, Any]) -> None:
    """Give numeric libraries the thread count of the command line, and have all threads allocate from one heap.

    Call it before anything imports NumPy: its BLAS reads the count when it is loaded, and no more.
    """
    # Threads that spin while they wait take the cores from whatever else runs: on a busy machine with two cores a fit made 83 steps
    # in 15 s with spinning threads and 306 with sleeping ones. So they sleep, but not at once (GNU's library counts the turns): to wake
    # one for each of the networks' many short operations would cost a quarter of their time (docs/measured/performance.md).
    if os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE").upper() == "PASSIVE":
        os.environ.setdefault("GOMP_SPINCOUNT", SHORT_SPIN)
    pairs = [pair.removeprefix("threads=") for pair in options.get("pairs") or [] if pair.startswith("threads=")]
    wanted = options.get("flags", {}).get("threads") or next(iter(pairs), None)
    if wanted is not None and str(wanted).isdigit() and int(wanted) > 0:
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(wanted)))
    from fieldfuse import memory

    memory.one_heap()


def show(data: Any, options: Options, lines: Callable[[], Iterable[str]]) -> None:
    """The result on standard output: JSON, `lines` for people, or nothing with `--quiet`."""
    if options.json:
        sys.stdout.write(writer.dumps(data, indent=1) + "\n")
    elif not options.quiet:
        sys.stdout.writelines(f"{line}\n" for line in lines())
