"""Damage: bytes of any file, values of JSON, headers of safetensors, chunks of PNG. All drawn from one seeded generator."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np

Rng = np.random.Generator
PNG = b"\x89PNG\r\n\x1a\n"
NUMBERS = (
    b"0", b"-0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-308", b"1e400", b"65536", b"2147483647", b"-2147483648",
    b"4294967296", b"9223372036854775807", b"18446744073709551616", b"0x10", b"1" * 400, b"1_0", b"1.5.5", b"",
)  # fmt: skip
WORDS = (
    b"../../../../etc/passwd", b"/etc/passwd", b"..", b".", b"", b"a" * 5000, b"\x00", b"\xff\xfe", b"%s%n", b"file:///etc/passwd",
    b"{{7*7}}", b"!!python/object/apply:os.system ['true']", b"__import__('os').system('true')", b"\xe2\x80\xae", b"CON",
    b"images/../../x", b"~root",
)  # fmt: skip
INTEGERS = (0, 1, 2, 7, 127, 128, 255, 256, 32767, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**63 - 1, 2**63, 2**64 - 1)
FLOATS = (0.0, -0.0, -1.0, 1e-320, 1e-30, 1e30, 3.5e38, 1e308, float("nan"), float("inf"), -float("inf"))
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 3, 2**31, 2**63, 10**400, 1e308, -1e308, 1e-320, float("nan"), float("inf"), "", "x", "../x",
    "/etc/passwd", "a" * 3000, "\u0000", "\ud800", [], [[]], {}, [0] * 300, [[1, 2], [3]], {"a": {"a": {"a": 1}}},
    "1e5", "nan", [None], 0.5, "on",
)  # fmt: skip


def damage(data: bytes, name: str, rng: Rng) -> bytes:
    """One damaged version of a file, by what it is as often as by its bytes alone."""
    if rng.random() < 0.55:
        lower = name.lower()
        if lower.endswith((".json", ".yaml", ".gltf")):
            return damaged_json(data, rng)
        if lower.endswith(".safetensors"):
            return damaged_safetensors(data, rng)
        if data.startswith(PNG):
            return damaged_png(data, rng)
        if lower.endswith((".txt", ".log", ".ply", ".obj", ".mtl", ".pfm")):
            return damaged_text(data, rng)
    return damaged_bytes(data, rng)


def _pick(rng: Rng, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def damaged_bytes(data: bytes, rng: Rng) -> bytes:
    """A few edits of the kinds that parsers trip over."""
    out = bytearray(data)
    for _ in range(1 + int(rng.geometric(0.5))):
        size = len(out)
        at = int(rng.integers(size + 1)) if rng.random() < 0.6 else min(size, int(rng.integers(64)))
        kind = int(rng.integers(9))
        if kind == 0 and size:
            out[at % size] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            out[at : at + int(rng.integers(1, 9))] = rng.bytes(int(rng.integers(0, 9)))
        elif kind == 2:
            del out[at : at + int(rng.integers(1, 200))]
        elif kind == 3:
            del out[at:]
        elif kind == 4:
            chunk = bytes(out[at : at + int(rng.integers(1, 400))])
            other = int(rng.integers(size + 1))
            out[other:other] = chunk
        elif kind == 5:
            width, order = _pick(rng, (1, 2, 4, 8)), _pick(rng, ("little", "big"))
            out[at : at + width] = (_pick(rng, INTEGERS) % 2 ** (8 * width)).to_bytes(width, order)
        elif kind == 6:
            value = _pick(rng, FLOATS)
            with np.errstate(over="ignore"):
                out[at : at + 8] = struct.pack("<d", value) if rng.random() < 0.5 else np.float32(value).tobytes()
        elif kind == 7:
            out[at:at] = _pick(rng, WORDS + NUMBERS)
        else:
            out[at:at] = bytes(int(rng.integers(1, 2000)))
    return bytes(out)


def damaged_text(data: bytes, rng: Rng) -> bytes:
    """Words replaced, removed and repeated; lines cut, doubled and swapped."""
    lines = data.split(b"\n")
    for _ in range(1 + int(rng.geometric(0.5))):
        row = int(rng.integers(len(lines)))
        words = lines[row].split(b" ")
        kind = int(rng.integers(6))
        if kind <= 2 and words:
            words[int(rng.integers(len(words)))] = _pick(rng, NUMBERS + WORDS)
            lines[row] = b" ".join(words)
        elif kind == 3:
            lines.insert(row, _pick(rng, lines))
        elif kind == 4 and len(lines) > 1:
            del lines[row]
        else:
            lines[row] = b" ".join(words[: int(rng.integers(len(words) + 1))])
    return b"\n".join(lines)


def damaged_value(value: Any, rng: Rng) -> Any:
    """Nested lists and dictionaries with one entry replaced, removed, renamed or repeated."""
    if rng.random() < 0.15 or not isinstance(value, dict | list) or not value:
        return _pick(rng, VALUES)
    if isinstance(value, list):
        out = list(value)
        at = int(rng.integers(len(out)))
        if rng.random() < 0.15:
            out = out[:at] if rng.random() < 0.5 else [*out, out[at]]
        else:
            out[at] = damaged_value(out[at], rng)
        return out
    table = dict(value)
    key = _pick(rng, list(table))
    if rng.random() < 0.15:
        other = _pick(rng, list(table)) + _pick(rng, ("", "x", "_path"))
        table[other] = table.pop(key)
    else:
        table[key] = damaged_value(table[key], rng)
    return table


def damaged_json(data: bytes, rng: Rng) -> bytes:
    """JSON that is JSON still, with other values in it; now and then nested a thousandfold."""
    if not data:
        return b"{}"
    if rng.random() < 0.02:
        return _pick(rng, (b"[", b'{"a":', b"[[", b"- ")) * int(rng.integers(1, 60_000))
    try:
        value = json.loads(data)
    except ValueError:
        return damaged_text(data, rng)
    for _ in range(1 + int(rng.geometric(0.6))):
        value = damaged_value(value, rng)
    return json.dumps(value).encode("utf-8", "surrogatepass")


def damaged_safetensors(data: bytes, rng: Rng) -> bytes:
    """Another header with its length right, so that what is behind the header is reached."""
    try:
        length = int.from_bytes(data[:8], "little")
        header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
        facts = header.get("__metadata__", {})
        if facts and rng.random() < 0.6:
            key = _pick(rng, list(facts))
            facts[key] = damaged_json(facts[key].encode(), rng).decode("utf-8", "replace")
        elif rng.random() < 0.6:
            at = _pick(rng, [key for key in header if key != "__metadata__"] or list(header))
            header[at] = damaged_value(header[at], rng)
        elif rng.random() < 0.5:
            body = damaged_bytes(body, rng)[: len(body)].ljust(len(body), b"\0")
        else:
            header = damaged_value(header, rng)
        text = json.dumps(header).encode("utf-8", "replace")
        return len(text).to_bytes(8, "little") + text + body
    except (ValueError, AttributeError, IndexError, TypeError):
        return damaged_bytes(data, rng)


def damaged_png(data: bytes, rng: Rng) -> bytes:
    """Chunks changed, moved, doubled or dropped, with check sums that are right again."""
    chunks: list[tuple[bytes, bytes]] = []
    at = len(PNG)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks:
        return damaged_bytes(data, rng)
    for _ in range(1 + int(rng.geometric(0.6))):
        at = int(rng.integers(len(chunks)))
        kind, content = chunks[at]
        choice = rng.random()
        if choice < 0.35 and kind == b"IHDR" and len(content) >= 8:
            content = struct.pack(">II", *(int(_pick(rng, INTEGERS)) % 2**31 for _ in range(2))) + content[8:]
            chunks[at] = (kind, content)
        elif choice < 0.7:
            chunks[at] = (kind, damaged_bytes(content, rng))
        elif choice < 0.8:
            chunks.insert(int(rng.integers(len(chunks))), chunks[at])
        elif choice < 0.9 and len(chunks) > 1:
            del chunks[at]
        else:
            bomb = zlib.compress(bytes(10_000_000), 9)
            chunks[at] = (_pick(rng, (b"IDAT", b"zTXt", b"iTXt", b"iCCP", b"eXIf")), b"Comment\0\0" * int(rng.integers(2)) + bomb)
    parts = [PNG]
    for kind, content in chunks:
        parts.append(struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content)))
    return b"".join(parts)
