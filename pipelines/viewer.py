"""A field in the browser, by viser: each visitor's camera is rendered here, small while it moves, whole when it rests.

The page shows the working frame (z up); the training cameras stand in it, and a click on one looks through it.
"""

from __future__ import annotations

import io
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.poses import rigid
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.evaluation.pictures import depth_picture, depth_range
from fieldfuse.export.cameras import transforms
from fieldfuse.export.surface import spread
from fieldfuse.files import write_json
from fieldfuse.pipelines.prepare import Prepared
from fieldfuse.pipelines.render_path import read_cameras
from fieldfuse.pipelines.rendered import to_picture

if TYPE_CHECKING:
    import viser

MOST_CAMERAS = 150  # that are drawn
FRUSTUM = 0.06  # of the median depth
LINE = 0.03  # thickness of a camera's lines, in its own size
TRAINING, HELD_OUT = (40, 110, 200), (230, 120, 30)
MOVING_SECONDS = 0.08  # that a render may take while the camera moves
REST = 0.15  # seconds without a movement after which a camera rests
GOODBYE = 0.5  # seconds after which it shows whether what failed was the connection
NOTHING = 160.0  # depth where nothing is; viser's images hold 167 at most
COLOURS, DEPTH, OPACITY = "colours", "depth", "opacity"
SMALLEST = 64  # pixels of a long side


@dataclass(frozen=True)
class Shown:
    """What is to be seen.

    Attributes:
        render: lens and pose (4, 4, working frame) → `Rendered`.
        cameras: the file for cameras that visitors save, in the input's frame; those that it has stay in it.
    """

    name: str
    render: Callable[[Intrinsics, Array], Any]
    ready: Prepared
    cameras: Path

    def save_camera(self, lens: Intrinsics, pose: Array) -> int:
        """Add a camera (working frame) to the file; answers how many it has.

        Raises:
            InputError: the file that is there holds no cameras.
            OutputError: it cannot be written.
        """
        names, lenses, poses = read_cameras(self.cameras) if self.cameras.is_file() else ([], [], np.zeros((0, 4, 4)))
        mine = self.ready.scene.working_from_input.inverse().poses(pose[None])
        names = [*names, f"view_{len(names):04d}"]
        write_json(self.cameras, transforms(names, [*lenses, lens], np.concatenate([poses, mine])))
        return len(names)


