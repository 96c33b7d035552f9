"""What lies beside a capture's files and is not used: images, videos, other poses. Said, since somebody may have meant it."""

from __future__ import annotations

import os
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

from fieldfuse.capture.colmap_model import holds_model
from fieldfuse.capture.listing import PICTURES, counted, natural_key
from fieldfuse.capture.photos import SMALLER
from fieldfuse.capture.types import Capture
from fieldfuse.capture.video import VIDEO_SUFFIXES

DEEP, MOST_FILES, LISTED = 2, 20_000, 3
POSE_FILES = re.compile(
    r"transforms.*\.json|cameras.*\.(npz|json|xml)|poses_bounds.*\.npy|.*\.(nvm|out|abc|psz)|traj(ectory)?\.(txt|log)|groundtruth\.txt",
    re.IGNORECASE,
)
# Files with poses that a kind reads; of the others nobody knows what they are for.
READ = {
    "transforms": r"transforms.*\.json",
    "blender": r"transforms_.*\.json",
    "llff": r"poses_bounds\.npy",
    "dtu": r"cameras.*\.npz",
}
OTHER_KINDS = ("photos", "video", "transforms", "blender", "llff", "dtu", "colmap")  # whose reader takes none of the lists of poses


def with_remark(capture: Capture) -> Capture:
    """The capture with a warning where it is photos and videos or other programs' poses lie beside them: these may have been meant."""
    lines = unused(capture) if capture.kind == "photos" else []
    meant = [line for line in lines if "video" in line or "with poses" in line]
    remark = f"beside the photos lie and are not used: {'; '.join(meant)}"
    return replace(capture, warnings=(*capture.warnings, remark)) if meant else capture


def unused(capture: Capture) -> list[str]:
    """A few lines on what a capture's folder holds besides what is used: images, videos, files with poses; each names three at most."""
    root = capture.root
    if capture.film or not root.is_dir():
        return []
    of_frames = (path for frame in capture.frames for path in (frame.image, frame.depth, frame.mask, frame.confidence))
    used = {path.resolve() for path in of_frames if path is not None}
    images: Counter[str] = Counter()
    videos: list[str] = []
    poses: list[str] = []
    looked = 0
    for place, children, names in os.walk(root):
        folder = Path(place)
        relative = folder.relative_to(root)
        if "run.json" in names and relative.parts:
            children.clear()
            continue
        children[:] = [] if len(relative.parts) >= DEEP else sorted(name for name in children if not name.startswith((".", "__")))
        looked += len(names) + len(children)
        if looked > MOST_FILES:
            break
        if capture.kind in OTHER_KINDS and capture.kind != "colmap" and relative.parts and holds_model(folder):
            poses.append(f"{relative.as_posix()}/ (COLMAP model)")
        for name in sorted(names, key=natural_key):
            suffix = Path(name).suffix.lower()
            if name.startswith(".") or (suffix not in (*PICTURES, *VIDEO_SUFFIXES) and not POSE_FILES.fullmatch(name)):
                continue
            if (folder / name).resolve() in used:
                continue
            if suffix in PICTURES:
                images[relative.as_posix()] += 1
            elif suffix in VIDEO_SUFFIXES:
                videos.append((relative / name).as_posix())
            elif capture.kind in OTHER_KINDS and not re.fullmatch(READ.get(capture.kind, "$"), name, re.IGNORECASE):
                poses.append((relative / name).as_posix())
    # Smaller copies of the same images are made by many programs, and nobody means them.
    heaps = {place: count for place, count in images.items() if not SMALLER.fullmatch(place.lower())}
    lines = []
    if heaps:
        most = sorted(heaps, key=lambda place: -heaps[place])
        shown = ", ".join(f"{heaps[place]} in {'the folder itself' if place == '.' else place + '/'}" for place in most[:LISTED])
        lines.append(f"{counted(sum(heaps.values()), 'image')} ({shown}{', …' if len(heaps) > LISTED else ''})")
    for found, one in ((videos, "video"), (poses, "file with poses")):
        if found:
            many = one.replace("file", "files") if " " in one else None
            lines.append(f"{counted(len(found), one, many)} ({', '.join(found[:LISTED])}{', …' if len(found) > LISTED else ''})")
    return lines
