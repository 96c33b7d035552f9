"""What fits and renders works on machines that cannot carry Open3D, pycolmap or trimesh."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCKED = ("open3d", "pycolmap", "trimesh")
LIGHT = (
    "fieldfuse.camera",
    "fieldfuse.config",
    "fieldfuse.files",
    "fieldfuse.capture",
    "fieldfuse.effects",
    "fieldfuse.volume.compiled",
    "fieldfuse.volume.edit",
    "fieldfuse.volume.lookup",
    "fieldfuse.volume.space",
    "fieldfuse.volume.store",
    "fieldfuse.volume.topology",
    "fieldfuse.nerfusion",
    "fieldfuse.backends",
    "fieldfuse.render",
    "fieldfuse.training",
    "fieldfuse.simulate",
)
PRELUDE = f"""
import importlib, pkgutil, sys
from importlib.abc import MetaPathFinder

class Blocker(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED!r}:
            raise ModuleNotFoundError("blocked: " + name, name=name)

sys.meta_path.insert(0, Blocker())

def everything(name):
    module = importlib.import_module(name)
    yield name
    for found in pkgutil.walk_packages(getattr(module, "__path__", []), name + "."):
        importlib.import_module(found.name)
        yield found.name
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-c", PRELUDE + code], capture_output=True, text=True, env=environment, check=False)


def test_the_block_blocks() -> None:
    done = run("import open3d")
    assert done.returncode == 1 and "blocked: open3d" in done.stderr


def test_every_light_module_imports_without_them() -> None:
    done = run(f"print(*[name for root in {LIGHT!r} for name in everything(root)], sep='\\n')")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) > 30


COMMANDS = """
from fieldfuse.pipelines.cli import main
codes = []
for arguments in {commands!r}:
    sys.argv = ["fieldfuse", *arguments]
    try:
        main()
        codes.append(0)
    except SystemExit as end:
        codes.append(end.code or 0)
print("\\n", codes, sep="")
"""


def test_the_command_line_starts_without_them(tmp_path: Path) -> None:
    """`doctor` is what tells that a library is missing, so it must not need one."""
    done = run(COMMANDS.format(commands=[("--help",), ("--version",), ("info", str(tmp_path)), ("doctor",)]))
    assert "Traceback" not in done.stderr and "blocked" not in done.stderr, done.stderr
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == "[0, 0, 2, 0]"  # an empty folder is no capture


FIT = """
import itertools
import numpy as np, torch
torch.set_num_threads(1)
from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.config import load_settings
from fieldfuse.poses.scene import Scene
from fieldfuse.render.image import render_view
from fieldfuse.simulate.demo import demo_scene, hand_held
from fieldfuse.training.fit import Clock, fit_field

looks = itertools.count(1)
Clock.seconds = lambda clock: next(looks) * 0.05  # as many steps on any machine
camera, poses, room = Intrinsics(48, 36, 40.8, 40.8, 24.0, 18.0), hand_held(12), demo_scene()
pictures = [room.picture(camera, pose) for pose in poses]
views = Views([str(i) for i in range(12)], pictures, [camera] * 12, poses, np.arange(12) % 6 == 0)
scene = Scene(Similarity.identity(), np.array([0.2, 0.2, 0.6]), np.array([1.6, 1.6, 1.0]), 2.0, 0.5, 6.0, 0.1, True, True)
settings = load_settings("fast", pairs=["budget=2", "threads=1", "field.resolution=32"])
result = fit_field(views, scene, settings)
rendered = render_view(result.field, camera, poses[6])
assert rendered.rgb.shape == (36, 48, 3) and np.isfinite(rendered.rgb).all() and rendered.opacity.max() > 0.1
print(result.steps)
"""


def test_a_field_is_fitted_and_rendered_without_them() -> None:
    """Not only the imports: a short fit with gradients, a picture of a view that was not fitted."""
    done = run(FIT)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 1
