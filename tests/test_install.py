"""Packaging: what is pinned, what is packed, and what the make targets do without a network."""

from __future__ import annotations

import ast
import configparser
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata, resources
from pathlib import Path

import pytest

from tests import kernels

ROOT = Path(__file__).resolve().parents[1]


def setup() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    return parser


def names(block: str) -> set[str]:
    return {re.split(r"[<>=;\[]", line)[0].strip().lower() for line in block.split("\n") if line.strip() and not line.startswith("#")}


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_every_direct_dependency_is_pinned_and_nothing_else() -> None:
    parser = setup()
    wanted = names(parser["options"]["install_requires"])
    for extra in parser["options.extras_require"].values():
        wanted |= names(extra)
    assert set(pins()) == wanted


def test_pins_satisfy_the_ranges() -> None:
    from packaging.requirements import Requirement

    for line in setup()["options"]["install_requires"].split("\n"):
        if line.strip():
            requirement = Requirement(line)
            assert requirement.specifier.contains(pins()[requirement.name.lower()]), line


def test_pyproject_holds_only_the_build_system() -> None:
    assert list(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))) == ["build-system"]


TOPS = {"toolkit": "fieldfuse", "pipelines": "fieldfuse.pipelines", "configs": "fieldfuse.configs"}  # folders, and what they install as


def test_every_package_has_an_init_and_is_packed() -> None:
    options = setup()["options"]
    assert dict(line.split(" = ") for line in options["package_dir"].strip().splitlines()) == {name: top for top, name in TOPS.items()}
    packages = {
        TOPS[top] + path.parent.relative_to(ROOT).as_posix().removeprefix(top).replace("/", ".")
        for top in TOPS
        for path in (ROOT / top).rglob("*.py")
        if (path.parent / "__init__.py").is_file()
    }
    assert set(options["packages"].split()) == packages
    assert len(packages) == len({path.parent for top in TOPS for path in (ROOT / top).rglob("*.py")}), "a folder lacks __init__.py"


def test_data_files_are_packed() -> None:
    """Files beside the code that are read at run time must be in package_data, or an installed copy lacks them."""
    data = setup()["options.package_data"]
    patterns = [(package, pattern.strip()) for package, given in data.items() for pattern in given.split(",")]
    folders = {name: top for top, name in TOPS.items()} | {
        name: f"toolkit/{name.removeprefix('fieldfuse.').replace('.', '/')}" for name in data if name not in TOPS.values()
    }
    packed = {path for package, pattern in patterns for path in (ROOT / folders[package]).glob(pattern)}
    there = {
        path
        for top in TOPS
        for path in (ROOT / top).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }
    assert packed == there
    assert {entry.name for entry in resources.files("fieldfuse.configs").iterdir()} >= {"fast.yaml", "balanced.yaml", "quality.yaml"}


def test_the_command_is_declared_and_the_version_is_one() -> None:
    import fieldfuse
    from fieldfuse.pipelines import cli

    assert setup()["options.entry_points"]["console_scripts"].strip() == "fieldfuse = fieldfuse.pipelines.cli:program"
    assert callable(cli.main)
    assert setup()["metadata"]["version"] == "attr: fieldfuse.__version__"
    try:
        installed = metadata.version("fieldfuse")
    except metadata.PackageNotFoundError:
        pytest.skip("fieldfuse runs from its folder here, it is not installed")
    assert installed == fieldfuse.__version__


