"""What the simulator knows about the light of a capture: its held-out pictures in canonical colour, and the corrections that are exact.

A fit without corrections is scored, otherwise, against pictures that have the very drift and vignetting it was fitted to, and a darkened
corner hides errors: only against the same pictures can fits with different corrections be compared.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.types import Capture
from fieldfuse.effects.correct import Corrections
from fieldfuse.effects.listed import parse
from fieldfuse.files import atomic_path, read_json
from fieldfuse.simulate.capture_files import TRUTH
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import prepare
from fieldfuse.tone import Tone

LIGHT = ("motion_blur", "vignetting", "exposure", "sensor_noise", "compression")  # what a canonical picture is free of
CANONICAL = f"{TRUTH}/canonical"


def known_light(place: Path, capture: Capture, test: Array) -> Corrections:
    """The corrections of exposure and vignetting that undo exactly what was simulated: nothing that looks at pictures can do better."""
    told: dict[str, Any] = read_json(place / TRUTH / "effects.json")
    corner = told["effects"].get("vignetting", {}).get("corner")
    if "exposure" not in told["effects"]:
        return Corrections(corner=corner)
    gain = _gains(place)
    exact = gain / _usual(gain, test)
    named = {frame.name: (float(r), float(g), float(b)) for frame, (r, g, b) in zip(capture.frames, exact, strict=True)}
    return Corrections(gain=named, corner=corner)


def _gains(place: Path) -> Array:
    """(F, 3) what each frame's light was multiplied by."""
    told: dict[str, Any] = read_json(place / TRUTH / "effects.json")
    return np.array([entry.get("exposure", {}).get("gain", (1.0, 1.0, 1.0)) for entry in told["frames"]], dtype=np.float64)


def _usual(gain: Array, test: Array) -> Array:
    """(3,) geometric mean over the training frames: corrections leave it in the pictures, which cannot tell it."""
    return np.asarray(np.exp(np.log(gain[~test]).mean(0)))


def canonical_capture(place: Path, capture: Capture, test: Array) -> Capture:
    """The capture with its held-out pictures filmed again: same camera, lens, rows and pose, but sharp, without noise and compression, as
    bright in the middle and in the corners, and exposed as the training pictures are on the average.

    They are filmed once, into the capture's ground truth.

    Raises:
        OutputError: a picture cannot be written.
    """
    told: dict[str, Any] = read_json(place / TRUTH / "scene.json")
    listed: dict[str, Any] = read_json(place / TRUTH / "effects.json")["effects"]
    settings = scene_file({key: value for key, value in told.items() if key != "effects"}, str(place))
    kept = {name: dict(values) for name, values in listed.items() if name not in LIGHT}
    if "background" in kept:  # as for any scene file, the scene's seed is added to the background's
        kept["background"]["seed"] -= settings.seed
    film = None
    red, green, blue = (1 / _usual(_gains(place), test)).tolist()
    frames = list(capture.frames)
    for index in np.flatnonzero(test):
        path = place / CANONICAL / f"{index:06d}.png"
        if not path.is_file():
            film = film or prepare(settings, place, parse(kept, str(place)))
            picture, _ = Tone((red, green, blue)).undone(film.shot(int(index)).rgb, film.intrinsics)
            with atomic_path(path) as temporary:
                temporary.write_bytes(cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
        frames[index] = replace(frames[index], image=path)
    return capture.with_frames(frames)
