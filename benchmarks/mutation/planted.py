"""A throw-away copy of a checkout, in which one fault at a time is planted and tests are run."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmarks.mutation.choose import Imports
from benchmarks.mutation.faults import Fault

LEFT = (".git", ".venv", "build", "dist", "demo", ".hypothesis", ".mypy_cache", ".ruff_cache", ".pytest_cache")
COMPILED = re.compile(r"\bnjit\b|@compiled\b")  # of files with kernels that numba keeps on disk
FAILED = re.compile(r"^(?:FAILED|ERROR) (tests/\S+?)(?: - .*)?$", re.MULTILINE)

# The copy's own packages come before those that the interpreter has installed.
FINDER = """
import sys
from importlib.util import spec_from_file_location

PLACES = {places!r}


class Finder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        place = PLACES.get(name)
        return place and spec_from_file_location(name, place + "/__init__.py", submodule_search_locations=[place])


sys.meta_path.insert(0, Finder)
"""


def place_of(fault: Fault, checkout: Path, files: Sequence[str]) -> tuple[str, str, str] | None:
    """(file, text, what it becomes) of the first of a fault's anchors that stands exactly once in `files` of a checkout."""
    contents = {name: (checkout / name).read_text(encoding="utf-8") for name in files}
    for text, becomes in fault.anchors:
        places = [name for name, content in contents.items() for _ in range(content.count(text))]
        if len(places) == 1:
            return places[0], text, becomes
    return None


class Copy:
    """A copy of `checkout` in `folder`, whose tests `python` runs."""

    def __init__(self, checkout: Path, folder: Path, python: Path) -> None:
        self.path, self.python = folder / "copy", python
        shutil.copytree(checkout, self.path, ignore=shutil.ignore_patterns(*LEFT), symlinks=True)
        self.imports = Imports(self.path)
        places = {"fieldfuse": "toolkit", "fieldfuse.pipelines": "pipelines", "fieldfuse.configs": "configs"}
        (folder / "first").mkdir()
        text = FINDER.format(places={name: str(self.path / place) for name, place in places.items()})
        (folder / "first" / "sitecustomize.py").write_text(text, encoding="utf-8")
        self.environment = {**os.environ, "PYTHONPATH": f"{folder / 'first'}{os.pathsep}{self.path}", "PYTHONHASHSEED": "0"}
        self.environment.pop("PYTHONDONTWRITEBYTECODE", None)

    def find(self, fault: Fault) -> tuple[str, str, str] | None:
        """`place_of` in the copy."""
        return place_of(fault, self.path, self.imports.product)

    @contextmanager
    def planted(self, name: str, text: str, becomes: str) -> Iterator[None]:
        """`text` in the file `name` replaced while the context is open."""
        path = self.path / name
        before, times = path.read_text(encoding="utf-8"), path.stat()
        path.write_text(before.replace(text, becomes), encoding="utf-8")
        os.utime(path, (times.st_atime, times.st_mtime + 10))  # another time than before, also where the size is the same
        self._forget_kernels(name)
        try:
            yield
        finally:
            path.write_text(before, encoding="utf-8")
            os.utime(path, (times.st_atime, times.st_mtime))
            self._forget_kernels(name)

    def _forget_kernels(self, name: str) -> None:
        """Kernels on disk that may hold what is compiled of a file: numba looks only at the file that a kernel itself lies in."""
        if not COMPILED.search((self.path / name).read_text(encoding="utf-8")):
            return
        for user in self.imports.distances(name):
            place = self.path / user
            for kernel in (place.parent / "__pycache__").glob(f"{place.stem}.*.nb[ic]"):
                kernel.unlink()

    def run(self, tests: list[str], seconds: float, marked: str) -> tuple[str | None, bool]:
        """The first test that fails, or None; and whether all of them were run."""
        command = [str(self.python), "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no", "-rfE"]
        process = subprocess.Popen(
            [*command, *(["-m", marked] if marked else []), *tests],
            cwd=self.path,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            text, _ = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            text, _ = process.communicate()
            return None, False
        failed = FAILED.search(text)
        if failed:
            return failed[1], True
        if process.returncode not in (0, 5):  # 5: nothing to run
            return f"{tests[0]} (exit code {process.returncode})", True
        return None, True