def test_ci_runs_all_tests() -> None:
    text = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "set -euo pipefail" in text and "make test-all" in text
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def make(*arguments: str, path: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
    if path is not None:
        environment["PATH"] = path
    return subprocess.run(
        ["make", *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
    )


@needs_make
def test_no_python_is_one_clear_sentence() -> None:
    done = make("system", "PYTHON=")
    assert done.returncode != 0
    assert "Python 3.11 or newer is needed" in done.stderr


@needs_make
def test_demo_and_test_share_the_steps_in_order(tmp_path: Path) -> None:
    """From nothing: environment, install, and only then the work. Nothing is run here (`--dry-run`)."""
    venv = f"VENV={tmp_path / 'none'}"
    demo, test = make("--dry-run", "demo", venv).stdout, make("--dry-run", "test", venv).stdout
    assert demo.index("-m venv") < demo.index("pip install") < demo.index("fieldfuse.pipelines.demo")
    assert test.index("-m venv") < test.index("pip install") < test.index("ruff check") < test.index("bin/mypy") < test.index("-m pytest")
    assert "lint-imports" in test and test.index("tests.kernels") < test.index("-m pytest") and callable(kernels.main)
    everything = make("--dry-run", "test-all", venv).stdout
    assert '-m "not slow and not long"' in test and '-m "not long"' in everything
    assert "constraint constraints.txt" in demo


@needs_make
def test_hooks_of_commits_run_what_lint_runs(tmp_path: Path) -> None:
    text = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    targets = re.findall(r"entry: make --silent (\w+)$", text, re.MULTILINE)
    done = make("--dry-run", "lint", f"VENV={tmp_path / 'none'}").stdout
    assert len(targets) == text.count("- id:") == 3
    for target, tool in zip(targets, ("ruff check", "bin/mypy", "lint-imports"), strict=True):
        assert tool in done and tool in make("--dry-run", target, f"VENV={tmp_path / 'none'}").stdout


def libraries(python: str, path: str) -> subprocess.CompletedProcess[str]:
    script = str(ROOT / ".ci" / "system_libraries.sh")
    return subprocess.run(
        ["/bin/bash", script, python], env={"PATH": path}, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
    )


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A PATH with the tools of a plain system, ahead of the real ones; its ldconfig knows no graphics or USB library."""
    tools = tmp_path / "bin"
    tools.mkdir()

    def script(name: str, text: str) -> None:
        (tools / name).write_text(f"#!/bin/bash\n{text}\n")
        (tools / name).chmod(0o755)

    script("ldconfig", "echo libgomp.so.1; echo libudev.so.1; echo libidn2.so.0")
    return tools


@pytest.mark.skipif(sys.platform != "linux", reason="system packages are looked at on Linux only")
def test_missing_libraries_are_named_or_installed(bare: Path, tmp_path: Path) -> None:
    """Without root: the exact command. With root: apt-get is called with exactly those packages (a stand-in records it)."""
    apt = bare / "apt-get"
    apt.write_text(f'#!/bin/bash\necho "$@" >> {tmp_path}/calls\n')
    apt.chmod(0o755)
    done = libraries(sys.executable, f"{bare}:/usr/bin:/bin")
    wanted = "libegl1 libgl1 libusb-1.0-0 libx11-6"
    if os.geteuid() == 0:
        assert (tmp_path / "calls").read_text().splitlines()[0].startswith("update")
        assert wanted in (tmp_path / "calls").read_text()
        assert done.returncode == 1 and "still not found" in done.stderr  # the stand-in installed nothing
    else:
        assert done.returncode == 1
        assert f"sudo apt-get update && sudo apt-get install --yes --no-install-recommends {wanted}" in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="system packages are looked at on Linux only")
def test_a_python_without_venv_is_told(tmp_path: Path) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/bash\nexit 1\n")
    broken.chmod(0o755)
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("uname", "sort", "ldconfig", "bash"):
        found = shutil.which(name, path="/usr/sbin:/sbin:/usr/bin:/bin")
        if found:
            (tools / name).symlink_to(found)
    script = (ROOT / ".ci" / "system_libraries.sh").read_text().replace("PATH=$PATH:/usr/sbin:/sbin", f"PATH={tools}")
    (tmp_path / "script.sh").write_text(script)
    done = subprocess.run(
        ["/bin/bash", str(tmp_path / "script.sh"), str(broken)], env={"PATH": str(tools)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "python3-venv" in done.stderr and "package manager" in done.stderr


def test_what_is_imported_is_installed_without_the_tests() -> None:
    """Every package that toolkit or pipelines import is required by setup.cfg, also without what only tests need: else what passes here
    fails on a user's machine."""
    parsed = setup()
    extras = parsed["options.extras_require"]
    asked = names(parsed["options"]["install_requires"]).union(*(names(extras[name]) for name in extras if name not in ("docs", "test")))
    asked |= {"llvmlite", "markupsafe", "pydantic-core", "triton"}  # numba, jinja2, pydantic and torch are made of these
    found: dict[str, str] = {}
    for path in [*(ROOT / "toolkit").rglob("*.py"), *(ROOT / "pipelines").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            said = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            said += [node.module] if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module else []
            found |= {name.split(".")[0]: str(path) for name in said}
    known, plain = metadata.packages_distributions(), {re.sub(r"[-_.]+", "-", name).lower() for name in asked}
    assert "test" in extras and len(plain) > 15 and {"numpy", "torch", "numba"} <= set(found)
    for name in sorted(set(found) - set(sys.stdlib_module_names) - {"fieldfuse"}):
        given = {re.sub(r"[-_.]+", "-", one).lower() for one in known.get(name, [name])}
        assert given & plain, f"{name} is imported in {found[name]}, and nothing that setup.cfg asks for brings it"
