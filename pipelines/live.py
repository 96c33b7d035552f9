"""A field in the browser, by viser: each visitor's camera is rendered here, small while it moves, whole when it rests.

The page shows the working frame (z up); the training cameras stand in it, and a click on one looks through it.
"""

from __future__ import annotations

import io
import signal
import socket
import threading
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.export.cameras import transforms
from fieldfuse.files import write_json
from fieldfuse.pipelines.render_path import read_cameras
from fieldfuse.pipelines.visitor import COLOURS, DEPTH, OPACITY, SMALLEST, Visitor, lens_of, pose_of

if TYPE_CHECKING:
    import viser

    from fieldfuse.capture.types import Views

MOST_CAMERAS = 150  # that are drawn
FRUSTUM = 0.06  # of the median depth
LINE = 0.03  # thickness of a camera's lines, in its own size
TRAINING, HELD_OUT = (40, 110, 200), (230, 120, 30)


@dataclass(frozen=True)
class Shown:
    """What is to be seen.

    Attributes:
        render: lens and pose (4, 4, working frame) → `Rendered`.
        median_depth: of the scene, working units.
        kept: the file for cameras that visitors keep, in the input's frame; those that it has stay in it.
    """

    name: str
    render: Callable[[Intrinsics, Array], Any]
    views: Views
    median_depth: float
    kept: Path
    working_from_input: Similarity

    def keep(self, lens: Intrinsics, pose: Array) -> int:
        """Add a camera (working frame) to the file; answers how many it has.

        Raises:
            InputError: the file that is there holds no cameras.
            OutputError: it cannot be written.
        """
        names, lenses, poses = read_cameras(self.kept) if self.kept.is_file() else ([], [], np.zeros((0, 4, 4)))
        mine = self.working_from_input.inverse().poses(pose[None])
        names = [*names, f"view_{len(names):04d}"]
        write_json(self.kept, transforms(names, [*lenses, lens], np.concatenate([poses, mine])))
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
        """`image_size`: long side in pixels of a picture at rest. `require_server` must have passed."""
        import viser

        self.shown, self.image_size = shown, image_size
        self.rendering = threading.Lock()  # the kernels' threads are shared
        self._keeping = threading.Lock()
        self.failed: BaseException | None = None
        self._ends = threading.Event()
        self._visitors: dict[int, Visitor] = {}
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # a visitor left while a picture was made
        with redirect_stdout(io.StringIO()):  # viser's own box with its addresses
            self.server = viser.ViserServer(host=host, port=port, label=f"Fieldfuse: {shown.name}", verbose=False)
        self.host = host
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

    @property
    def address(self) -> str:
        return f"http://{'localhost' if self.host in ('127.0.0.1', '0.0.0.0', '::') else self.host}:{self.server.get_port()}"

    def wait(self) -> None:
        """Until Ctrl-C. Handlers of its own: what a shell starts in the background ignores Ctrl-C otherwise.

        Raises:
            whatever went wrong while a picture was rendered.
        """
        asked: list[int] = []
        before = {number: signal.signal(number, lambda number, _: asked.append(number)) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            while not asked and not self._ends.wait(0.2):
                pass
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        if self.failed is not None:
            raise self.failed

    def fail(self, error: BaseException) -> None:
        """End because of `error`."""
        self.failed = error
        self._ends.set()

    def _furnish(self) -> None:
        """Controls, the capture's cameras, and where a visitor begins: at the first of them."""
        from fieldfuse.export.surface import spread

        gui, scene, views = self.server.gui, self.server.scene, self.shown.views
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        scene.set_up_direction("+z")
        self.what = gui.add_dropdown("Show", (COLOURS, DEPTH, OPACITY))
        self.side = gui.add_slider("Pixels at rest", min=SMALLEST, max=max(1600, self.image_size), step=16, initial_value=self.image_size)
        cameras = gui.add_checkbox(
            "Cameras", initial_value=False, hint="Blue: training views; orange: held out. A click looks through one."
        )
        for control in (self.what, self.side):
            control.on_update(lambda _: self.renew())
        keep = gui.add_button("Keep this camera", hint="For `fieldfuse render --cameras`.")
        keep.on_click(self._keep)
        self.told = gui.add_markdown("")
        frustums = [self._frustum(index) for index in spread(len(views), MOST_CAMERAS)]

        @cameras.on_update
        def _(_: Any) -> None:
            for frustum in frustums:
                frustum.visible = cameras.value

        first = views.world_from_camera[0]
        start = self.server.initial_camera
        start.position = first[:3, 3]
        start.look_at = first[:3, 3] + self.shown.median_depth * first[:3, 2]
        start.fov = _fov(views.intrinsics[0])

    def _frustum(self, index: int) -> viser.CameraFrustumHandle:
        views = self.shown.views
        lens, pose = views.intrinsics[index], np.asarray(views.world_from_camera[index], dtype=np.float64)
        frustum = self.server.scene.add_camera_frustum(
            f"/cameras/{index:04d}",
            _fov(lens),
            lens.width / lens.height,
            scale=FRUSTUM * self.shown.median_depth,
            thickness=LINE * FRUSTUM * self.shown.median_depth,
            color=HELD_OUT if views.test[index] else TRAINING,
            wxyz=_quaternion(pose),
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

    def _keep(self, event: Any) -> None:
        camera = event.client.camera
        lens, pose = lens_of(camera.fov, camera.aspect, int(self.side.value)), pose_of(camera.wxyz, camera.position)
        try:
            with self._keeping:
                self.told.content = f"{self.shown.keep(lens, pose)} in `{self.shown.kept}`"
        except FieldfuseError as error:
            self.told.content = str(error)

    def renew(self) -> None:
        """Everybody's picture is rendered again."""
        for visitor in list(self._visitors.values()):
            visitor.moved.set()

    def _welcome(self, client: viser.ClientHandle) -> None:
        self._visitors[client.client_id] = visitor = Visitor(self, client)
        client.camera.on_update(lambda _: visitor.moved.set())

    def _farewell(self, client: viser.ClientHandle) -> None:
        visitor = self._visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()


def _quaternion(pose: Array) -> Array:
    from viser.transforms import SO3

    return np.asarray(SO3.from_matrix(pose[:3, :3]).wxyz)


def _fov(lens: Intrinsics) -> float:
    """Vertical opening angle in radians."""
    return float(2 * np.arctan(lens.height / 2 / lens.fy))
