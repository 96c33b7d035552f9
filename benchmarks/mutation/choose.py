"""Which test files exercise a module, nearest first, by what they import."""

from __future__ import annotations

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path, PurePosixPath

PACKAGES = {"fieldfuse.pipelines": "pipelines", "fieldfuse.configs": "configs", "fieldfuse": "toolkit"}  # import name → folder
PRODUCT = ("toolkit", "pipelines")
FAR = 99


class Imports:
    """What each file of a checkout imports of it."""

    def __init__(self, checkout: Path) -> None:
        self.checkout = checkout
        self.tests = sorted(path.relative_to(checkout).as_posix() for path in (checkout / "tests").rglob("*.py"))
        self.product = sorted(path.relative_to(checkout).as_posix() for folder in PRODUCT for path in (checkout / folder).rglob("*.py"))
        self.of = cache(self._of)
        self.importers: dict[str, set[str]] = defaultdict(set)
        for name in (*self.tests, *self.product):
            for imported in self.of(name):
                self.importers[imported].add(name)

    def _of(self, name: str) -> frozenset[str]:
        found: set[str] = set()
        for node in ast.walk(ast.parse((self.checkout / name).read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found.update(self._file(alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                inner = {self._file(f"{node.module}.{alias.name}") for alias in node.names}
                found |= inner | ({self._file(node.module)} if "" in inner else set())
        return frozenset(found - {"", name})

    def _file(self, module: str) -> str:
        """The file of a module of this checkout; '' for what is none."""
        for package, folder in PACKAGES.items():
            if module == package or module.startswith(f"{package}."):
                module = folder + module.removeprefix(package)
                break
        place = module.replace(".", "/")
        return next((name for name in (f"{place}.py", f"{place}/__init__.py") if (self.checkout / name).is_file()), "")

    def distances(self, module: str) -> dict[str, int]:
        """Files that import `module`, directly (1) or through so many others."""
        out, edge, steps = {module: 0}, {module}, 0
        while edge:
            steps += 1
            edge = {other for name in edge for other in self.importers[name]} - out.keys()
            out |= dict.fromkeys(edge, steps)
        return out

    def tests_of(self, module: str, most: int) -> list[str]:
        """Up to `most` files of tests: first what is named as the module, then what imports it with the fewest steps between."""
        near, room = self.distances(module), PurePosixPath(module).parts[-2]
        stem = PurePosixPath(module).stem

        def rank(name: str) -> tuple[bool, int, bool, int, str]:
            return PurePosixPath(name).stem != f"test_{stem}", near[name], room not in name.split("/"), len(self.of(name)), name

        files = [name for name in self.tests if PurePosixPath(name).name.startswith("test_") and near.get(name, FAR) < FAR]
        return sorted(files, key=rank)[:most]
