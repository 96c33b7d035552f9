"""Where the files are that a capture lists, when its paths are of another machine, another program or another folder.

What a json or a model lists is looked up below the capture's folder, and nowhere else: as it stands, else by what remains of it when the
folder was moved or renamed and names were spelled anew (letter case, Unicode form, `%20`, underscores for spaces, another extension).
All files that were listed in one folder are looked for together. Two folders that serve equally well are refused, not guessed between.
"""

from __future__ import annotations

import os
import posixpath
import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote

from fieldfuse import files
from fieldfuse.capture.listing import IMAGES, counted, is_file, some_of
from fieldfuse.errors import InputError, brief

MAX_FILES = 200_000
MAX_DEPTH = 6
MAX_PLACES = 2_000_000  # files in all that have a name looked for: more are no capture
RUN = "run.json"  # what a run writes into its own folder, whose renders have the images' names
SMALLER = re.compile(r"(images?|frames|rgb|input)_(2|4|8|16)")  # the same images made smaller
BESIDE = re.compile(r"mask|depth|disp|normal|semantic|segment|label|confid|thumb|preview")  # folders of what belongs to images and is none
DEPTH, MASK, POINTS = re.compile("depth|disp"), re.compile("mask|segment|alpha"), re.compile("")
SAME, CASE, SUFFIX, UNDERSCORES = range(4)  # how far a file's name is from the listed one


@dataclass
class Found:
    """Files in the order of the listed names; None where there is none."""

    files: list[Path | None]
    remarks: list[str] = field(default_factory=list)  # on what was found otherwise than listed; at most one a kind
    outside: int = 0  # paths that lead outside the capture's folder, where none of their folder was found inside

    @property
    def count(self) -> int:
        return sum(path is not None for path in self.files)


@dataclass(frozen=True)
class _Name:
    """A listed path in parts, folded; `folder` is empty for a bare name."""

    listed: str
    folder: tuple[str, ...]
    name: str
    foreign: str  # why its folder means nothing here, else empty

    @classmethod
    def of(cls, base: str, listed: str) -> _Name:
        """Steps up that lead out are dropped, what stands behind them remains."""
        slashes = listed.replace("\\", "/")
        foreign = "are of another machine" if re.match(r"/|[A-Za-z][A-Za-z+.-]*:", slashes) else ""
        parts: list[str] = []
        for part in ("" if foreign else base + "/").split("/") + slashes.split("/"):
            if part == "..":
                foreign = foreign or ("" if parts else "lead out of the capture's folder")
                parts = parts[:-1]
            elif part not in ("", "."):
                parts.append(part)
        return cls(listed, tuple(map(_fold, parts[:-1])), parts[-1] if parts else "", foreign)


@dataclass
class _Search:
    """One call of `CaptureFiles.find`."""

    source: str  # what lists the names, for messages
    kind: re.Pattern[str] | None
    used: set[Path]  # files that stand for a name already
    twice: set[str] = field(default_factory=set)  # keys of names that are listed in several folders


