"""What a visitor of the page can do, in a browser: measure, crop, keep views, share one, plan a path; all of it in the input's frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Intrinsics, Similarity, project
from fieldfuse.config import crop_box
from fieldfuse.export.page import write_page
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.pipelines.render_path import path_fps, read_cameras
from fieldfuse.render.bake import bake
from fieldfuse.render.field import Field
from fieldfuse.render.paths import look_at
from fieldfuse.training.levels import NewField, all_places
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space
from tests.evaluation.driven import Driven, until
from tests.export.test_page import opened, tour

FRAME = Similarity(1.6, Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix(), np.array([0.4, -0.3, 0.2]))
LENS, SIDE = Intrinsics(800, 600, 750.0, 750.0, 400.0, 300.0), 1.0
LATTICE = 128
WINDOW = (800, 600, False, 0.2)  # of few dots: a processor draws them
LOOK = "[fieldfuse.walker.pose.place, ...fieldfuse.walker.pose.turn]"
RESTS = "!fieldfuse.rough && fieldfuse.todo === 0 && !fieldfuse.walker.journey"


def solid_box(shell: float) -> Field:
    """A cube of `SIDE` about zero, that no light passes."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    space = Space((0.0, 0.0, 0.0), 1.0, shell)
    places = all_places(space, LATTICE)
    voxel = 2 * space.extent / LATTICE
    half = round(SIDE / 2 / voxel)
    middle = LATTICE // 2
    places = places[((places >= middle - half) & (places < middle + half)).all(1)]
    new = NewField(space, LATTICE, make_decoder("deferred", 16, 24), torch.tensor([0.9, 0.2, 0.4]))
    field = new.on(places, TorchHost(), 8.0, generator)
    assert 2 * half * voxel == pytest.approx(SIDE)
    return replace(field, near=0.01)


def poses() -> Array:
    """From before and behind, from the left, and from above."""
    places = np.array([[0.1, -3.0, 0.2], [0.1, 3.0, 0.2], [-3.0, 0.0, 0.1], [0.5, -0.9, 2.5]])
    return look_at(places, places * [[1, 0, 1], [1, 0, 1], [0, 1, 1], [0, 0, 0]], np.array([0, 0, 1.0]))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    views = replace(
        tour(),
        names=list("abcd"),
        lenses=[LENS] * 4,
        poses=poses(),
        test=np.zeros(4, bool),
        start=2,
        working_from_input=FRAME,
        metric=True,
    )
    path = tmp_path_factory.mktemp("page") / "field.html"
    write_page(path, bake(solid_box(0.0)), views, "a box")
    return path


@pytest.fixture
def open_page(browser: Driven, page: Path) -> Driven:
    """As it opens: loaded again only where a test left it."""
    if browser.run("location.href") == page.as_uri() and not browser.run("window.drawn"):
        browser.run("fieldfuse.tools.open(null), fieldfuse.tools.points = [], fieldfuse.to(2)")
        until(lambda: browser.run("!fieldfuse.walker.journey"))
    else:
        opened(browser, page, *WINDOW)
    return browser


def standing(browser: Driven) -> Array:
    """(4, 3) place, right, down, forward."""
    until(lambda: browser.run("!fieldfuse.walker.journey"))
    return np.array(browser.run(LOOK))


def click(browser: Driven, place: Array) -> None:
    browser.drag((float(place[0]), float(place[1])), (float(place[0]), float(place[1])), 1)


def test_it_begins_at_the_view_that_it_is_given(open_page: Driven) -> None:
    assert np.allclose(standing(open_page), [poses()[2][:3, 3], *poses()[2][:3, :3].T], atol=1e-6)
    assert open_page.run("document.getElementById('name').textContent") == "c"


def test_what_is_measured_is_metres(open_page: Driven) -> None:
    """Across the cube, from a point on one face to the one across, each clicked in a view of its own."""
    open_page.run("document.getElementById('show').focus(), fieldfuse.tools.open('measure')")
    wanted = np.array([[0.05, -SIDE / 2, 0.1], [0.05, SIDE / 2, 0.1]])
    for view, point in enumerate(wanted):
        open_page.run(f"fieldfuse.to({view})")
        standing(open_page)
        click(open_page, project(LENS, poses()[view], point[None])[0][0])
    points = np.array(open_page.run("fieldfuse.tools.points"))
    assert np.abs(points - wanted).max() < 0.02
    assert open_page.run("fieldfuse.tools.length") == pytest.approx(SIDE / FRAME.scale, rel=0.02)
    number, unit = open_page.run("document.getElementById('length').textContent").split()
    assert unit == "cm" and float(number) == pytest.approx(100 * SIDE / FRAME.scale, rel=0.02)
    assert open_page.run("document.querySelectorAll('#over line, #over text').length") == 2
    click(open_page, np.array([100, 200]))  # past the cube
    assert "Nothing solid" in open_page.run("document.getElementById('told').textContent")
    assert not open_page.errors


