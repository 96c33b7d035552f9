"""What the README and the docs name exists."""

from __future__ import annotations

import configparser
import importlib
import re
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
import typer

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def where(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub makes them: lower case, no marks, a hyphen for each space, a number for each that was there before."""
    found: dict[str, int] = {}
    names = set()
    for heading in re.findall(r"^#{1,6} +(.+?) *#*$", page.read_text(encoding="utf-8"), re.MULTILINE):
        text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
        before = found.get(name, 0)
        found[name] = before + 1
        names.add(f"{name}-{before}" if before else name)
    return names


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if link.startswith(("http://", "https://")):
            continue
        target, _, anchor = link.partition("#")
        leads = (page.parent / target).resolve() if target else page
        assert leads.is_relative_to(ROOT) and leads.exists(), link
        if "#" in link:
            assert leads.suffix == ".md" and anchor in anchors(leads), link


def test_anchors_are_those_of_headings(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# What `make test` holds: it's [a link](x.md)\n\n    # a comment\n\n## Again\n\n### Again\n", encoding="utf-8")
    assert anchors(page) == {"what-make-test-holds-its-a-link", "again", "again-1"}


def test_every_page_is_in_the_index() -> None:
    index = ROOT / "docs" / "README.md"
    named = {(index.parent / link).resolve() for link in LINK.findall(index.read_text(encoding="utf-8"))}
    assert {page for page in PAGES if page != index} <= named


def test_pages_that_the_code_names_exist() -> None:
    for folder in ("toolkit", "pipelines", "configs", "benchmarks", "tests"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".yaml", ".j2", ".js", ".html"):
                for page in re.findall(r"\bdocs/[\w/]+\.md", path.read_text(encoding="utf-8")):
                    assert (ROOT / page).exists(), (path, page)


@pytest.mark.parametrize("page", PAGES, ids=where)
def test_commands_and_options_exist(page: Path) -> None:
    from fieldfuse.pipelines.cli import app

    commands = typer.main.get_command(app)
    text = page.read_text(encoding="utf-8")
    for line in re.findall(r"fieldfuse ((?:run|info|poses|tsdf|finetune|render|view|export|evaluate|doctor)\b[^\n`|#]*)", text):
        name, *words = line.split()
        known = {option for parameter in commands.commands[name].params for option in (*parameter.opts, *parameter.secondary_opts)}  # type: ignore[attr-defined]
        for word in words:
            if word.startswith("--") and not word.endswith(".sh"):
                assert word.split("=")[0].rstrip(",;.)") in known, line
    for name, rest in re.findall(r"python -m benchmarks\.(\w+)([^\n`|#]*)", text):
        options = {option for parameter in benchmark(name).params for option in parameter.opts}
        assert {word.split("=")[0] for word in rest.split() if word.startswith("--")} <= options, f"{name}{rest}"
    for name in re.findall(r"`make ([a-z]+)`", text):
        assert f"\n{name}:" in (ROOT / "Makefile").read_text(encoding="utf-8"), name


def benchmark(name: str) -> typer.core.TyperCommand:
    """Its command line."""
    command = typer.main.get_command(importlib.import_module(f"benchmarks.{name}").app)
    assert isinstance(command, typer.core.TyperCommand)
    return command


def test_every_benchmark_is_in_the_docs() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    names = [path.stem for path in (ROOT / "benchmarks").glob("*.py") if "\napp = application(" in path.read_text(encoding="utf-8")]
    assert len(names) > 8
    for name in names:
        assert f"python -m benchmarks.{name}" in text, name


def test_every_command_is_in_the_readme() -> None:
    from fieldfuse.pipelines.cli import app

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in typer.main.get_command(app).commands:  # type: ignore[attr-defined]
        assert f"`fieldfuse {name}" in readme, name


def test_settings_that_the_docs_name_exist() -> None:
    from fieldfuse.config import load_settings, settings_dict

    data = settings_dict(load_settings("balanced"))
    groups = {group for group, value in data.items() if isinstance(value, dict)}
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"\b([a-z]+)\.([a-z_]+)=", text))
    named |= {pair for pair in re.findall(r"`([a-z]+)\.([a-z_]+)`", text) if pair[0] in groups}
    assert named
    for group, name in named:
        assert name in data[group] or name in ("json", "html", "safetensors"), f"{group}.{name}"


def test_places_in_the_tree_exist() -> None:
    folders = "toolkit|pipelines|configs|benchmarks|tests|examples"
    for page in PAGES:
        for place in re.findall(rf"`((?:{folders})/[\w./]*)`", page.read_text(encoding="utf-8")):
            assert (ROOT / place).exists(), f"{place} in {where(page)}"


def test_the_architecture_page_has_the_layers_of_the_contract() -> None:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    contract = [re.findall(r"\w+", line) for line in parser["importlinter:contract:flow"]["layers"].strip().splitlines()]
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]*) \|", text, re.MULTILINE)
    assert [re.findall(r"\w+", row) for row in rows] == contract
    for package in parser["options"]["packages"].split():
        path = package.removeprefix("fieldfuse.").replace(".", "/")
        assert "/" not in path or f"`{path}/`" in text, package


def test_the_site_has_every_page() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = {ROOT / "docs" / name for name in re.findall(r": ([\w/]+\.md)", text.partition("\nnav:\n")[2])}
    spec = spec_from_file_location("site_hooks", ROOT / ".ci" / "site_hooks.py")
    assert spec is not None and spec.loader is not None
    hooks = module_from_spec(spec)
    spec.loader.exec_module(hooks)
    added = {ROOT / "docs" / place: ROOT / page for page, place in hooks.PAGES.items()}
    assert set(added) <= named
    assert sorted(added.get(page, page) for page in named) == sorted(PAGES)
    assert hooks.relinked("[a](docs/look.md#x) [b](setup.cfg) [c](https://d)", "") == "[a](look.md#x) b [c](https://d)"
    assert hooks.relinked("[a](../../README.md) [b](../look.md)", "docs/measured") == "[a](../overview.md) [b](../look.md)"


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    for tool in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(tool)
    links = tmp_path / "build" / "links" / "fieldfuse"
    links.mkdir(parents=True)
    for place in (*(ROOT / "toolkit").iterdir(), ROOT / "pipelines", ROOT / "configs"):
        (links / place.name).symlink_to(place)
    for name in ("docs", ".ci", "toolkit", "mkdocs.yml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        (tmp_path / name).symlink_to(ROOT / name)
    done = subprocess.run([sys.executable, "-m", "mkdocs", "build", "--strict"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "fuse_tsdf" in (tmp_path / "build" / "site" / "api" / "index.html").read_text(encoding="utf-8")


def test_scripts_parse() -> None:
    for script in (".ci/run", ".ci/system_libraries.sh"):
        done = subprocess.run(["bash", "-n", str(ROOT / script)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
