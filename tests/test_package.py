"""What a stranger installs: sdist and wheel, built from a copy of the tree without a network, used from another project's folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (".ci", "benchmarks", "configs", "docs", "examples", "pipelines", "tests", "toolkit")
MADE = ("__pycache__", "*.egg-info", "build", "dist", "*.nb[ic]")
OURS = ("configs", "pipelines", "toolkit")  # folders here, and names that another project may have, too

pytest.importorskip("build")
pytest.importorskip("pip")


def run(*command: object, folder: Path, **environment: str) -> str:
    """Standard output of a command that must succeed; the caller's PYTHONPATH does not reach it."""
    plain = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, env=plain | environment, capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def left_by_builds() -> set[Path]:
    return {*ROOT.glob("*.egg-info"), *ROOT.glob("dist"), *ROOT.glob("build/lib"), *ROOT.glob("build/bdist*")}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository to build in."""
    copy = tmp_path_factory.mktemp("tree") / "fieldfuse"
    copy.mkdir()
    for name in FOLDERS:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns(*MADE))
    for path in ROOT.iterdir():
        if path.is_file() and path.name not in (".git", ".gitignore") and not path.name.endswith("-state.json"):
            shutil.copy(path, copy)
    return copy


@pytest.fixture(scope="module")
def built(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist and with the wheel that was built from it, as `python -m build` does."""
    before = left_by_builds()
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, tree, folder=tree)
    assert left_by_builds() == before
    return out


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (path,) = built.glob("fieldfuse-*.whl")
    return path


def contents(wheel: Path) -> dict[str, int]:
    """Checksums of a wheel's files by name."""
    with zipfile.ZipFile(wheel) as archive:
        return {entry.filename: entry.CRC for entry in archive.infolist()}


def test_the_index_would_take_both(built: Path) -> None:
    pytest.importorskip("twine")
    assert run(sys.executable, "-m", "twine", "--no-color", "check", "--strict", *built.iterdir(), folder=built).count("PASSED") == 2


def test_the_wheel_holds_one_import_name_and_its_data(wheel: Path) -> None:
    names = {name for name in contents(wheel) if ".dist-info/" not in name}
    assert {name.partition("/")[0] for name in names} == {"fieldfuse"}
    for folder, place in (("toolkit", ""), ("pipelines", "pipelines/"), ("configs", "configs/")):
        files = (path for path in (ROOT / folder).rglob("*") if path.is_file() and not {"__pycache__", ".mypy_cache"} & set(path.parts))
        assert {f"fieldfuse/{place}{path.relative_to(ROOT / folder).as_posix()}" for path in files} <= names
    ends = ("/py.typed", "configs/fast.yaml", "configs/scenes/room.yaml", "report.html.j2", "web/page.js", "weights/nerfusion.safetensors")
    assert all(any(name.endswith(end) for name in names) for end in ends)
    assert all(name.endswith((".py", ".yaml", ".j2", ".js", ".frag", ".css", ".safetensors", "py.typed")) for name in names)


def test_the_sdist_holds_the_repository_and_builds_the_same_wheel(built: Path, wheel: Path, tree: Path) -> None:
    (sdist,) = built.glob("fieldfuse-*.tar.gz")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    there = {path.relative_to(tree).as_posix() for path in tree.rglob("*") if path.is_file() and ".egg-info" not in path.as_posix()}
    assert "Makefile" in there and there <= packed, there - packed
    straight = built.parent / "straight"
    run(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", straight, tree, folder=tree)
    assert contents(next(straight.glob("*.whl"))) == contents(wheel)


@pytest.fixture(scope="module")
def elsewhere(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The interpreter of a new environment that has the wheel, and a project whose own packages are called as folders here are.

    The libraries are this environment's, named by a .pth file; .pth files beside them, such as an editable installation's, are not read.
    """
    place = tmp_path_factory.mktemp("elsewhere")
    venv.create(place / "env", with_pip=False, symlinks=True)
    python = place / "env" / "bin" / "python"
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", folder=place).strip())
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python)
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", "--no-compile", wheel, folder=place)
    (site / "libraries.pth").write_text("".join(f"{folder}\n" for folder in sys.path if folder.endswith("-packages")), encoding="utf-8")
    project = place / "project"
    for name in OURS:
        (project / name).mkdir(parents=True)
        (project / name / "__init__.py").write_text(f"raise RuntimeError('{name} of another project was imported')\n", encoding="utf-8")
    return python, project


def test_it_works_in_another_project(elsewhere: tuple[Path, Path], wheel: Path) -> None:
    """Names of that project are in the way on purpose: its folder comes first on the path."""
    python, project = elsewhere
    place = Path(run(python, "-c", "import fieldfuse; print(fieldfuse.__file__)", folder=project).strip())
    assert place.parents[1].name == "site-packages" and place.is_relative_to(python.parents[1])
    path = {"PYTHONPATH": str(project)}
    assert "Usage: fieldfuse" in run(python.with_name("fieldfuse"), "--help", folder=project, **path)
    assert run(python, "-m", "fieldfuse", "--version", folder=project, **path) == f"fieldfuse {wheel.name.split('-')[1]}\n"
    presets = "from fieldfuse.config import load_settings as load; print(load('fast').fit.budget < load('quality').fit.budget)"
    assert run(python, "-c", presets, folder=project, **path) == "True\n"


FILM = "from fieldfuse.simulate.demo import write_demo_video; write_demo_video('demo/demo.mp4', frames=16, size=(320, 240))"


def lend_kernels(package: Path) -> None:
    """Give an installed package what numba has compiled of the same sources here: that would take most of a minute again.

    Numba asks for a source's size and time, so these are made equal; a kernel that is not lent is compiled."""
    for source in (ROOT / "toolkit").rglob("*.py"):
        installed = package / source.relative_to(ROOT / "toolkit")
        compiled = list((source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ic]"))
        if compiled and installed.read_bytes() == source.read_bytes():
            shutil.copystat(source, installed)
            (installed.parent / "__pycache__").mkdir(exist_ok=True)
            for file in compiled:
                shutil.copy(file, installed.parent / "__pycache__")


@pytest.mark.slow
def test_the_demo_runs_in_another_project(elsewhere: tuple[Path, Path]) -> None:
    """On a shorter, smaller film than that of `make demo`, without the networks and with fewer exports."""
    python, project = elsewhere
    lend_kernels(Path(run(python, "-c", "import fieldfuse; print(fieldfuse.__file__)", folder=project).strip()).parent)
    (project / "demo").mkdir()
    run(python, "-c", FILM, folder=project)
    options = ("--budget", 1, "--init", "classical", "--set", "export.formats=[points,page]", "--set", "effects=off")
    run(python, "-m", "fieldfuse.pipelines.demo", *options, folder=project, OMP_NUM_THREADS="1")
    results = project / "demo" / "run"
    for name in ("report.html", "field.safetensors", "exports/field.html", "exports/points.ply"):
        assert (results / name).stat().st_size > 1000, name