@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_a_crop_is_the_box_of_its_numbers(shell: float, browser: Driven, page: Path, tmp_path: Path) -> None:
    """Rays begin where they enter the box: depth is that of its face, or of the field behind it."""
    if shell:
        page = tmp_path / "field.html"
        views = replace(tour(), lenses=[LENS] * 8, poses=np.concatenate([poses(), poses()]), working_from_input=FRAME)
        write_page(page, bake(solid_box(shell)), views, "a box")
    opened(browser, page, *WINDOW)
    browser.run("fieldfuse.tools.open('crop')")
    middle = FRAME.inverse().points(np.zeros(3))
    low, high = middle - 0.16, middle + np.array([0.4, 0.16, 0.27])
    for axis, name in enumerate("xyz"):
        for side, value in enumerate((low[axis], high[axis])):
            browser.run(f"(i => {{ i.value = {value:.4f}; i.onchange({{target: i}}); }})(document.getElementById('{name}{side}'))")
    text = str(browser.run("document.getElementById('numbers').textContent"))
    box = crop_box(text.removeprefix('--crop "').removesuffix('"'))
    assert box is not None and np.allclose(box, [low, high], atol=1e-4)
    turn, place = FRAME.rotation.T / FRAME.scale, FRAME.inverse()
    above = poses()[3]
    for x, y in ((400, 300), (350, 330), (475, 250), (440, 330)):
        ray = above[:3, :3] @ [(x + 0.5 - LENS.cx) / LENS.fx, (y + 0.5 - LENS.cy) / LENS.fy, 1.0]
        view = f"{above[:3].reshape(-1).tolist()}, [750, 750, {400 - x}, {300 - y}], 1, 1"
        depth = browser.run(f"(fieldfuse.picture({view}), fieldfuse.field.told(fieldfuse.field.target(1, 1), 0, 0)[0])")
        enter, leave = 0.0, np.inf
        cube = (above[:3, 3], ray, np.full(3, -SIDE / 2), np.full(3, SIDE / 2))
        for origin, way, least, most in ((place.points(above[:3, 3]), turn @ ray, low, high), cube):
            one, two = (least - origin) / way, (most - origin) / way
            enter, leave = max(enter, np.minimum(one, two).max()), min(leave, np.maximum(one, two).min())
        assert enter < leave and depth == pytest.approx(enter, abs=1.2 / LATTICE * (1 + shell)), (x, y)  # to the middle of a step
    browser.run("document.getElementById('cut').click()")
    assert browser.run("fieldfuse.crop === null")
    assert not browser.errors


def test_a_face_of_the_box_follows_the_hand(open_page: Driven) -> None:
    open_page.run("fieldfuse.tools.open('crop')")
    before = np.array(open_page.run("fieldfuse.tools.region"))
    at = open_page.run("['cx', 'cy'].map(name => Number(document.querySelector('[data-face=\"1 0\"]').getAttribute(name)))")
    stands = standing(open_page)
    open_page.drag((at[0], at[1]), (at[0] - 12, at[1] + 9))
    after = np.array(open_page.run("fieldfuse.tools.region"))
    moved = after != before
    assert moved.sum() == 1 and moved[0, 1] and open_page.run("fieldfuse.crop !== null")
    assert np.allclose(standing(open_page), stands)


def test_a_link_leads_to_the_view(open_page: Driven, page: Path) -> None:
    open_page.run("fieldfuse.walker.turn(0.4, 0.2, false), fieldfuse.walker.approach(0.7)")
    shared, reach = standing(open_page), open_page.run("fieldfuse.walker.reach")
    open_page.run("document.getElementById('share').click()")
    link = str(open_page.run("location.hash"))
    assert link.startswith("#view=")
    for other in ("#view=1,2,NaN", f"#view={'9' * 400},0,0,0,0,0,1,1", ""):
        open_page.run(f"location.hash = '{other}'")
    open_page.ask("Page.navigate", url="about:blank")
    open_page.ask("Page.navigate", url=page.as_uri() + link)
    until(lambda: open_page.run("!!window.fieldfuse"))
    assert np.allclose(standing(open_page), shared, atol=1e-3)
    assert open_page.run("fieldfuse.walker.reach") == pytest.approx(reach, abs=1e-3)
    assert not open_page.errors


def test_views_are_kept(open_page: Driven, page: Path) -> None:
    submit = "document.querySelector('#views form').requestSubmit()"
    open_page.run(f"document.getElementById('title').value = 'the <b>door</b>', {submit}")
    saved = standing(open_page)
    open_page.run(f"fieldfuse.to(0), {submit}")
    opened(open_page, page, *WINDOW)
    names = "[...document.querySelectorAll('#views li button:first-child')]"
    assert open_page.run(f"{names}.map(one => one.textContent)") == ["the <b>door</b>", "View 2"]
    open_page.run("fieldfuse.to(3)")
    standing(open_page)
    open_page.run(f"{names}[0].click()")
    assert np.allclose(standing(open_page), saved, atol=1e-6)
    open_page.run("document.querySelectorAll('#views li button:last-child')[1].click()")
    assert open_page.run(f"{names}.length") == 1