def require_server(host: str) -> None:
    """
    Raises:
        InputError: viser, which is an extra, is not installed; or nothing can be served at `host`.
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise InputError(
            "the viewer needs the package viser, which is not installed; run `pip install 'viser>=1'`, or open DIR/report.html and the mesh"
        ) from error
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise InputError(f"nothing can be served at --host {host} ({error.strerror or error}); try 127.0.0.1") from error


class Live:
    """The server. A context: it stops serving at the end."""

    def __init__(self, shown: Shown, host: str, port: int, image_size: int) -> None:
        """`image_size`: long side in pixels of a render at rest. `require_server` must have passed."""
        import viser

        self.shown, self.image_size = shown, image_size
        self.rendering = threading.Lock()  # the kernels' threads are shared
        self._saving = threading.Lock()
        self.failed: BaseException | None = None
        self.ends = threading.Event()
        self._visitors: dict[int, Visitor] = {}
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # a visitor left while a render was made
        with redirect_stdout(io.StringIO()):  # viser's own box with its addresses
            self.server = viser.ViserServer(host=host, port=port, label=f"Fieldfuse: {shown.name}", verbose=False)
        self.port = self.server.get_port()
        self.address = f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0', '::') else host}:{self.port}"
        self._furnish()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._farewell)

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        for visitor in list(self._visitors.values()):
            visitor.leave()
        with redirect_stdout(io.StringIO()):  # "Server stopped"
            self.server.stop()

    def wait(self) -> None:
        """Until Ctrl-C. Handlers of its own: what a shell starts in the background ignores Ctrl-C otherwise.

        Raises:
            whatever went wrong while a render was made.
        """
        signals: list[int] = []
        before = {number: signal.signal(number, lambda number, _: signals.append(number)) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            while not signals and not self.ends.wait(0.2):
                pass
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        if self.failed is not None:
            raise self.failed

    def _furnish(self) -> None:
        """Controls, the capture's cameras, and where a visitor begins: at the first of them."""
        gui, scene, views = self.server.gui, self.server.scene, self.shown.ready.views
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        scene.set_up_direction("+z")
        self.what = gui.add_dropdown("Show", (COLOURS, DEPTH, OPACITY))
        self.side = gui.add_slider("Pixels at rest", min=SMALLEST, max=max(1600, self.image_size), step=16, initial_value=self.image_size)
        hint = "Blue: training views; orange: held out. A click looks through one."
        cameras = gui.add_checkbox("Cameras", initial_value=False, hint=hint)
        for control in (self.what, self.side):
            control.on_update(self._renew)
        gui.add_button("Keep this camera", hint="For `fieldfuse render --cameras`.").on_click(self._save_camera)
        self.status = gui.add_markdown("")
        frustums = [self._frustum(index) for index in spread(len(views), MOST_CAMERAS)]

        @cameras.on_update
        def _(_: Any) -> None:
            for frustum in frustums:
                frustum.visible = cameras.value

        first = views.world_from_camera[0]
        start = self.server.initial_camera
        start.position = first[:3, 3]
        start.look_at = first[:3, 3] + self.shown.ready.scene.median_depth * first[:3, 2]
        start.fov = _fov(views.intrinsics[0])

    def _frustum(self, index: int) -> viser.CameraFrustumHandle:
        from viser.transforms import SO3

        views, size = self.shown.ready.views, FRUSTUM * self.shown.ready.scene.median_depth
        lens, pose = views.intrinsics[index], np.asarray(views.world_from_camera[index], dtype=np.float64)
        frustum = self.server.scene.add_camera_frustum(
            f"/cameras/{index:04d}",
            _fov(lens),
            lens.width / lens.height,
            scale=size,
            thickness=LINE * size,
            color=HELD_OUT if views.test[index] else TRAINING,
            wxyz=np.asarray(SO3.from_matrix(pose[:3, :3]).wxyz),
            position=pose[:3, 3],
            visible=False,
        )

        @frustum.on_click
        def _(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.wxyz = frustum.wxyz
                event.client.camera.position = frustum.position
                event.client.camera.fov = _fov(lens)

        return frustum

    def _save_camera(self, event: Any) -> None:
        camera = event.client.camera
        lens, pose = lens_of(camera.fov, camera.aspect, int(self.side.value)), pose_of(camera.wxyz, camera.position)
        try:
            with self._saving:
                self.status.content = f"{self.shown.save_camera(lens, pose)} in `{self.shown.cameras}`"
        except FieldfuseError as error:
            self.status.content = str(error)

    def _renew(self, _: Any) -> None:
        for visitor in list(self._visitors.values()):
            visitor.moved.set()

    def _welcome(self, client: viser.ClientHandle) -> None:
        self._visitors[client.client_id] = visitor = Visitor(self, client)
        client.camera.on_update(lambda _: visitor.moved.set())

    def _farewell(self, client: viser.ClientHandle) -> None:
        visitor = self._visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()


class Visitor:
    """One browser, and the thread that renders for it."""

    def __init__(self, live: Live, client: viser.ClientHandle) -> None:
        self.live, self.client = live, client
        self.moved = threading.Event()
        self.moved.set()
        self._left = False
        self._per_pixel = 1e-6  # seconds, learnt as it goes
        threading.Thread(target=self._run, name=f"visitor-{client.client_id}", daemon=True).start()

    def leave(self) -> None:
        """Nothing is rendered for it any more."""
        self._left = True
        self.moved.set()

    def _run(self) -> None:
        try:
            while not self._left:
                self.moved.wait()
                self.moved.clear()
                whole = int(self.live.side.value)
                small = int(np.clip((MOVING_SECONDS / self._per_pixel) ** 0.5, SMALLEST, whole))
                self._show(small)
                if small < whole and not self.moved.wait(REST) and not self._left:
                    self._show(whole)
        except BaseException as error:  # a thread's own would be lost
            time.sleep(GOODBYE)
            if not self._left:
                self.live.failed = error
                self.live.ends.set()

    def _show(self, long_side: int) -> None:
        """Render what the camera sees, and send it."""
        if self._left:
            return
        camera = self.client.camera
        lens = lens_of(camera.fov, camera.aspect, long_side)
        with self.live.rendering:
            begin = time.perf_counter()
            rendered = self.live.shown.render(lens, pose_of(camera.wxyz, camera.position))
            self._per_pixel = (time.perf_counter() - begin) / (lens.width * lens.height)
        depth = np.where(rendered.depth > 0, rendered.depth, NOTHING)
        self.client.scene.set_background_image(image_of(rendered, self.live.what.value), format="jpeg", jpeg_quality=85, depth=depth)


def lens_of(fov: float, aspect: float, long_side: int) -> Intrinsics:
    """A pinhole camera by its vertical opening angle (radians) and width over height."""
    height, width = (long_side / aspect, long_side) if aspect >= 1 else (long_side, long_side * aspect)
    height, width = max(1, round(height)), max(1, round(width))
    focal = height / 2 / np.tan(fov / 2)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def image_of(rendered: Any, what: str) -> Array:
    """(H, W, 3) uint8: colours, depth or opacity."""
    if what == DEPTH:
        return depth_picture(rendered.depth, depth_range([rendered.depth]))
    if what == OPACITY:
        return np.repeat((np.clip(rendered.opacity, 0, 1) * 255 + 0.5).astype(np.uint8)[..., None], 3, axis=2)
    return to_picture(rendered).rgb


def pose_of(wxyz: Any, position: Any) -> Array:
    """(4, 4) world_from_camera of a viewer's camera, whose axes are ours."""
    return rigid(np.asarray(wxyz, dtype=np.float64), np.asarray(position, dtype=np.float64), "the viewer's camera")


def _fov(lens: Intrinsics) -> float:
    """Vertical opening angle in radians."""
    return float(2 * np.arctan(lens.height / 2 / lens.fy))