class CaptureFiles:
    """All files below a capture's folder, listed once and only when a path is not found as it stands."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._looked = 0

    def find(
        self,
        names: Sequence[str],
        *,
        source: str,
        base: str = "",
        anywhere: bool = True,
        kind: re.Pattern[str] | None = None,
        taken: Collection[Path] = (),
    ) -> Found:
        """The files that `names` stand for, each file for one name.

        Args:
            names: paths as listed, relative to `base` below the root.
            source: what lists them, for messages.
            anywhere: also in other folders than the listed ones.
            kind: for what is no image (DEPTH, MASK, POINTS): the word by which its folder is known where it has another name.
            taken: files that stand for something else.
        """
        parsed = [_Name.of(base, listed) for listed in dict.fromkeys(names)]
        chosen = {name.listed: exact for name in parsed if (exact := self._exact(base, name.listed)) is not None}
        at_home = {name.folder for name in parsed if name.listed in chosen}
        groups: dict[tuple[str, ...], list[_Name]] = defaultdict(list)
        folders_of: dict[str, set[tuple[str, ...]]] = defaultdict(set)
        for name in parsed:
            if name.listed not in chosen:
                groups[name.folder].append(name)
                folders_of[_key(name.name)].add(name.folder)
        # Of two folders (`cam1/1.jpg`, `cam2/1.jpg`) one alone left might be either.
        search = _Search(source, kind, {*chosen.values(), *taken}, {key for key, of in folders_of.items() if len(of) > 1})
        moved: list[tuple[_Name, str]] = []
        spelled: list[tuple[_Name, str]] = []
        outside = 0
        for folder, group in groups.items():
            before = len(chosen)
            for name, place, quality in self._relocated(search, folder, group, anywhere and folder not in at_home):
                path = files.inside(self.root, place)
                search.used.add(path)
                chosen[name.listed] = path
                if name.foreign or _folded(posixpath.dirname(place)) != folder:
                    moved.append((name, posixpath.dirname(place)))
                elif quality in (CASE, SUFFIX):
                    spelled.append((name, posixpath.basename(place)))
            outside += sum(bool(name.foreign) for name in group) if len(chosen) == before else 0
        return Found([chosen.get(name) for name in names], _remarks(moved, spelled, search), outside)

    def none_exists(self, source: str, count: int, found: Found) -> InputError:
        """That none of the `count` images that `source` lists is there, with what is there instead."""
        held = [(folder, [name for name in names if _split(name)[1]]) for folder, names in self._listing.items()]
        there = [f"{folder or '.'}/ holds {counted(len(names), 'image')} ({names[0]}, …)" for folder, names in held if names]
        what = "put them there or correct the paths"
        if found.outside:
            what = "and their paths lead outside the capture folder; give the folder that holds both, or correct the paths"
        text = f"none of the {counted(count, 'image')} listed in {source} exists below {self.root}{',' if found.outside else ';'} {what}"
        return InputError(f"{text}; {', '.join(there[:2])}" if there else text)

    def find_beside(
        self, listed: Sequence[str | None], kind: re.Pattern[str], taken: Collection[Path], source: str, base: str = ""
    ) -> tuple[list[Path | None], list[str]]:
        """The files of a kind (DEPTH, MASK, POINTS) that belong to images, in the order of `listed`, and remarks."""
        found = self.find([name for name in listed if name is not None], source=source, base=base, kind=kind, taken=taken)
        there = iter(found.files)
        return [None if name is None else next(there) for name in listed], found.remarks

    def folders(self) -> list[str]:
        """Folders below the root, itself among them, relative to it: those of fewest parts first."""
        return sorted(self._listing, key=lambda folder: (len(_parts(folder)), folder))

    @cached_property
    def _listing(self) -> dict[str, list[str]]:
        """Folder → names of its files. What is hidden, a run's own folder and linked folders are left out."""
        out: dict[str, list[str]] = {}
        count = 0
        for place, children, names in os.walk(self.root):
            relative = Path(place).relative_to(self.root)
            if RUN in names and relative.parts:
                children.clear()
                continue
            deep = len(relative.parts) >= MAX_DEPTH
            children[:] = [] if deep else sorted(name for name in children if not name.startswith((".", "__MACOSX")))
            out[relative.as_posix() if relative.parts else ""] = [name for name in sorted(names) if not name.startswith(".")]
            count += len(names) + 1
            if count > MAX_FILES:
                break
        return out

    @cached_property
    def _by_key(self) -> dict[tuple[str, str], list[tuple[str, str]]]:
        """Folder and name of files by the name of their folder and their key, and by their key alone (under an empty folder's name)."""
        out: dict[tuple[str, str], list[tuple[str, str]]] = defaultdict(list)
        for folder, names in self._listing.items():
            last = _last(_folded(folder) or _folded(self.root.name))
            for name in names:
                for place in {last, ""}:
                    out[place, _key(name)].append((folder, name))
        return out

    def _exact(self, base: str, name: str) -> Path | None:
        slashes = name.replace("\\", "/")
        for spelling in dict.fromkeys((name, slashes, unquote(slashes))):
            relative = posixpath.join(base, spelling)
            try:
                path = files.inside(self.root, relative)
            except InputError:
                if Path(os.path.normpath(self.root / relative)).is_relative_to(self.root):
                    raise  # it is a link, or no path at all
                continue  # the text itself leads outside
            if is_file(path):
                return path
            for suffix in () if _split(path.name)[1] else IMAGES:
                for variant in (suffix, suffix.upper()):
                    if is_file(candidate := Path(f"{path}{variant}")):
                        return files.inside(self.root, str(candidate))
        return None

    def _relocated(
        self, search: _Search, listed: tuple[str, ...], group: list[_Name], elsewhere: bool
    ) -> Iterable[tuple[_Name, str, int]]:
        """Names of one listed folder with the place of their file below the root, and how far its name is from the listed one."""
        ranks: dict[str, tuple[int, int, int]] = {}
        hits: dict[str, dict[str, tuple[str, int]]] = defaultdict(dict)  # folder → listed name → file's name and distance
        for name in group:
            key = _key(name.name)
            alike = self._by_key.get((_last(listed), key)) or self._by_key.get(("", key), [])
            self._looked += len(alike)
            if self._looked > MAX_PLACES:
                raise InputError(f"{self.root} holds too many files of the same names as those in {search.source}; give one capture")
            by_folder: dict[str, list[str]] = defaultdict(list)
            for folder, file in alike:
                by_folder[folder].append(file)
            for folder, candidates in by_folder.items():
                if folder not in ranks:
                    ranks[folder] = _rank(listed, _folded(folder), self.root)
                related = ranks[folder][0] > 0
                if not self._eligible(search, name, folder, related, elsewhere) or (key in search.twice and not related):
                    continue
                if (best := self._nearest(search, name, folder, candidates)) is not None:
                    hits[folder][name.listed] = best
        left = {name.listed: name for name in group}
        for rank in sorted({ranks[folder] for folder in hits}, reverse=True):
            level = {folder: {one: hit for one, hit in hits[folder].items() if one in left} for folder in hits if ranks[folder] == rank}
            places_of: dict[str, list[str]] = defaultdict(list)
            for folder, found in level.items():
                for listed_name in found:
                    places_of[listed_name].append(folder)
            decided: dict[tuple[str, ...], str | None] = {}
            for listed_name, places in places_of.items():
                if tuple(places) not in decided:
                    decided[tuple(places)] = self._one_of(search, places, level, left[listed_name])
                place = decided[tuple(places)]
                if place is not None:
                    file, quality = level[place][listed_name]
                    yield left.pop(listed_name), posixpath.join(place, file), quality
            if rank[0]:  # in a folder of the listed name; what is not there may be anything elsewhere
                return

    @staticmethod
    def _eligible(search: _Search, name: _Name, folder: str, related: bool, elsewhere: bool) -> bool:
        """Whether a listed file may lie in this folder: in its own, in any `related` one, or in one whose name does not exclude it."""
        folded = _folded(folder)
        if name.folder == folded or not elsewhere:
            return name.folder == folded
        if search.kind is not None:
            return related or search.kind.search("/".join((*folded, _fold(name.name)))) is not None
        return not any(BESIDE.search(part) and part not in name.folder for part in folded)

    def _nearest(self, search: _Search, name: _Name, folder: str, candidates: list[str]) -> tuple[str, int] | None:
        """The file of `folder` whose name is nearest to the listed one; None for none, or several with spaces for underscores."""
        free = [file for file in candidates if self.root / folder / file not in search.used]
        graded = sorted((_distance(name.name, file), _suffix_order(file), file) for file in free)
        if not graded:
            return None
        quality, order, file = graded[0]
        if len(graded) > 1 and graded[1][:2] == (quality, order):
            if quality == UNDERSCORES:
                return None
            raise InputError(
                f"{self.root}: {brief(repr(name.listed))}, listed in {search.source}, may be {file} or {graded[1][2]} of {folder or '.'}/; "
                "remove or rename the other"
            )
        return file, quality

    def _one_of(self, search: _Search, places: list[str], level: dict[str, dict[str, tuple[str, int]]], name: _Name) -> str | None:
        """The folder that a name is taken from: the one that also serves all other names which any of them serves."""
        best, *others = sorted(places, key=lambda folder: (-len(level[folder]), *_usual(folder), folder))
        for other in others:
            more = level[best].keys() > level[other].keys()
            same_images = level[best].keys() >= level[other].keys() and _usual(best) < _usual(other)
            if not more and not same_images:
                if search.kind is not None:
                    return None
                raise InputError(
                    f"{self.root}: {brief(repr(name.listed))}, listed in {search.source}, may be the one in {best or '.'}/ or in "
                    f"{other or '.'}/; give the folder that belongs to it, or correct the paths"
                )
        return best


