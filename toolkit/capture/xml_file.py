"""Small XML files that may come from anybody: without a document type (and so without entities that grow), bounded in size and depth."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from fieldfuse.capture.listing import MAX_TEXT_BYTES
from fieldfuse.errors import InputError, first_line

MAX_ELEMENTS, MAX_DEPTH = 1_000_000, 64


def read_xml(path: Path) -> Element:
    """The root element. Names keep their prefixes (`xcr:Position`).

    Raises:
        InputError: missing, too large, not well-formed, with a document type, or nested too deeply.
    """
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    depth = count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_DEPTH or count > MAX_ELEMENTS:
            raise InputError(f"{path} holds more than {MAX_ELEMENTS} elements, or nests them too deeply; export the cameras alone")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise InputError(f"{path} declares a document type, which no export of cameras has; remove it")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        if path.stat().st_size > MAX_TEXT_BYTES:
            raise InputError(f"{path} is larger than {MAX_TEXT_BYTES / 2**20:.0f} MB; export the cameras alone")
        parser.Parse(path.read_bytes(), True)
        return builder.close()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"{path} is not well-formed XML ({first_line(error)}); export it again") from error


def starts_with(path: Path, *words: bytes, within: int = 4096) -> bool:
    """Whether all `words` stand in the first bytes of a file; False where it cannot be read."""
    try:
        with path.open("rb") as stream:
            head = stream.read(within)
    except OSError:
        return False
    return all(word in head for word in words)
