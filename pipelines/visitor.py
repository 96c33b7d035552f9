"""One browser that looks at a field: its camera, and the thread that renders what it sees, small while it moves, whole when it rests."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.pipelines.rendered import to_picture

if TYPE_CHECKING:
    import viser

    from fieldfuse.pipelines.live import Live

MOVING_SECONDS = 0.08  # that a picture may take while the camera moves
REST = 0.15  # seconds without a movement after which a camera rests
GOODBYE = 0.5  # seconds after which it is known whether what failed was the connection
NOTHING = 160.0  # depth where nothing is; viser's pictures know 167 at most
COLOURS, DEPTH, OPACITY = "colours", "depth", "opacity"
SMALLEST = 64  # pixels of a long side


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
                self.live.fail(error)

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
        self.client.scene.set_background_image(picture(rendered, self.live.what.value), format="jpeg", jpeg_quality=85, depth=depth)


def lens_of(fov: float, aspect: float, long_side: int) -> Intrinsics:
    """A pinhole camera by its vertical opening angle (radians) and width over height."""
    height, width = (long_side / aspect, long_side) if aspect >= 1 else (long_side, long_side * aspect)
    height, width = max(1, round(height)), max(1, round(width))
    focal = height / 2 / np.tan(fov / 2)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def picture(rendered: Any, what: str) -> Array:
    """(H, W, 3) uint8 of what was asked for."""
    from fieldfuse.evaluation.pictures import depth_picture, depth_range

    if what == DEPTH:
        return depth_picture(rendered.depth, depth_range([rendered.depth]))
    if what == OPACITY:
        return np.repeat((np.clip(rendered.opacity, 0, 1) * 255 + 0.5).astype(np.uint8)[..., None], 3, axis=2)
    return to_picture(rendered).rgb


def pose_of(wxyz: Any, position: Any) -> Array:
    """(4, 4) world_from_camera of a viewer's camera, whose axes are ours."""
    from fieldfuse.capture.poses import rigid

    return rigid(np.asarray(wxyz, dtype=np.float64), np.asarray(position, dtype=np.float64), "the viewer's camera")
