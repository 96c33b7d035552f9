"""A small real run, made to fail at chosen moments, and what its folder must look like afterwards."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import trimesh
from safetensors import safe_open

from fieldfuse.capture.storage import load_views
from fieldfuse.files import read_json
from fieldfuse.render.field import Field
from tests.pipelines.made import CAMERA, environment, make_room

ROOT = Path(__file__).resolve().parents[2]
OPTIONS = ("--budget", "0.5", "--threads", "1", "--holdout", "4", "--set", "field.resolution=16", "--set", "export.mesh_views=3",
           "--set", "export.formats=[points,ply,cameras]", "--set", "field.init=classical", "--engine", "torch",
           "--quiet")  # fmt: skip
NETWORK = ("--set", "field.init=network")  # behind the options above: a run that starts from the networks
PATIENCE = 600.0  # seconds after which a run counts as hung, on the busiest machine
TICK = 0.008  # seconds that the fit's clock advances at each look: some sixty looks a run, on any machine
STAGES = ("capture", "poses", "effects", "scene", "views", "keyframes", "tsdf", "field", "render", "export", "evaluate")
VARYING = ("key", "made", "after", "outputs", "cached", "started", "created", "command")


def make_source(folder: Path) -> Path:
    """Eight RGB-D frames of a made-up room, 48×36."""
    make_room(folder, 8, True, CAMERA.scaled(48, 36))
    return folder


def launch(plan: dict[str, Any], source: Path, out: Path, *more: object) -> subprocess.CompletedProcess[str]:
    """Run the whole job as a process of its own, with what goes wrong (see `launch`)."""
    return subprocess.run(
        command(plan, source, out, *more), capture_output=True, text=True, env=environment(), cwd=ROOT, check=False, timeout=PATIENCE
    )


def command(plan: dict[str, Any], source: Path, out: Path, *more: object) -> list[str]:
    told = json.dumps({"ticks": TICK, **plan})
    return [sys.executable, "-m", "tests.stability.launch", told, "run", str(source), "--out", str(out), *OPTIONS, *map(str, more)]


def corrupt(folder: Path) -> list[str]:
    """Files that are not whole, but for those still being written (`.tmp-…`); records that promise what is not there."""
    wrong = []
    for path in sorted(folder.rglob("*")):
        if path.is_dir() or ".tmp-" in str(path.relative_to(folder)) or path.name in (".lock", "error.log", "log.txt"):
            continue
        try:
            _open(path)
        except Exception as error:  # whatever a reader says about it
            wrong.append(f"{path.relative_to(folder)}: {error}")
    for record in (folder / "stages").glob("[!.]*.json"):
        for relative, size in read_json(record)["outputs"].items():
            file = folder / relative
            if not file.is_file() or file.stat().st_size != size:
                wrong.append(f"{record.name} promises {relative} of {size} bytes")
    return wrong


def _open(path: Path) -> None:
    if path.suffix == ".json":
        json.loads(path.read_text(encoding="utf-8"))
    elif path.name == "field.safetensors" and path.parent.name != "renders":
        Field.load(path)
    elif path.name == "views.safetensors":
        load_views(path)
    elif path.suffix == ".safetensors":
        with safe_open(path, framework="numpy") as file:
            for name in file.keys():  # noqa: SIM118 (not a mapping)
                file.get_tensor(name)
    elif path.suffix == ".png":
        if cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is None:
            raise ValueError("not a picture")
    elif path.suffix == ".ply":
        trimesh.load(path)
    elif path.suffix == ".html":
        if "</html>" not in path.read_text(encoding="utf-8").lower():
            raise ValueError("cut short")
    elif path.stat().st_size == 0 and path.name != "points3D.txt":
        raise ValueError("empty")


def differences(first: Path, second: Path) -> list[str]:
    """What two finished runs differ in, besides times and identities; meshes and points are the same to the byte."""
    names = {str(path.relative_to(folder)) for folder in (first, second) for path in folder.rglob("*") if path.is_file()}
    out = []
    for name in sorted(names - {".lock", "run.json", "report.html", "sparse/log.txt"}):
        a, b = first / name, second / name
        if not a.is_file() or not b.is_file():
            out.append(f"{name} is only in one of them")
        elif a.read_bytes() != b.read_bytes() and _content(a, first) != _content(b, second):
            out.append(f"{name} differs")
    return out


def _content(path: Path, folder: Path) -> Any:
    if path.suffix == ".json":
        return _timeless(json.loads(path.read_text(encoding="utf-8").replace(str(folder), "")))
    if path.suffix == ".safetensors":
        with safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
    return path.read_bytes()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: _timeless(entry) for key, entry in value.items() if key not in VARYING and "seconds" not in key and "memory" not in key
        }
    if isinstance(value, list):
        return [_timeless(entry) for entry in value]
    return value


def leftovers(folder: Path) -> list[str]:
    """Half-written files that a finished run must not leave."""
    return [str(path.relative_to(folder)) for path in folder.rglob(".tmp-*")]
