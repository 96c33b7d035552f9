"""A page whose field is too large for one file: coarse in the page, in whole in parts beside it, which it loads as one walks."""

from __future__ import annotations

import http.server
import json
import re
import threading
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fieldfuse.camera import Array
from fieldfuse.export import page as pages
from fieldfuse.export.coarse import _shares, coarsened
from fieldfuse.export.page import SCRIPTS, page, write_page
from fieldfuse.export.parts import INDEX, PARTS
from fieldfuse.files import read_json
from fieldfuse.render.bake import BakedField, bake, occupied_voxels, stored_corners
from fieldfuse.render.field import Field, density
from fieldfuse.volume.edit import corner_nodes
from tests.evaluation.driven import Driven, until
from tests.export.test_page import FIELDS, POSES, drawn, seen, slow_values, tour
from tests.export.test_page_tools import HEADSET
from tests.render.made import coloured_field, random_field

SLOWEST = 240.0  # seconds that a page may take on a busy machine
WEB = Path(pages.__file__).with_name("web")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any field is too large for one file."""
    monkeypatch.setattr(pages, "MOST_BYTES", 250_000)
    monkeypatch.setattr(pages, "PART_BYTES", 100_000)


def large_field(shell: float = 0.0) -> Field:
    """A sphere in colours, fine enough for some parts."""
    from fieldfuse.training.levels import finer
    from fieldfuse.volume.host import TorchHost

    field = replace(FIELDS["a shell and a sky"], space=replace(coloured_field().space, shell=shell), near=0.01)
    return finer(field, field.occupied, 64, TorchHost())


@pytest.mark.parametrize(("resolution", "ratio"), [(32, 2), (32, 4), (30, 4)])
def test_a_coarser_field_stops_as_much_light(resolution: int, ratio: int) -> None:
    """Mass: density times what of the eight voxels about a corner is occupied, times a voxel's size."""
    field = random_field(0.0, resolution, keep=0.2, raw=-6.0)
    coarse = coarsened(field, ratio)
    assert coarse.resolution * ratio >= resolution and coarse.resolution % 4 == 0

    def mass(of: Field) -> float:
        return float((density(of.density_rows.double()) * _shares(of.topology, of.occupied)).sum())

    assert mass(coarse) * ratio**3 == pytest.approx(mass(field), rel=1e-3)
    assert not (coarse.density_rows[-1] or coarse.feature_rows[-1].any())


