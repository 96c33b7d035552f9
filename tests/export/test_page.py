"""The page with a field in it: what is packed, what it refuses, and in a browser the same pictures as the baked field's own."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fieldfuse.camera import Array, pixel_grid, rays
from fieldfuse.errors import InputError
from fieldfuse.evaluation.sphere import around, lens
from fieldfuse.export.page import Tour, decoder_blocks, page, require_page, write_page
from fieldfuse.nerfusion.decoder import Deferred, make_decoder
from fieldfuse.render.bake import BakedField, bake, stored_corners
from fieldfuse.render.composite import ray_sum
from fieldfuse.render.field import Field
from fieldfuse.render.image import SOLID, Rendered
from fieldfuse.render.march import march
from fieldfuse.render.rays import _median_distance, shade
from fieldfuse.render.sky import on_sky
from fieldfuse.tone import brighter, decode, encode
from tests.evaluation.driven import Driven, until
from tests.render.made import coloured_field, random_field

WIDTH, HEIGHT = 48, 36
CAMERA, POSES = lens(WIDTH, HEIGHT), around()
SLOWEST = 600.0  # seconds that a page may take on any machine
SKY = torch.linspace(-0.3, 0.5, 27).reshape(9, 3)


def tour(names: list[str] | None = None) -> Tour:
    names = names or [f"photo {index}" for index in range(len(POSES))]
    test = np.arange(len(POSES)) % 4 == 0
    return Tour(names, [CAMERA] * len(POSES), np.array(POSES), test, np.array(POSES), 3.0, start=1)


def slow_densities(field: BakedField) -> dict[tuple[int, int, int, int], int]:
    """(block, z, y, x) of a corner → its byte, voxel by voxel."""
    out, arrays, number = {}, field.arrays, 0
    for slot in range(len(arrays.base)):
        for z in range(8):
            for bit in range(64):
                if int(arrays.bits[slot, z]) >> bit & 1:
                    for corner in range(8):
                        place = (slot, z + (corner >> 2), (bit >> 3) + (corner >> 1 & 1), (bit & 7) + (corner & 1))
                        out[place] = int(arrays.packed[number]) >> 8 * corner & 255
                    number += 1
    return out


def test_densities_of_corners_are_those_of_their_voxels() -> None:
    baked = bake(random_field(0.0, 16, keep=0.3))
    got, expected = baked.corner_densities(), slow_densities(baked)
    order = sorted(expected)  # corners are stored block by block, row by row
    assert len(got) == len(order) and got.tolist() == [expected[place] for place in order]


def test_decoder_blocks_are_the_decoder() -> None:
    """Matrices of four by four, column by column, multiplied as the shader does."""
    baked = bake(random_field())
    small, large = decoder_blocks(baked)
    given = np.random.default_rng(0).normal(size=32).astype(np.float32)
    given[8:16] = 0  # this field has eight features
    width = 24  # of 16 hidden units: a multiple of twelve
    first = small[: width // 4 * 8 * 16].reshape(-1, 8, 4, 4)
    hidden = np.einsum("jicr,ic->jr", first, given.reshape(8, 4)).reshape(-1)
    d = baked.decoder
    expected = d.w1_out[:, :8] @ given[:8] + d.w1_out[:, 8:] @ given[16:]
    assert np.allclose(hidden[:16], expected, atol=1e-5) and not hidden[16:].any()
    second = np.einsum("jicr,ic->jr", large.reshape(width // 4, width // 4, 4, 4), hidden.reshape(-1, 4)).reshape(-1)
    assert np.allclose(second[:16], d.w2_out @ hidden[:16], atol=1e-4)


def slow_values(keys: Array, stored: Array, differences: Array) -> Array:
    """(R, C + 1) of every stored corner, one after the other, from what is written of it."""
    known: dict[tuple[int, ...], Array] = {}  # by place in space
    out, written = [], iter(differences.T.astype(int))
    for key, corners in zip(keys.astype(int), stored.reshape(-1, 9, 9, 9), strict=True):
        inside: dict[tuple[int, ...], Array] = {}
        for z, y, x in np.argwhere(corners).tolist():
            place = (*(8 * key[::-1] + [z, y, x]).tolist(),)
            if place not in known:
                steps = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1))
                a, b, c, ab, ac, bc, abc = (inside.get((z - k, y - j, x - i)) for i, j, k in steps)
                sides = [value for value in (a, b, c) if value is not None]
                flat = [three for three in ((a, b, ab), (a, c, ac), (b, c, bc)) if all(value is not None for value in three)]
                guess: Any = 0
                if all(value is not None for value in (a, b, c, ab, ac, bc, abc)):
                    guess = np.floor((10 * (a + b + c) - 5 * (ab + ac + bc) + abc) / 16 + 0.5)
                elif flat:
                    guess = np.floor((3 * (flat[0][0] + flat[0][1]) - 2 * flat[0][2]) / 4 + 0.5)
                elif sides:
                    guess = np.floor(sum(sides) / len(sides) + 0.5)
                known[place] = (np.clip(guess, 0, 255).astype(int) + next(written)) % 256
            inside[z, y, x] = known[place]
            out.append(known[place])
    assert next(written, None) is None
    return np.array(out)


@pytest.mark.parametrize("made", [coloured_field(), random_field(1.0, 32, keep=0.02)])
def test_what_is_packed_is_the_field(made: Field) -> None:
    baked = bake(made)
    text = page(baked, tour(), "sphere")
    about = json.loads(re.search(r'id="about">(.*?)</script>', text, re.DOTALL)[1])  # type: ignore[index]
    blob = zlib.decompress(base64.b64decode(re.search(r'id="field">(.*?)</script>', text, re.DOTALL)[1]))  # type: ignore[index]
    found, offset = {}, 0
    for name, kind, count in about["arrays"]:
        found[name] = np.frombuffer(blob, kind, count, offset)
        offset += -(-found[name].nbytes // 4) * 4
    assert offset == len(blob)
    keys = found["keys"].reshape(-1, 3)
    values = slow_values(keys, stored_corners(baked.arrays.rows), found["values"].reshape(about["channels"] + 1, -1))
    assert np.array_equal(values[:, :-1], baked.arrays.feature) and np.array_equal(values[:, -1], baked.corner_densities())
    x, y, z = keys.T
    assert np.array_equal(baked.arrays.table[z, y, x], np.arange(len(baked.arrays.base)))
    assert about["start"] == 1 and [photo["test"] for photo in about["photos"]][:2] == [True, False]


def test_a_page_asks_nobody_for_anything() -> None:
    text = page(bake(coloured_field()), tour(), "sphere")
    assert not re.search(r'(?:src|href)\s*=\s*["\']|https?://|@import|fetch\(|XMLHttpRequest|WebSocket', text)


def test_text_of_others_stays_text() -> None:
    text = page(bake(coloured_field()), tour(["</script><b>", *"abcdefg"][: len(POSES)]), "</title><script>alert(1)</script>")
    assert "<script>alert" not in text and "</script><b>" not in text
    assert text.count("</title>") == 1


@pytest.mark.parametrize(("channels", "hidden"), [(17, 16), (8, 97)])
def test_what_does_not_fit_is_told(channels: int, hidden: int) -> None:
    field = replace(random_field(), decoder=make_decoder("deferred", channels, hidden))
    with pytest.raises(InputError, match=f"up to 16 features and 96 hidden units, and this field has {channels} and {hidden}; leave page"):
        require_page(field)


def test_the_papers_decoder_is_told() -> None:
    with pytest.raises(InputError, match="deferred decoder"):
        require_page(random_field(decoder="per_sample"))


def loaded(browser: Driven) -> None:
    """Wait for the field; what the page tells instead is an error."""
    until(lambda: browser.run("!!window.fieldfuse || !document.getElementById('told').textContent.startsWith('Unpacking')"), SLOWEST)
    assert browser.run("document.getElementById('told').textContent") == ""


def opened(browser: Driven, page: Path, width: int = 160, height: int = 120, phone: bool = False, dots: float = 1) -> None:
    """The page in a window of this size, with so many dots for each of its pixels; errors of the one before are forgotten."""
    browser.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=dots, mobile=phone)
    browser.ask("Page.navigate", url=page.as_uri())
    browser.errors.clear()
    loaded(browser)


def seen(browser: Driven, pose: Array) -> Array:
    """(H, W, 3) what the page draws for a camera."""
    numbers, view = pose[:3].reshape(-1).tolist(), [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]
    script = f"btoa(String.fromCharCode(...fieldfuse.picture({numbers}, {view}, {WIDTH}, {HEIGHT})))"
    return np.frombuffer(base64.b64decode(browser.run(script)), np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]


def wide_decoder() -> Deferred:
    torch.manual_seed(3)
    decoder = Deferred(8, 96)
    with torch.no_grad():
        for layer in decoder.layers:
            layer.weight.normal_(0, 1.5 / layer.in_features**0.5)
    return decoder


FIELDS = {
    "a box": coloured_field(),
    "a shell and a sky": replace(coloured_field(1.0), sky=SKY),
    "few features, holes": random_field(1.0, 32, keep=0.4),
    "as wide as may be": replace(random_field(1.0, 32, keep=0.4), decoder=wide_decoder()),
}


@torch.no_grad()
def drawn(baked: BakedField, pose: Array, stop: float = 1e-2, threshold: float = 5e-3) -> Rendered:
    """What the shader draws, in torch: a ray ends where 1% of its light is left, and samples with less than 0.5% of it lend no colour."""
    field = baked.to_field()
    origins, directions, cosine = rays(CAMERA, pose, pixel_grid(WIDTH, HEIGHT))
    samples, count = march(field.grid, origins, directions, field.near, field.fine), len(origins)
    shown = shade(field, samples, directions, threshold=threshold, stop=stop)
    left = torch.exp(-ray_sum(shown.thickness * (shown.transmittance >= stop), samples.ray, count))
    opacity = torch.where(left < stop, 1.0, 1 - left)
    own = shown.colour / shown.opacity.clamp_min(1e-6)[:, None]
    colour = torch.where(shown.opacity[:, None] > 0, own * opacity[:, None] + (1 - opacity[:, None]) * field.background, field.background)
    colour = on_sky(colour.clamp(0, 1), opacity, directions, field.background, field.sky)
    depth = torch.where(opacity >= SOLID, _median_distance(samples, shown, count) * cosine, 0.0)
    return Rendered(colour.view(HEIGHT, WIDTH, 3).numpy(), depth.view(HEIGHT, WIDTH).numpy(), opacity.view(HEIGHT, WIDTH).numpy())


@pytest.mark.parametrize("name", FIELDS)
def test_a_browser_draws_what_the_baked_field_is(name: str, browser: Driven, tmp_path: Path) -> None:
    baked = bake(FIELDS[name])
    write_page(tmp_path / "field.html", baked, tour(), name)
    opened(browser, tmp_path / "field.html")
    for pose in POSES[:3]:
        expected = drawn(baked, pose)
        assert expected.rgb.std() > 0.05
        off = np.abs(seen(browser, pose) - 255 * expected.rgb)
        # Where a sample falls on the edge between two voxels it is either's, by the last digit.
        assert np.median(off) < 0.6 and (off > 2).mean() < 0.01, (name, off.max())
        told = browser.run(f"[...fieldfuse.field.told(fieldfuse.field.target({WIDTH}, {HEIGHT}), {WIDTH // 2}, {HEIGHT // 2 - 1})]")
        depth, opacity = expected.depth[HEIGHT // 2, WIDTH // 2], expected.opacity[HEIGHT // 2, WIDTH // 2]
        if opacity > 0.5:
            assert told[:2] == pytest.approx([depth, opacity], abs=2e-3 * float(depth))
    assert not browser.errors


@pytest.mark.parametrize("exposure", [1.8, 0.7])
def test_a_browser_draws_it_as_bright_as_the_pictures_were(exposure: float, browser: Driven, tmp_path: Path) -> None:
    baked = bake(coloured_field())
    write_page(tmp_path / "field.html", baked, replace(tour(), exposure=exposure), "bright")
    opened(browser, tmp_path / "field.html")
    plain = np.clip(drawn(baked, POSES[1]).rgb, 0, 1)
    expected = 255 * encode(brighter(decode(plain), exposure))
    assert np.abs(expected - 255 * plain).mean() > 10
    off = np.abs(seen(browser, POSES[1]) - expected)
    assert np.median(off) < 0.8 and (off > 3).mean() < 0.01, off.max()
    assert not browser.errors


KEYS = "document.getElementById('keys')"


def test_the_keys_are_explained_on_a_phone_too(browser: Driven, tmp_path: Path) -> None:
    """Held either way: the panel stays within the screen, and its words are no column of single ones."""
    write_page(tmp_path / "field.html", bake(coloured_field()), tour(), "sphere")
    opened(browser, tmp_path / "field.html", 390, 700, phone=True)
    browser.run("document.getElementById('help').click()")
    for width, height in ((390, 700), (700, 320)):
        browser.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=True)
        until(lambda size=width: browser.run("innerWidth") == size)
        box = browser.run(f"(box => [box.left, box.top, box.right, box.bottom])({KEYS}.getBoundingClientRect())")
        assert box[0] >= 0 and box[1] >= 0 and box[2] <= width and box[3] <= height, box
        assert browser.run(f"{KEYS}.querySelector('dd').clientWidth") > 120


def test_a_visitor_walks(browser: Driven, tmp_path: Path) -> None:
    write_page(tmp_path / "field.html", bake(coloured_field()), tour(), "sphere")
    opened(browser, tmp_path / "field.html", 520, 257, dots=0.5)  # a processor draws a hundred thousand rays in ten seconds

    def pose() -> list[float]:
        return list(browser.run("[...fieldfuse.walker.pose.place, ...fieldfuse.walker.pose.turn.flat()]"))

    def rests() -> Array:
        until(lambda: browser.run("!fieldfuse.rough && fieldfuse.todo === 0 && !fieldfuse.walker.journey"), SLOWEST)
        return browser.picture()[30:-40].astype(int)

    start, first = pose(), rests()
    assert first.std() > 10
    browser.drag((300, 160), (380, 160))
    dragged = pose()
    pivot = np.linalg.norm(np.array(start[:3]) + 3 * np.array(start[9:]) - np.array(dragged[:3]) - 3 * np.array(dragged[9:]))
    assert dragged != start and pivot < 1e-6  # about what is in the middle
    assert np.abs(rests() - first).mean() > 1
    browser.drag((300, 160), (340, 160), shift=True)
    turned = pose()
    assert turned[:3] == dragged[:3] and turned[9:] != dragged[9:]  # on the spot
    browser.drag((340, 160), (300, 160), shift=True)
    assert pose() == pytest.approx(dragged, abs=1e-6)  # and back
    browser.ask("Input.dispatchMouseEvent", type="mouseWheel", x=300, y=160, deltaX=0, deltaY=-150)  # of dots, and a dot is two pixels
    until(lambda: pose()[:3] != dragged[:3])
    near = np.linalg.norm(np.array(pose()[:3]) - np.array(dragged[:3]))
    assert 0.5 < near < 1.5
    browser.run("document.getElementById('after').click()")
    assert browser.run("document.getElementById('name').textContent") == "photo 2"
    rests()
    assert pose()[:3] == pytest.approx(POSES[2][:3, 3].tolist(), abs=1e-5)
    for kind in ("keyDown", "keyUp"):
        browser.ask("Input.dispatchKeyEvent", type=kind, key="w")
        until(lambda: pose()[:3] != pytest.approx(POSES[2][:3, 3].tolist(), abs=1e-5))
    browser.run("document.getElementById('fly').click()")
    flying = pose()
    until(lambda: pose() != flying)
    browser.run("document.getElementById('fly').click()")
    colours = rests()
    browser.run("const s = document.getElementById('show'); s.value = 'depth'; s.onchange()")
    assert np.abs(rests() - colours).mean() > 10
    assert not browser.errors


def test_a_browser_without_webgl_is_told(browser: Driven, tmp_path: Path) -> None:
    text = page(bake(coloured_field()), tour(), "sphere").replace("getContext('webgl2'", "getContext('none'")
    (tmp_path / "field.html").write_text(text, encoding="utf-8")
    browser.ask("Page.navigate", url=(tmp_path / "field.html").as_uri())
    sentence = "This page draws with WebGL 2, which this browser"
    until(lambda: browser.run(f"document.getElementById('told')?.textContent.startsWith('{sentence}')"))