def test_a_path_is_what_render_reads(open_page: Driven, tmp_path: Path) -> None:
    """Through its key views, in the input's frame; loaded again, it is the same."""
    for view in (2, 0, 3):
        open_page.run(f"fieldfuse.to({view})")
        standing(open_page)
        open_page.run("document.getElementById('add').click()")
    for key, value in (("seconds", 2), ("fps", 10)):
        open_page.run(f"document.getElementById('{key}').value = {value}")
    text = open_page.run("JSON.stringify(fieldfuse.tools.path())")
    (tmp_path / "path.json").write_text(text)
    names, lenses, got = read_cameras(tmp_path / "path.json")
    assert len(names) == 20 and path_fps(tmp_path / "path.json") == 10
    assert lenses[0].width == 1280 and lenses[0].fx * 800 / 1280 == pytest.approx(LENS.fx)
    expected = FRAME.inverse().poses(poses()[[2, 0, 3]])
    assert np.allclose(got[0], expected[0], atol=1e-6) and np.allclose(got[-1], expected[2], atol=1e-6)
    assert min(np.abs(pose - expected[1]).max() for pose in got) < 0.25
    steps = np.linalg.norm(np.diff(got[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 3 * np.median(steps)
    open_page.run("document.getElementById('closed').checked = true")
    (tmp_path / "path.json").write_text(open_page.run("JSON.stringify(fieldfuse.tools.path())"))
    round_ = read_cameras(tmp_path / "path.json")[2]
    ends = np.linalg.norm(round_[0, :3, 3] - round_[-1, :3, 3])
    assert 0 < ends < 3 * np.median(np.linalg.norm(np.diff(round_[:, :3, 3], axis=0), axis=1))
    open_page.run("document.getElementById('play').click()")
    stands = np.array(open_page.run(LOOK))
    until(lambda: not np.allclose(open_page.run(LOOK), stands))
    open_page.run("document.getElementById('play').click()")
    assert not open_page.errors


HEADSET = """
const at = x => new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1]);
const lens = new Float32Array([1.5, 0, 0, 0, 0, 2, 0, 0, 0.1, -0.2, -1, -1, 0, 0, -0.2, 0]);
const eyes = {views: [-0.03, 0.03].map(x => ({transform: {matrix: at(x)}, projectionMatrix: lens}))};
window.XRWebGLLayer = class {
  framebuffer = null;
  getViewport(eye) { return {x: eye === eyes.views[0] ? 0 : 40, y: 0, width: 40, height: 30}; }
};
const session = {
  updateRenderState: async () => {}, requestReferenceSpace: async () => ({}), frames: 0,
  requestAnimationFrame(draw) {
    if (this.frames++ < 2) setTimeout(draw, 0, 0, {getViewerPose: () => eyes});
    else setTimeout(() => this.onend(), 0);
  },
};
const xr = {isSessionSupported: async kind => kind === 'immersive-vr', requestSession: async () => session};
Object.defineProperty(navigator, 'xr', {value: xr});
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
"""


def test_a_headset_gets_a_picture_an_eye(open_page: Driven, page: Path) -> None:
    """With a stand-in for WebXR: two eyes 6 cm apart, level, in the direction in which the visitor looked."""
    assert open_page.run("document.getElementById('vr').hidden")
    added = open_page.ask("Page.addScriptToEvaluateOnNewDocument", source=HEADSET)["identifier"]
    opened(open_page, page, *WINDOW)
    open_page.ask("Page.removeScriptToEvaluateOnNewDocument", identifier=added)
    open_page.run("window.drawn = [], fieldfuse.plain = fieldfuse.draw")
    open_page.run("fieldfuse.draw = (...given) => { given[3] && drawn.push([given[0].width, given[3]]); fieldfuse.plain(...given); }")
    _, right, _, forward = standing(open_page)
    open_page.run("document.getElementById('vr').click()")
    until(lambda: open_page.run("drawn.length === 4 && !fieldfuse.away"))
    (width, left), (_, other) = open_page.run("drawn.slice(2)")
    assert np.allclose(np.subtract(other["place"], left["place"]), 0.06 * FRAME.scale * right, atol=1e-6)
    level = forward * [1, 1, 0] / np.linalg.norm(forward[:2])
    assert np.allclose(np.reshape(left["turn"], (3, 3)), [right, [0, 0, -1], level], atol=1e-6)
    assert left["lens"][0] == pytest.approx(0.75 * width) and left["lens"][2] == pytest.approx(0.45 * width)
    assert not open_page.errors