def _parts(path: str) -> tuple[str, ...]:
    return tuple(part for part in path.split("/") if part)


def _fold(part: str) -> str:
    """The one spelling in which names are compared."""
    return re.sub(r"\s+", "_", _plain(part).casefold())


def _folded(path: str) -> tuple[str, ...]:
    return tuple(map(_fold, _parts(path)))


def _plain(part: str) -> str:
    return unicodedata.normalize("NFC", unquote(part))


def _without_factor(folder: str) -> str:
    match = SMALLER.fullmatch(folder)
    return match[1] if match else folder


def _last(folders: tuple[str, ...]) -> str:
    return _without_factor(folders[-1]) if folders else ""


def _key(name: str) -> str:
    return _fold(_split(name)[0])


def _split(name: str) -> tuple[str, str]:
    """Stem and suffix of a file's name; the suffix is empty where it is not an image's."""
    stem, suffix = posixpath.splitext(name)
    return (stem, suffix) if suffix.lower() in IMAGES else (name, "")


def _suffix_order(file: str) -> int:
    suffix = _split(file)[1].lower()
    return IMAGES.index(suffix) if suffix else 0


def _distance(listed: str, file: str) -> int:
    """How far a file's name is from the listed one: SAME to UNDERSCORES. A listed name may go without its suffix."""
    (stem, suffix), (other, others) = _split(_plain(listed)), _split(_plain(file))
    if stem.casefold() != other.casefold():
        return UNDERSCORES
    if suffix and suffix.lower() != others.lower():
        return SUFFIX
    return SAME if stem == other and suffix in ("", others) else CASE