def test_a_coarser_field_is_occupied_where_the_finer_is() -> None:
    field = random_field(0.0, 32, keep=0.05)

    def places(of: Field) -> set[tuple[int, ...]]:
        row = of.occupied.nonzero().view(-1)
        local = torch.stack([row & 7, (row >> 3) & 7, (row >> 6) & 7], 1)
        return {tuple(place) for place in (of.topology.keys[row // 512].long() * 8 + local).tolist()}

    assert places(coarsened(field, 2)) == {tuple(v // 2 for v in place) for place in places(field)}


def test_what_is_even_or_rises_evenly_stays_so() -> None:
    field = random_field(0.0, 32)
    row = torch.arange(field.topology.zero_row)

    def x(of: Field) -> torch.Tensor:
        row = torch.arange(of.topology.zero_row)
        return (of.topology.keys[row // 512, 0] * 8 + (row & 7)).float()

    field.density_rows[:-1], field.feature_rows[:-1] = -2.0, x(field)[:, None].repeat(1, 8)
    coarse = coarsened(field, 2)
    used = corner_nodes(coarse.topology, coarse.occupied)
    assert torch.allclose(coarse.density_rows[:-1][used], torch.tensor(-2.0), atol=1e-4)
    inside = used & (x(coarse) > 0) & (x(coarse) < 16)
    assert torch.allclose(coarse.feature_rows[:-1][inside], 2 * x(coarse)[inside, None], atol=1e-3)
    assert len(row) and coarse.resolution == 16


def test_bytes_of_a_coarser_field_mean_the_same() -> None:
    field = large_field()
    fine = bake(field)
    coarse = bake(coarsened(field, 2), like=fine)
    assert np.array_equal(coarse.arrays.low, fine.arrays.low) and np.array_equal(coarse.arrays.thickness, fine.arrays.thickness)
    again = bake(field, like=fine)  # with steps that were worked out from what they stand for
    assert np.abs(again.arrays.packed.view(np.uint8).astype(int) - fine.arrays.packed.view(np.uint8)).max() <= 1
    assert np.array_equal(again.arrays.feature, fine.arrays.feature)


def test_a_field_that_fits_is_in_its_page_alone(tmp_path: Path) -> None:
    """As it was before there were parts: not a word of them is in it, and those of an older page go."""
    (tmp_path / PARTS).mkdir()
    for name in (INDEX, "0123456789abcdef.bin"):
        (tmp_path / PARTS / name).write_bytes(b"{}")
    baked = bake(coloured_field())
    assert write_page(tmp_path / "field.html", baked, tour(), "sphere") == [tmp_path / "field.html"]
    assert {path.name for path in tmp_path.iterdir()} == {"field.html"}
    text = (tmp_path / "field.html").read_text(encoding="utf-8")
    assert text == page(baked, tour(), "sphere") and PARTS not in text and "children" not in text and "//%" not in text
    for name in (*SCRIPTS, "march.frag", "decode.frag"):
        source = (WEB / name).read_text(encoding="utf-8")
        source = re.sub(
            r"^ *//% if parts\n(?:(?! *//%).*\n)*?(?: *//% else\n((?:(?! *//%).*\n)*?))? *//% endif\n", r"\1", source, flags=re.MULTILINE
        )
        assert source in text, name


def unpacked(path: Path, part: dict[str, Any]) -> dict[str, Array]:
    blob, offset, out = zlib.decompress((path / part["file"]).read_bytes()), 0, {}
    for name, kind, count in part["arrays"]:
        out[name] = np.frombuffer(blob, kind, count, offset)
        offset += -(-out[name].nbytes // 4) * 4
    assert offset == len(blob)
    return out


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_parts_hold_the_field(shell: float, tmp_path: Path) -> None:
    baked = bake(large_field(shell))
    files = write_page(tmp_path / "field.html", baked, tour(), "sphere")
    assert set(files) == {path for path in tmp_path.rglob("*") if path.is_file()}
    index, text = read_json(tmp_path / PARTS / INDEX), files[0].read_text(encoding="utf-8")
    about = json.loads(re.search(r'id="about">(.*?)</script>', text, re.DOTALL)[1])  # type: ignore[index]
    assert about["parts"]["field"] == index["field"] and about["parts"]["ratio"] == index["ratio"] and len(index["parts"]) > 3
    assert len(text) < 250_000 / 3 * 4 + 200_000 and f"{baked.voxels:,} voxels" in text
    own = {tuple(key): slot for slot, key in enumerate(baked.keys().tolist())}
    stored, found, next_ = stored_corners(baked.arrays.rows), set(), 0
    densities, ends = baked.corner_densities(), np.append(baked.arrays.base, baked.corners)
    for part in index["parts"]:
        arrays = unpacked(tmp_path / PARTS, part)
        keys = arrays["keys"].reshape(-1, 3).astype(int)
        slots = [own[tuple(key)] for key in (keys + part["origin"]).tolist()]
        assert slots == sorted(slots) and not found & set(slots) and len(slots) == part["blocks"]  # in Morton order, as in the field
        found |= set(slots)
        assert np.array_equal(occupied_voxels(arrays["bits"].reshape(-1, 64)), occupied_voxels(np.asarray(baked.arrays.bits)[slots]))
        values = slow_values(keys, stored[slots], arrays["values"].reshape(about["channels"] + 1, -1))
        at = np.concatenate([np.arange(ends[slot], ends[slot + 1]) for slot in slots])
        assert np.array_equal(values[:, :-1], baked.arrays.feature[at]) and np.array_equal(values[:, -1], densities[at])
        assert part["corners"] == len(at) and part["bytes"] == (tmp_path / PARTS / part["file"]).stat().st_size
        low, high = np.array(part["box"])
        side = 16 * baked.space.extent / baked.resolution
        assert np.allclose((baked.keys()[slots].min(0) * side - baked.space.extent), low) and (high > low).all()
        assert part["coarse"][0] == next_
        next_ += part["coarse"][1]
    assert len(found) == len(baked.arrays.base)


@pytest.mark.usefixtures("small")
def test_parts_of_an_older_page_go_with_it(tmp_path: Path) -> None:
    field = large_field()
    first = set(write_page(tmp_path / "field.html", bake(field), tour(), "a"))
    second = set(write_page(tmp_path / "field.html", bake(replace(field, feature_rows=-field.feature_rows)), tour(), "b"))
    assert first != second and second == {path for path in tmp_path.rglob("*") if path.is_file()}


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def served(tmp_path: Path) -> Iterator[str]:
    """Address of the test's folder, served as any static server does."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/field.html"
    server.shutdown()
    server.server_close()


# All that the message line says, which it does for a moment only.
HEARD = """window.heard = [];
addEventListener('DOMContentLoaded', () => new MutationObserver(() => heard.push(told.textContent)).observe(told, {childList: true}));"""


def opened(browser: Driven, url: str, before: str = HEARD) -> None:
    """The page, read anew, after a script of the test's own."""
    added = browser.ask("Page.addScriptToEvaluateOnNewDocument", source=before)["identifier"]
    browser.ask("Network.clearBrowserCache")
    browser.ask("Emulation.setDeviceMetricsOverride", width=160, height=120, deviceScaleFactor=1, mobile=False)
    browser.ask("Page.navigate", url="about:blank")
    browser.ask("Page.navigate", url=url)
    until(lambda: browser.run("!!window.fieldfuse?.details"), SLOWEST)
    browser.errors.clear()
    browser.ask("Page.removeScriptToEvaluateOnNewDocument", identifier=added)


def words(browser: Driven, name: str) -> str:
    return str(browser.run(f"document.getElementById('{name}').textContent"))


HERE = "fieldfuse.details.parts.filter(part => part.here).length"


def whole(browser: Driven) -> None:
    until(lambda: browser.run(f"fieldfuse.details.parts.length > 3 && {HERE} === fieldfuse.details.parts.length"), SLOWEST)


def coarse_of(field: Field, baked: BakedField, ratio: int) -> BakedField:
    return bake(coarsened(field, ratio), like=baked)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_details_come_where_the_page_is_served(shell: float, browser: Driven, served: str, tmp_path: Path) -> None:
    """From the disk the coarse field, and a sentence; from a server the field itself."""
    field = large_field(shell)
    baked = bake(field)
    write_page(tmp_path / "field.html", baked, tour(), "sphere", field)
    ratio = read_json(tmp_path / PARTS / INDEX)["ratio"]
    opened(browser, (tmp_path / "field.html").as_uri())
    assert "details load when this folder is served, as by `fieldfuse view DIR`" in words(browser, "details")
    for pose in POSES[:2]:
        expected = drawn(coarse_of(field, baked, ratio), pose)
        off = np.abs(seen(browser, pose) - 255 * expected.rgb)
        # Samples are as close as on the finer lattice beside places where nothing is.
        assert np.median(off) < 1 and off.mean() < 3, off.mean()
    assert not browser.errors
    opened(browser, served)
    whole(browser)
    for pose in POSES[:2]:
        expected, less = drawn(baked, pose), drawn(coarse_of(field, baked, ratio), pose)
        off = np.abs(seen(browser, pose) - 255 * expected.rgb)
        # In a contracted space rays are bent between the ends of steps, and more so between those of longer ones.
        assert np.median(off) < (2 if shell else 0.6) and (off > (12 if shell else 2)).mean() < 0.02, off.max()
        assert shell or off.mean() < 0.2 * 255 * np.abs(expected.rgb - less.rgb).mean()
    assert re.fullmatch(r"details: (\d+) of \1 parts", words(browser, "details"))
    assert all("404" in error for error in browser.errors)  # a browser looks for an icon


@pytest.mark.usefixtures("small")
def test_what_cannot_be_loaded_stays_coarse(browser: Driven, served: str, tmp_path: Path) -> None:
    """One part is not there, one is broken, one is another's: said once, and the others come."""
    field = large_field()
    baked = bake(field)
    write_page(tmp_path / "field.html", baked, tour(), "sphere", field)
    index = read_json(tmp_path / PARTS / INDEX)
    gone, broken, other, *rest = (tmp_path / PARTS / part["file"] for part in index["parts"])
    gone.unlink()
    broken.write_bytes(broken.read_bytes()[:3000] + b"broken" + broken.read_bytes()[3006:])
    other.write_bytes(rest[0].read_bytes())
    opened(browser, served)
    until(lambda: browser.run(f"{HERE} === {len(rest)}"), SLOWEST)
    until(lambda: "some cannot be loaded" in words(browser, "details"))
    assert browser.run("heard.filter(text => text)") == ["Some details cannot be loaded; the scene stays coarse there."]
    near, all_of_it = (
        np.abs(seen(browser, POSES[0]) - 255 * drawn(one, POSES[0]).rgb).mean() for one in (baked, coarse_of(field, baked, index["ratio"]))
    )
    assert near > 0.3 and all_of_it > 0.3  # neither is all of the picture
    browser.run("fieldfuse.to(2)")
    until(lambda: browser.run("!fieldfuse.rough && fieldfuse.todo === 0 && !fieldfuse.walker.journey"), SLOWEST)  # it goes on


@pytest.mark.usefixtures("small")
def test_a_connection_that_is_lost_is_tried_again(browser: Driven, served: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lost: list[str] = []

    def lose_first(request: Quiet) -> None:
        if request.path.endswith(INDEX) and len(lost) < 4:  # Chromium itself asks twice
            lost.append(request.path)
            request.close_connection = True  # without an answer
        else:
            http.server.SimpleHTTPRequestHandler.do_GET(request)

    monkeypatch.setattr(Quiet, "do_GET", lose_first)
    (written, *_) = write_page(tmp_path / "field.html", bake(large_field()), tour(), "sphere")
    written.write_text(written.read_text().replace("const AGAIN = 30000;", "const AGAIN = 300;"))
    opened(browser, served)
    until(lambda: "cannot be reached just now" in "".join(browser.run("heard")), SLOWEST)
    whole(browser)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    ("text", "sentence"),
    [(None, "is not beside this page"), ('{"version": 1}', "belongs to another page"), ("{", "belongs to another page")],
)
def test_a_folder_that_is_not_the_pages_is_named(text: str | None, sentence: str, browser: Driven, served: str, tmp_path: Path) -> None:
    write_page(tmp_path / "field.html", bake(large_field()), tour(), "sphere")
    if text is None:
        (tmp_path / PARTS / INDEX).unlink()
    else:
        (tmp_path / PARTS / INDEX).write_text(text)
    opened(browser, served)
    until(lambda: sentence in "".join(browser.run("heard")), SLOWEST)
    assert "details load when" in words(browser, "details")
    assert seen(browser, POSES[0]).std() > 5


@pytest.mark.usefixtures("small")
def test_the_farthest_go_where_memory_is_full(browser: Driven, served: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = large_field()
    baked = bake(field)
    write_page(tmp_path / "field.html", baked, tour(), "sphere", field)
    parts = read_json(tmp_path / PARTS / INDEX)["parts"]
    most = [max(part[name] for part in parts) for name in ("blocks", "voxels", "corners")]
    monkeypatch.setattr(pages, "DETAIL_BYTES", 2 * int(np.dot(most, [776, 8, 16])) + 100)
    write_page(tmp_path / "field.html", baked, tour(), "sphere", field)
    opened(browser, served)
    until(lambda: browser.run(f"{HERE} === 2"), SLOWEST)
    assert browser.run("fieldfuse.details.slots") == 2 < len(parts)

    def near(pose: Array) -> set[int]:
        """The two parts of which a block is nearest, of those that are ahead."""
        out = []
        for number, part in enumerate(parts):
            keys = unpacked(tmp_path / PARTS, part)["keys"].reshape(-1, 3) + np.array(part["origin"])
            middle = (keys // 2 + 0.5) * 32 / field.resolution - 1
            out.append((np.linalg.norm(middle * field.space.half - pose[:3, 3], axis=1).min(), number))
        return {number for _, number in sorted(out)[:2]}

    here = "fieldfuse.details.parts.map((part, i) => part.here ? i : -1).filter(i => i >= 0)"
    found = []
    for view in (0, 4):  # from across
        browser.run(f"fieldfuse.to({view})")
        until(lambda: browser.run("!fieldfuse.walker.journey"))
        until(lambda view=view: set(browser.run(here)) == near(POSES[view]), 60)  # type: ignore[misc]
        found.append(set(browser.run(here)))
    assert found[0] != found[1]


@pytest.mark.usefixtures("small")
def test_tools_work_on_details(browser: Driven, served: str, tmp_path: Path) -> None:
    """A point is measured on the surface, a crop cuts, a headset gets its pictures, and a link leads to its view."""
    write_page(tmp_path / "field.html", bake(large_field()), tour(), "sphere")
    opened(browser, served, HEADSET)
    whole(browser)
    point = browser.run("fieldfuse.pick(80, 60)")
    browser.run("fieldfuse.tools.open('measure'), fieldfuse.tools.pick(80, 60), fieldfuse.tools.pick(84, 60)")
    assert 0.8 < np.linalg.norm(point) < 1 and 0 < browser.run("fieldfuse.tools.length") < 1
    before = seen(browser, POSES[1])
    browser.run(
        "fieldfuse.tools.region = [[-0.2, -2, -2], [2, 2, 2]], document.getElementById('cut').checked = true, fieldfuse.tools.cropped()"
    )
    assert np.abs(seen(browser, POSES[1]).astype(int) - before).mean() > 3
    browser.run("fieldfuse.tools.open(null), document.getElementById('share').click()")
    assert str(browser.run("location.hash")).startswith("#view=")
    browser.run("window.pictures = 0, fieldfuse.plain = fieldfuse.draw")
    browser.run("fieldfuse.draw = (...given) => { given[3] && pictures++; fieldfuse.plain(...given); }")
    browser.run("document.getElementById('vr').click()")
    until(lambda: browser.run("pictures === 4 && !fieldfuse.away"), SLOWEST)
    assert all("404" in error for error in browser.errors)
