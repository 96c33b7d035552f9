"""Small simulated captures whose effects are known: what the detection of effects, and corrections of light, are measured on.

A fit without corrections is scored, otherwise, against images that have the very drift and vignetting it was fitted to, and a darkened
corner hides errors: only against the same images can fits with different corrections be compared. So held-out images are filmed again in
canonical colour.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Intrinsics, project
from fieldfuse.capture.types import Capture
from fieldfuse.effects.correct import Corrections
from fieldfuse.effects.effect_specs import parse
from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path, read_json, write_json
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate.film import Shot
from fieldfuse.simulate.settings import SceneFile, scene_file
from fieldfuse.simulate.simulate import TRUTH, prepare, simulate
from fieldfuse.tone import Tone

WIDTH, HEIGHT, FRAMES, FPS, SIDE = 256, 192, 16, 5.0, 1
STRENGTHS = ("weak", "medium", "strong")
EFFECTS = ("exposure", "vignetting", "distortion", "rolling_shutter", "highlights", "background", "motion_blur", "poses")
BLUR_SAMPLES = {"weak": 3, "medium": 5, "strong": 9}  # of the shutter's time: fewer than usual, for pictures this small
# The effect's own presets change hardly a pixel here (38 dB and more between with and without): lamps are small and paths short.
HIGHLIGHTS = {"weak": (1.0, 0.12), "medium": (1.5, 0.25), "strong": (2.0, 0.4)}  # strength, coat
SHOWS = 0.06  # share of the pixels that a background changes by more than `CHANGE`; else the scene is drawn anew
WANDERS = 0.03  # the same for highlights: of what two pictures show, pixels to which they add another light in one than in the other
CHANGE = 8  # of 255
TRIES = 12
POSE_ERROR = {"weak": (0.08, 0.001), "medium": (0.3, 0.004), "strong": (0.8, 0.012)}  # degrees, and share of the way to what is seen
SCENES = ("room", "table", "corridor", "street", "room", "sphere")
PATHS = {"room": "walk", "street": "walk", "corridor": "forward", "table": "orbit", "sphere": "orbit"}
SPEED = {"room": 0.5, "street": 1.0, "corridor": 0.8, "table": 0.9, "sphere": 0.9}  # metres a second
SHAKE = 8.0  # degrees a second: a hand
FIRST_SEED = 400_000  # of the captures that stand in the documentation; development uses others
FIRST_DRIFTING = 410_000  # of those with drift and vignetting
PLACES = {"highlights": ("room", "sphere", "table"), "background": ("street",)}  # where an effect shows at all
LIGHT = ("motion_blur", "vignetting", "exposure", "sensor_noise", "compression")  # what a canonical image is free of
CANONICAL = f"{TRUTH}/canonical"


@dataclass(frozen=True)
class Planned:
    """One capture: its scene, and which effects it has in which strength. `poses` stands for errors of the given poses."""

    name: str
    scene: str
    seed: int
    effects: tuple[tuple[str, str], ...]


def plan(first_seed: int = FIRST_SEED) -> list[Planned]:
    """12 captures without any effect, each of the eight alone in three strengths, and 24 pairs of medium and strong ones.

    What a real capture has anyway and nothing corrects (a little sensor noise, compression) is in every third of them.
    """
    wanted: list[tuple[tuple[str, str], ...]] = [()] * 12
    wanted += [((effect, strength),) for effect in EFFECTS for strength in STRENGTHS]
    pairs = [(first, second) for step in (1, 2, 3) for first, second in zip(EFFECTS, EFFECTS[step:] + EFFECTS[:step], strict=True)]
    wanted += [
        ((first, STRENGTHS[1 + n % 2]), (second, STRENGTHS[1 + n // 2 % 2])) for n, (first, second) in enumerate(dict.fromkeys(pairs))
    ]
    out = []
    for number, effects in enumerate(wanted):
        fits = [set(PLACES[effect]) for effect, _ in effects if effect in PLACES]
        scenes = [scene for scene in SCENES if all(scene in places for places in fits)]
        if not scenes:  # highlights before a distant background: a street's windows and cars are glossy too
            scenes = ["street"]
        label = "+".join(f"{effect}-{strength}" for effect, strength in effects) or "clean"
        out.append(Planned(f"{number:02d}-{label}", scenes[number % len(scenes)], first_seed + number, effects))
    return out


def plan_drifting(first_seed: int = FIRST_DRIFTING) -> list[Planned]:
    """Ten captures with drift of exposure and vignetting, medium and strong, one of each kind of scene."""
    out: list[Planned] = []
    for strength in STRENGTHS[1:]:
        for scene in dict.fromkeys(SCENES):
            effects = (("exposure", strength), ("vignetting", strength))
            out.append(Planned(f"drift-{len(out):02d}-{scene}-{strength}", scene, first_seed + len(out), effects))
    return out


def film(planned: Planned, folder: Path, progress: Progress = SILENT) -> Path:
    """Simulate one capture below `folder` unless it is there; its `transforms.json` has neither the lens nor the true poses.

    Returns:
        the capture's folder, with what it holds in `planned.json`.
    """
    place = folder / planned.name
    about = place / "planned.json"
    if about.is_file():
        return place
    listed: list[Any] = []
    for effect, strength in planned.effects:
        if effect == "motion_blur":
            listed.append({effect: {"strength": strength, "samples": BLUR_SAMPLES[strength]}})
        elif effect == "highlights":
            listed.append({effect: dict(zip(("strength", "coat"), HIGHLIGHTS[strength], strict=True))})
        elif effect != "poses":
            listed.append(f"{effect}:{strength}")
    if planned.seed % 3 == 2:
        listed.append("sensor_noise:weak")
    best, settings = -1.0, _settings(planned, planned.seed)
    for attempt in range(TRIES):
        drawn = _settings(planned, planned.seed + 1000 * attempt)
        try:
            share = shown(drawn, planned, listed)
        except InputError:  # the path does not fit into this scene
            continue
        if share > best:
            best, settings = share, drawn
        if best > SHOWS:
            break
    simulate(settings, place, effects=listed, progress=progress, workers=1)
    _forget(place / "transforms.json", planned)
    write_json(about, {"scene": planned.scene, "seed": settings.seed, "effects": dict(planned.effects), "fps": FPS})
    return place


def _settings(planned: Planned, seed: int) -> SceneFile:
    return scene_file(
        {
            "scene": planned.scene,
            "seed": seed,
            "side": SIDE,
            "camera": {"width": WIDTH, "height": HEIGHT},
            "path": {"kind": PATHS[planned.scene], "frames": FRAMES, "fps": FPS, "speed": SPEED[planned.scene], "shake": SHAKE},
        },
        planned.name,
    )


def shown(settings: SceneFile, planned: Planned, listed: list[Any]) -> float:
    """Share of the pixels that those effects change which only show where the scene lets them, in the units of `SHOWS`; 1 where there is
    none of these."""
    names = {effect for effect, strength in planned.effects if effect in PLACES and strength != "weak"}
    if not names:
        prepare(settings, Path(), parse([], planned.name))
        return 1.0
    least = 1.0
    for name in names:
        mine = [entry for entry in listed if (next(iter(entry)) if isinstance(entry, dict) else entry.split(":")[0]) == name]
        films = [prepare(settings, Path(), parse(effects, planned.name)) for effects in ([], mine)]
        shots = [[film.shot(index) for index in (1, FRAMES // 2, FRAMES - 2)] for film in films]
        added = [dressed.rgb.astype(int) - plain.rgb for plain, dressed in zip(*shots, strict=True)]
        if name == "highlights":  # only what wanders over a surface depends on the view
            share = np.mean([_wanders(films[0].intrinsics, shots[0], added, *pair) for pair in ((0, 1), (1, 2), (0, 2))])
            least = min(least, float(share) * SHOWS / WANDERS)
        else:
            least = min(least, float(np.mean([np.abs(one).max(2) > CHANGE for one in added])))
    return least


def _wanders(camera: Intrinsics, shots: list[Shot], added: list[Array], first: int, second: int) -> float:
    """Share of a picture's pixels to whose surface an effect adds another light in a second picture, of all that both show."""
    one, other = shots[first], shots[second]
    rows, columns = np.nonzero(one.depth > 0)
    flat = (np.stack([columns, rows], axis=1) + 0.5 - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * one.depth[rows, columns, None]
    world = points @ one.world_from_camera[:3, :3].T + one.world_from_camera[:3, 3]
    pixels, depth = project(camera, other.world_from_camera, world)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
    column, row = pixels[inside].astype(int).T
    same = np.abs(other.depth[row, column] - depth[inside]) < 0.02 * depth[inside]
    change = np.abs(added[first][rows[inside], columns[inside]] - added[second][row, column]).max(1)[same]
    return float((change > CHANGE).mean()) if len(change) else 0.0


def _forget(path: Path, planned: Planned) -> None:
    """Take the lens out of the cameras, and put the planned error on their poses."""
    data: dict[str, Any] = read_json(path)
    for key in ("k1", "k2", "p1", "p2", "k3"):
        data.pop(key, None)
    data["camera_model"] = "PINHOLE"
    strength = dict(planned.effects).get("poses")
    if strength is not None:
        degrees, share = POSE_ERROR[strength]
        rng = np.random.default_rng([planned.seed, 4711])
        depth = _median_depth(path.parent)
        turns = Rotation.from_rotvec(rng.normal(0, degrees / np.sqrt(3), (len(data["frames"]), 3)), degrees=True).as_matrix()
        for entry, turn in zip(data["frames"], turns, strict=True):
            pose = np.array(entry["transform_matrix"])
            pose[:3, :3] = pose[:3, :3] @ turn
            pose[:3, 3] += rng.normal(0, share * depth / np.sqrt(3), 3)
            entry["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(data), encoding="utf-8")


def _median_depth(place: Path) -> float:
    """Median over frames of the median depth, metres."""
    from safetensors.numpy import load_file

    depths = [load_file(path)["depth"] for path in sorted((place / "ground_truth" / "frames").glob("*.safetensors"))]
    return float(np.median([np.median(depth[depth > 0]) for depth in depths if (depth > 0).any()]))


def known_light(place: Path, capture: Capture, test: Array) -> Corrections:
    """The corrections of exposure and vignetting that undo exactly what was simulated: nothing that looks at images can do better."""
    truth: dict[str, Any] = read_json(place / TRUTH / "effects.json")
    corner = truth["effects"].get("vignetting", {}).get("corner")
    if "exposure" not in truth["effects"]:
        return Corrections(corner=corner)
    gain = _gains(place)
    exact = gain / _usual(gain, test)
    named = {frame.name: (float(r), float(g), float(b)) for frame, (r, g, b) in zip(capture.frames, exact, strict=True)}
    return Corrections(gain=named, corner=corner)


def _gains(place: Path) -> Array:
    """(F, 3) what each frame's light was multiplied by."""
    truth: dict[str, Any] = read_json(place / TRUTH / "effects.json")
    return np.array([entry.get("exposure", {}).get("gain", (1.0, 1.0, 1.0)) for entry in truth["frames"]], dtype=np.float64)


def _usual(gain: Array, test: Array) -> Array:
    """(3,) geometric mean over the training frames: corrections leave it in the images."""
    return np.asarray(np.exp(np.log(gain[~test]).mean(0)))


def canonical_capture(place: Path, capture: Capture, test: Array) -> Capture:
    """The capture with its held-out images filmed again: same camera, lens, rows and pose, but sharp, without noise and compression, as
    bright in the middle and in the corners, and exposed as the training images are on the average.

    They are filmed once, into the capture's ground truth.

    Raises:
        OutputError: an image cannot be written.
    """
    truth: dict[str, Any] = read_json(place / TRUTH / "scene.json")
    listed: dict[str, Any] = read_json(place / TRUTH / "effects.json")["effects"]
    settings = scene_file({key: value for key, value in truth.items() if key != "effects"}, str(place))
    other = {name: dict(values) for name, values in listed.items() if name not in LIGHT}
    if "background" in other:  # as for any scene file, the scene's seed is added to the background's
        other["background"]["seed"] -= settings.seed
    film = None
    red, green, blue = (1 / _usual(_gains(place), test)).tolist()
    frames = list(capture.frames)
    for index in np.flatnonzero(test):
        path = place / CANONICAL / f"{index:06d}.png"
        if not path.is_file():
            film = film or prepare(settings, place, parse(other, str(place)))
            image, _ = Tone((red, green, blue)).undone(film.shot(int(index)).rgb, film.intrinsics)
            with atomic_path(path) as temporary:
                temporary.write_bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes())
        frames[index] = replace(frames[index], image=path)
    return capture.with_frames(frames)