def _rank(listed: tuple[str, ...], folder: tuple[str, ...], root: Path) -> tuple[int, int, int]:
    """How much of a listed folder is left in one of the capture: folders at the end of both, those of the very name, those of any place."""
    both = exact = 0
    for one, two in zip(reversed(listed), reversed((*map(_fold, root.parts), *folder)), strict=False):
        if _without_factor(one) != _without_factor(two):
            break
        both, exact = both + 1, exact + (one == two)
    return both, exact, len({_without_factor(part) for part in listed} & {_without_factor(part) for part in folder})


def _usual(folder: str) -> tuple[int, int]:
    """Order of folders that hold images of the same names: `images`, then the same made smaller, by how much; else none."""
    parent, name = posixpath.split(folder)
    match = SMALLER.fullmatch(name.lower())
    if name.lower() == "images" or (match and match[1] == "images"):
        return (0 if not parent else 1), int(match[2]) if match else 1
    return 2, 0


def _remarks(moved: list[tuple[_Name, str]], spelled: list[tuple[_Name, str]], search: _Search) -> list[str]:
    what, out = "image" if search.kind is None else "listed file", []
    if moved:
        where = some_of(list(dict.fromkeys(f"{place or '.'}/" for _, place in moved)))
        foreign = all(name.foreign for name, _ in moved)
        why = f"since the paths listed in {search.source} {moved[0][0].foreign}" if foreign else f"where {search.source} does not list them"
        out.append(f"{counted(len(moved), f'{what} was', f'{what}s were')} found by their names in {where}, {why}")
    if spelled:
        name, file = spelled[0]
        count = counted(len(spelled), f"{what} was", f"{what}s were")
        listed = brief(repr(posixpath.basename(name.listed.replace("\\", "/"))))
        out.append(f"{count} found under another spelling than in {search.source} (letter case or extension): {file} for {listed}")
    return out
