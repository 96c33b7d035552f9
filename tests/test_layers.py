"""Imports go one way, and the contract that says so covers every module there is."""

from __future__ import annotations

import ast
import configparser
import shutil
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    code = "import sys; sys.path.insert(0, '.'); from importlinter.cli import lint_imports_command; lint_imports_command(['--no-cache'])"
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The packages and their contract, to be broken on purpose."""
    for name in ("toolkit", "pipelines", "configs", "benchmarks"):
        place = tmp_path / (name if name == "benchmarks" else "fieldfuse" if name == "toolkit" else f"fieldfuse/{name}")
        shutil.copytree(ROOT / name, place, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "setup.cfg", tmp_path)
    return tmp_path


def test_the_contracts_are_kept(copy: Path) -> None:
    done = lint_imports(copy)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("fieldfuse/camera.py", "from fieldfuse.render import march", "One direction of flow"),
        ("fieldfuse/files.py", "import fieldfuse.camera", "One direction of flow"),
        ("fieldfuse/evaluation/__init__.py", "import fieldfuse.pipelines.doctor", "One direction of flow"),
        ("fieldfuse/pipelines/doctor.py", "import benchmarks.timing", "imports no benchmark"),
        ("fieldfuse/training/__init__.py", "import open3d", "needs no Open3D"),
        ("fieldfuse/capture/__init__.py", "import pycolmap", "needs no Open3D"),
        ("fieldfuse/volume/topology.py", "from fieldfuse.volume import grid", "needs no Open3D"),
    ],
)
def test_a_wrong_import_is_told(copy: Path, module: str, line: str, contract: str) -> None:
    path = copy / module
    path.write_text(f"{path.read_text(encoding='utf-8')}\n{line}\n", encoding="utf-8")
    done = lint_imports(copy)
    broken = [text for text in done.stdout.splitlines() if " BROKEN" in text]
    assert done.returncode == 1
    assert any(contract in text for text in broken), done.stdout


def test_a_new_part_needs_a_place_in_the_order(copy: Path) -> None:
    (copy / "fieldfuse" / "newcomer.py").write_text('"""New."""\n', encoding="utf-8")
    done = lint_imports(copy)
    assert done.returncode == 1 and "newcomer" in done.stdout


def test_only_the_poses_child_imports_pycolmap() -> None:
    """A crash inside pycolmap must not take the job with it, so only the worker process loads it."""
    importers = [
        path.relative_to(ROOT).as_posix()
        for folder in ("toolkit", "pipelines")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if any(line.strip().startswith(("import pycolmap", "from pycolmap")) for line in path.read_text(encoding="utf-8").splitlines())
    ]
    assert importers
    assert all(name.startswith("toolkit/poses/") or name == "pipelines/doctor.py" for name in importers), importers


def test_the_layers_name_only_what_may_exist() -> None:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    layers = parser["importlinter:contract:flow"]["layers"].replace("|", " ").replace(":", " ").split()
    required = [name for name in layers if not name.startswith("(")]
    places = [ROOT / "toolkit" / name for name in required]
    beside = ("pipelines", "configs")
    missing = [place.name for place in places if not (place.name in beside or place.is_dir() or place.with_suffix(".py").is_file())]
    assert not missing


def imports(name: str, path: Path, modules: dict[str, Path]) -> set[str]:
    """The modules among `modules` that this one imports, anywhere in it, but for types alone."""
    found = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body.clear()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} imports by dots; the others do not"
            of = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= of & modules.keys() if of & modules.keys() else {str(node.module)}
    return {other for other in found if other in modules and other != name}


def test_no_modules_import_each_other() -> None:
    """Not even late, inside functions, or by way of others."""
    modules = {}
    for folder, package in (("toolkit", "fieldfuse"), ("pipelines", "fieldfuse.pipelines"), ("configs", "fieldfuse.configs")):
        for path in (ROOT / folder).rglob("*.py"):
            parts = (package, *path.relative_to(ROOT / folder).with_suffix("").parts)
            modules[".".join(parts).removesuffix(".__init__")] = path
    assert len(modules) > 300
    graph = {name: imports(name, path, modules) for name, path in modules.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_no_module_gives_a_constant_two_values() -> None:
    """A name given to two thresholds of one module silently makes the first the second."""
    for path in [path for folder in ("toolkit", "pipelines", "benchmarks") for path in (ROOT / folder).rglob("*.py")]:
        lines = ast.parse(path.read_text(encoding="utf-8")).body
        goals = [goal for line in lines if isinstance(line, ast.Assign) for goal in line.targets]
        names = [node.id for goal in goals for node in ast.walk(goal) if isinstance(node, ast.Name)]
        assert len(names) == len(set(names)), f"{path}: {sorted({name for name in names if names.count(name) > 1})}"
