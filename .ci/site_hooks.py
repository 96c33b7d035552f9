"""Hooks of mkdocs: pages in the repository's root join the site, and headings get the anchors that they have on GitHub."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"README.md": "overview.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
LINK = re.compile(r"\[([^]]*)\]\(([^)\s]+)\)")


def slug(text: str, separator: str = "-") -> str:
    """The anchor of a heading: lower case, no marks, a hyphen for each space."""
    return re.sub(r"[^\w\- ]", "", text.lower()).strip().replace(" ", separator)


def relinked(text: str, folder: str) -> str:
    """Markdown of a page whose links start in `folder` of the repository, with links from the site's page in the same place.

    Pages of the root go to their place in the site; of links to code only the text stays.
    """
    here = folder.removeprefix("docs").strip("/")

    def link(match: re.Match[str]) -> str:
        words, target = match.groups()
        path, mark, anchor = target.partition("#")
        if not path or "://" in path:
            return match[0]
        place = posixpath.normpath(posixpath.join(folder, path))
        page = PAGES.get(place, place.removeprefix("docs/") if place.startswith("docs/") else None)
        return words if page is None else f"[{words}]({posixpath.relpath(page, here or '.')}{mark}{anchor})"

    return LINK.sub(link, text)


def on_config(config: Any) -> Any:
    config.mdx_configs.setdefault("toc", {})["slugify"] = slug
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=relinked((ROOT / name).read_text(encoding="utf-8"), "")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    name = page.file.src_uri
    return markdown if name in PAGES.values() else relinked(markdown, posixpath.dirname(f"docs/{name}"))
