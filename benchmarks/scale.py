"""`python -m benchmarks.scale`: how exact metres are that markers, measured distances and GPS give to structure from motion.

Simulated captures of which nothing but the images is used; the truth is where their cameras stood.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
import typer
from safetensors.numpy import load_file

from benchmarks.experiment import Experiment, Folder, Row, application, markdown, program, section, show
from fieldfuse import steps
from fieldfuse.camera import Array, Intrinsics, unproject
from fieldfuse.capture.images import load_image
from fieldfuse.capture.types import Capture
from fieldfuse.config import PosesSettings, load_settings
from fieldfuse.effects.effect_specs import parse
from fieldfuse.errors import InputError
from fieldfuse.files import read_json
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet, Threads
from fieldfuse.poses.gps import similarity
from fieldfuse.poses.result import PoseResult
from fieldfuse.poses.scaling import find_scaling
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate.eye import Rays
from fieldfuse.simulate.settings import scene_file
from fieldfuse.simulate.simulate import prepare, simulate

SIDE = 0.1  # metres, of the markers
PAIRS = 5  # distances that are measured, each alone
LOW, ROUND, ABOVE = -0.118, 0.095, 0.02  # metres: plates' height over the focus; their corners from their middles; free space about them
REACH, FEWEST = np.arange(0.14, 0.4, 0.03), 6  # metres from the table's middle; cameras that must see a whole plate
EVEN, PATCH, APART = 0.1, 12, 0.2  # marks lie on surfaces without an edge within some pixels, and far enough from each other (metres)
SCENES: dict[str, dict[str, Any]] = {
    "table": {
        "camera": {"width": 960, "height": 720},  # markers are 25 to 55 pixels wide
        "path": {"kind": "orbit", "fps": 5, "speed": 0.9},
        "markers": [{"side": SIDE, "number": 3}, {"side": SIDE, "number": 7, "turn": 30}],  # `laid` says where
        "gps": {"noise": 0.02, "noise_up": 0.03},
    },
    "street": {"path": {"kind": "fly", "fps": 2, "speed": 1.2}, "effects": ["background"], "gps": {"noise": 0.05, "noise_up": 0.08}},
}
WAYS = ("marker", "distance", "gps")
TITLES = {"scene": "scene", "seed": "seed", "images": "images placed", "marker": "markers", "distance": "a distance", "gps": "GPS"}


def scale(
    frames: Annotated[int, typer.Option(min=8, max=200, help="Images of a capture.")] = 30,
    seeds: Annotated[int, typer.Option(min=1, max=20, help="Captures of each scene.")] = 3,
    scenes: Annotated[str, typer.Option(help="Some of table, street; separated by commas.")] = "table,street",
    threads: Threads = None,
    out: Folder = None,
    quiet: Quiet = False,
) -> None:
    """Simulate captures, find their poses, and compare the unit of length that each way gives with the true one."""
    names = [name.strip() for name in scenes.split(",")]
    if unknown := [name for name in names if name not in SCENES]:
        raise InputError(f"there is no scene {unknown[0]!r} here; known are {', '.join(SCENES)}")
    progress = make_progress(quiet)
    plan = [{"scene": name, "seed": seed, "frames": frames} for name in names for seed in range(seeds)]

    def run(entry: Row) -> Row:
        with tempfile.TemporaryDirectory(prefix="fieldfuse-scale-") as folder:
            return measured(Path(folder), entry["scene"], entry["seed"], entry["frames"], progress)

    show(section(Experiment("scale", plan, run, table).conduct(out, progress, threads), table), quiet)


def table(data: Row) -> str:
    """Markdown: a line a capture; errors in percent, and what was stated."""
    titles = [f"{title}, error (stated)" if name in WAYS else title for name, title in TITLES.items()]
    return markdown(titles, map(_line, data["rows"]))


def _line(row: Row) -> list[str]:
    ways = [f"{abs(row[way]['error']):.2f}% ({row[way]['stated']:.2f}%)" if row.get(way) else "–" for way in WAYS]
    return [row["scene"], str(row["seed"]), f"{row['placed']} of {row['frames']}", *ways]


def measured(folder: Path, scene: str, seed: int, frames: int, progress: Progress = SILENT) -> Row:
    """Errors of the unit of length in percent by each way that the scene has, and those that were stated."""
    settings, setup = load_settings(), SCENES[scene]
    filmed = {**setup, "scene": scene, "seed": seed, "output": "photos", "path": {**setup["path"], "frames": frames}}
    if "markers" in setup:
        filmed["markers"] = laid(filmed)
    simulate(scene_file(filmed, "the benchmark"), folder / "capture", progress=progress)
    capture = steps.read_capture(folder / "capture" / "images", folder, settings, progress)
    poses = steps.camera_poses(capture, folder, settings, progress)
    true = [entry["world_from_camera"] for entry in read_json(folder / "capture/ground_truth/cameras.json")["frames"]]
    by_name = {frame.name: np.array(pose) for frame, pose in zip(capture.frames, true, strict=True)}
    centres = np.array([by_name[name][:3, 3] for name in poses.names])
    unit = similarity(poses.world_from_camera[:, :3, 3], centres).scale
    row: Row = {"placed": len(poses.names)}
    ways: dict[str, list[PosesSettings]] = {"gps": [PosesSettings()]}
    if "markers" in setup:
        ways["marker"] = [PosesSettings(marker=f"DICT_4X4_50:{SIDE}", gps="off")]
    ways["distance"] = [PosesSettings(scale=text, gps="off") for text in distances(folder / "capture", capture, poses, by_name)]
    for way, all_of in ways.items():
        found = [found for one in all_of if (found := _error(capture, poses, one, unit)) is not None]
        if found:  # of several distances, each alone, the median
            error, stated = np.median(np.abs(np.array(found)), axis=0)
            row[way] = {"error": round(float(error), 4), "stated": round(float(stated), 4), "each": [round(one[0], 4) for one in found]}
    return row


def laid(filmed: Row) -> list[dict[str, Any]]:
    """A table's markers as a person lays them: flat, on spots where nothing stands, and where most of the cameras see them whole.

    Raises:
        InputError: the table has too few such spots.
    """
    bare = scene_file({**filmed, "markers": []}, "the benchmark")
    film = prepare(bare, Path(), parse(bare.effects, "the effects"))
    scene, eyes = film.scene, film.world_from_camera[:, :3, 3]
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    plate = np.array([[0.0, 0.0, LOW], *([part * np.cos(a), part * np.sin(a), LOW] for part in (0.5 * ROUND, ROUND) for a in around)])
    found = list[tuple[int, Array]]()
    for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        for reach in REACH:
            spot = np.array([reach * np.cos(angle), reach * np.sin(angle), 0.0])
            points = np.asarray(scene.focus) + spot + plate
            near = scene.clearance(torch.from_numpy(points + np.array([0, 0, ABOVE])).float()).cpu().numpy()
            if np.abs(near - ABOVE).max() > 0.005:  # something stands there, or the table ends
                continue
            ways = points[None] - eyes[:, None]
            lengths = np.linalg.norm(ways, axis=-1)
            starts, ways = np.repeat(eyes, len(plate), axis=0), (ways / lengths[..., None]).reshape(-1, 3)
            rays = Rays(torch.from_numpy(starts).float(), torch.from_numpy(ways).float(), 0.0)
            seen = scene.see(rays).distance.cpu().numpy().reshape(lengths.shape)
            found.append((int((seen > lengths - 0.01).all(axis=1).sum()), spot))
    spots = list[Array]()
    for views, spot in sorted(found, key=lambda one: -one[0]):
        if views >= FEWEST and all(np.linalg.norm(spot - other) > 2 * ROUND for other in spots):
            spots.append(spot)
    if len(spots) < len(filmed["markers"]):
        raise InputError(f"seed {filmed['seed']}: the table has {len(spots)} free spots in view for {len(filmed['markers'])} markers")
    return [{**marker, "at": [*spot[:2].tolist(), LOW]} for marker, spot in zip(filmed["markers"], spots, strict=False)]


def _error(capture: Capture, poses: PoseResult, settings: PosesSettings, unit: float) -> tuple[float, float] | None:
    """Of the scale in percent, true and stated; None: none was found."""
    try:
        found = find_scaling(capture, poses, settings)
    except InputError:
        return None
    return None if found.facts is None else (100 * (found.move.scale / unit - 1), 100 * found.facts["error"])


def distances(root: Path, capture: Capture, poses: PoseResult, by_name: dict[str, Array]) -> list[str]:
    """Measured distances between points in two images each, as a person would mark them: on corners of what has texture."""
    count, found = len(poses.names), list[str]()
    lens = Intrinsics.from_dict(read_json(root / "ground_truth/cameras.json")["intrinsics"])
    for number in range(PAIRS):
        texts, ends = list[str](), list[Array]()
        for index in (count // 4 + number, count // 2 + number):
            name = poses.names[min(index, count - 1)]
            frame = next(frame for frame in capture.frames if frame.name == name)
            image = cv2.cvtColor(load_image(frame)[..., :3], cv2.COLOR_RGB2GRAY)
            depth = load_file(root / f"ground_truth/frames/{frame.image.stem}.safetensors")["depth"]
            for x, y in np.asarray(cv2.goodFeaturesToTrack(image[60:-60, 60:-60], 60, 0.05, 30)).reshape(-1, 2)[number:] + 60.5:
                column, row = int(x), int(y)
                near = depth[row - PATCH : row + PATCH + 1, column - PATCH : column + PATCH + 1]
                if depth[row, column] <= 0 or np.ptp(near) > EVEN * depth[row, column]:
                    continue
                end = unproject(lens, by_name[name], np.array([[x, y]]), depth[row, column][None].astype(np.float64))[0]
                if ends and np.linalg.norm(end - ends[0]) < APART:
                    continue
                texts.append(f"{name}:{x:.1f},{y:.1f}")
                ends.append(end)
                break
        if len(ends) == 2:
            found.append(f"{texts[0]} {texts[1]} = {float(np.linalg.norm(ends[0] - ends[1])):.6f}")
    return found


app = application(scale)
if __name__ == "__main__":
    program(app)
