"""What the README and the docs name exists."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
import typer

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    from pipelines.cli import app

    commands = typer.main.get_command(app)
    text = page.read_text(encoding="utf-8")
    for line in re.findall(r"fieldfuse ((?:run|info|poses|tsdf|finetune|render|view|export|evaluate|doctor)\b[^\n`|#]*)", text):
        name, *words = line.split()
        known = {option for parameter in commands.commands[name].params for option in (*parameter.opts, *parameter.secondary_opts)}  # type: ignore[attr-defined]
        for word in words:
            if word.startswith("--") and not word.endswith(".sh"):
                assert word.split("=")[0].rstrip(",;.)") in known, line
    for name in re.findall(r"`make ([a-z]+)`", text):
        assert f"\n{name}:" in (ROOT / "Makefile").read_text(encoding="utf-8"), name


def test_every_command_is_in_the_readme() -> None:
    from pipelines.cli import app

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in typer.main.get_command(app).commands:  # type: ignore[attr-defined]
        assert f"`fieldfuse {name}" in readme, name


def test_settings_that_the_docs_name_exist() -> None:
    from toolkit.config import load_settings, settings_dict

    data = settings_dict(load_settings("balanced"))
    groups = {group for group, value in data.items() if isinstance(value, dict)}
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"\b([a-z]+)\.([a-z_]+)=", text))
    named |= {pair for pair in re.findall(r"`([a-z]+)\.([a-z_]+)`", text) if pair[0] in groups}
    assert named
    for group, name in named:
        assert name in data[group] or name in ("json", "html", "safetensors"), f"{group}.{name}"


def test_places_in_the_tree_exist() -> None:
    for place in re.findall(r"`((?:toolkit|pipelines|configs)/[\w./]*)`", (ROOT / "README.md").read_text(encoding="utf-8")):
        assert (ROOT / place).exists(), place


def test_scripts_parse() -> None:
    for script in (".ci/run", ".ci/system_libraries.sh"):
        done = subprocess.run(["bash", "-n", str(ROOT / script)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
