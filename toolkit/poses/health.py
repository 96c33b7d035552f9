"""Why poses were not found, or not all of them, in a sentence that a user can act on. Plain numbers in, words out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fieldfuse.camera import Array
from fieldfuse.poses.job import GLOBAL, LOOSE
from fieldfuse.poses.result import listed

FEW_KEYPOINTS = 40  # below which an image cannot be matched reliably
BARE = 0.6  # of the usual number of keypoints, below which missing texture is named as a cause
SAME = 1.0  # grey levels between thumbnails of images that count as identical
BLACK = 2.0  # grey deviation of an image without content
FLAT_SHARE = 0.8  # of verified pairs explained by a homography before the scene or the motion is called degenerate
FLAT_SHARE_LOOSE = 0.5  # of verified pairs, the same: enough where COLMAP's own rules have found nothing
ROTATION_RESIDUAL = 0.06  # distance of K⁻¹HK from a rotation, relative
STILL = 0.004  # features moved by less than this share of the long side: the camera stood still
SMALL_ANGLE = 1.5  # degrees; the median triangulation angle below which depth is guesswork
PRETENDED = 5.0  # times the way by the pairs: a model that moves its cameras so far has a wrong lens (true ones: at most once)
TOO_FEW = 3  # registered frames that make a model at all
SHARE_STANDING = 0.1  # of the pairs, in which something stands still while the rest moves
FEW_STANDING, SHARE_AGAINST = 5, 0.02  # pairs, and their share, in which no camera motion explains both
MARK = 0.1  # of the image: what stands still on less is an overlay rather than a background
SIDEWAYS = "move sideways around the scene while recording"
AGREES = 0.7  # share of a frame's matches that agree with its place where that can be trusted (0.70 at least in right ones, but for one)


@dataclass(frozen=True)
class Motion:
    """How the camera moved, by the verified pairs."""

    flat_share: float  # of pairs that a homography explains
    residual: float  # how far these homographies are from pure rotations at the best focal length
    moved: float  # median displacement of features, as a share of the long side


def hopeless(records: Sequence[dict[str, Any]]) -> str | None:
    """The reason why matching is not worth starting, from the images alone; None when it is."""
    count = len(records)
    if count < 2:
        return f"there is {count} picture, and poses need at least 3 from different places; add photos that overlap"
    if sum(record["keypoints"] >= FEW_KEYPOINTS for record in records) < 2:
        dark = sum(record["deviation"] < BLACK for record in records)
        cause = f"{dark} of {count} pictures are one flat colour" if dark else "they are blank, blurred or without texture"
        return (
            f"no features to match: the pictures hold {_usual_keypoints(records)} keypoints each on the median, and {cause}; "
            f"use sharp, lit pictures of a textured scene"
        )
    thumbnails = np.array([record["thumbnail"] for record in records], dtype=np.float64)
    sizes = {(record["width"], record["height"]) for record in records}
    if len(sizes) == 1 and np.abs(thumbnails - thumbnails[0]).max() < SAME:
        return f"all {count} pictures are identical, so there is nothing to triangulate from; move the camera between pictures"
    return None


def _usual_keypoints(records: Sequence[dict[str, Any]]) -> int:
    return int(np.median([record["keypoints"] for record in records]))


def motion(facts: dict[str, Any]) -> Motion | None:
    """What kind of motion the verified pairs show; None without pairs."""
    pairs = facts["pairs"]
    if not pairs:
        return None
    pictures = facts["pictures"]
    long_side = float(np.median([max(p["width"], p["height"]) for p in pictures]))
    flat = [pair for pair in pairs if pair["flat"]]
    size = pictures[pairs[0]["first"]]
    homographies = np.array([pair["homography"] for pair in flat], dtype=np.float64).reshape(-1, 3, 3)
    return Motion(
        flat_share=len(flat) / len(pairs),
        residual=rotation_residual(homographies, size["width"], size["height"]),
        moved=float(np.median([pair["moved"] for pair in pairs])) / long_side,
    )


def rotation_residual(homographies: Array, width: int, height: int) -> float:
    """How far (N, 3, 3) pixel homographies are from K R K⁻¹ with one focal length for all: the least median over focal lengths. A camera
    that only turns gives 0 whatever it looks at; one that moves before a plane does not."""
    if len(homographies) == 0:
        return float("inf")
    best = float("inf")
    for factor in np.geomspace(0.4, 4.0, 47):
        k = np.array([[factor * max(width, height), 0, width / 2], [0, factor * max(width, height), height / 2], [0, 0, 1.0]])
        inner = np.linalg.inv(k) @ homographies @ k
        determinant = np.linalg.det(inner)
        usable = np.abs(determinant) > 1e-12
        inner = inner[usable] / np.cbrt(determinant[usable])[:, None, None]
        if len(inner):
            off = np.linalg.norm(np.swapaxes(inner, 1, 2) @ inner - np.eye(3), axis=(1, 2))
            best = min(best, float(np.median(off)))
    return best


def turned_only(facts: dict[str, Any], share: float = FLAT_SHARE) -> bool:
    """True when by the verified pairs (at least this share of them) the camera turned on the spot."""
    seen = motion(facts)
    return seen is not None and seen.flat_share >= share and seen.residual < ROTATION_RESIDUAL


def failure(facts: dict[str, Any]) -> str | None:
    """The reason why there are no usable poses; None when there are.

    Args:
        facts: what the child process wrote: `pictures`, `pairs`, `attempts`, `model`.
    """
    pictures, model, seen = facts["pictures"], facts["model"], motion(facts)
    reason, count = hopeless(pictures), len(pictures)
    if reason is not None:
        return reason
    if seen is None:
        return (
            f"no two of the {count} pictures share enough features ({_usual_keypoints(pictures)} keypoints each on the median); "
            f"take pictures that overlap by two thirds"
        )
    found = 0 if model is None else len(model["pictures"])
    narrow = model is None or model["angle"] < SMALL_ANGLE
    if seen.moved < STILL and narrow:
        return f"the camera hardly moved: features shift by {100 * seen.moved:.2g}% of the picture on the median; {SIDEWAYS}"
    # A turning camera can be fitted by a wrong lens and a shift, some of its images the better, so the verdict of the pairs stands
    # whatever the mapper finds.
    if turned_only(facts) and (
        model is None
        or found < max(TOO_FEW, count / 2)
        or model["angle"] < 2 * SMALL_ANGLE
        or model["attempt"] == GLOBAL
        or way(facts) > PRETENDED * seen.residual
    ):
        return f"the camera only turned on the spot (rotations explain all matches), so depth cannot be estimated; {SIDEWAYS}"
    if narrow and model is not None:
        return f"there is too little parallax: rays meet at {model['angle']:.2g}° on the median; {SIDEWAYS}"
    # Where homographies explain the pairs, looser rules nearly always find something, whatever the camera did.
    loose = model is not None and model["attempt"] in (LOOSE, GLOBAL)
    if loose and turned_only(facts, FLAT_SHARE_LOOSE):
        return f"the camera turned on the spot for the most part (rotations explain most matches), so depth cannot be estimated; {SIDEWAYS}"
    if found >= TOO_FEW and not (loose and found < count / 2 and seen.flat_share >= FLAT_SHARE):
        return None
    if seen.flat_share >= FLAT_SHARE:
        return (
            "all matches lie on one plane or show too little parallax to start from; include things at different depths and "
            "move sideways while recording"
        )
    largest = len(components(count, facts["pairs"])[0])
    if largest < max(TOO_FEW, count // 2):
        return (
            f"the pictures overlap too little: the largest group that matches holds {largest} of {count}; "
            f"take more pictures in between"
        )
    return (
        f"mapping found no consistent geometry from {len(facts['pairs'])} matched pairs of {count} pictures; take sharper "
        f"pictures with more overlap, of a scene that stands still"
    )


def way(facts: dict[str, Any]) -> float:
    """How far the model's cameras moved between two images that a homography connects, in shares of the scene's depth: the median. A
    homography is off from a rotation by about as much."""
    model = facts["model"]
    poses, points = np.array(model["world_from_camera"], dtype=np.float64), np.array(model["points"], dtype=np.float64).reshape(-1, 3)
    at = {image: number for number, image in enumerate(model["pictures"])}
    ends = [
        (at[pair["first"]], at[pair["second"]]) for pair in facts["pairs"] if pair["flat"] and {pair["first"], pair["second"]} <= set(at)
    ]
    if not ends or not len(points):
        return 0.0
    depth = float(np.median([np.median((points - pose[:3, 3]) @ pose[:3, 2]) for pose in poses]))
    first, second = np.swapaxes(poses[np.array(ends), :3, 3], 0, 1)
    return float(np.median(np.linalg.norm(first - second, axis=1))) / max(depth, 1e-12)


def components(count: int, pairs: Sequence[dict[str, Any]]) -> list[list[int]]:
    """Groups of images connected by verified pairs, largest first."""
    linked = [(pair["first"], pair["second"]) for pair in pairs]
    graph = coo_array((np.ones(len(linked)), np.array(linked, dtype=np.int64).reshape(-1, 2).T), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    groups = [np.flatnonzero(label == group).tolist() for group in range(number)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def shortfalls(facts: dict[str, Any]) -> list[str]:
    """Warnings for a model that does not hold every image: which are missing and why, grouped by cause."""
    pictures, model = facts["pictures"], facts["model"]
    count = len(pictures)
    inside = set(model["pictures"])
    missing = [i for i in range(count) if i not in inside]
    if not missing:
        return []
    links, partners = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
    for pair in facts["pairs"]:
        for here, there in ((pair["first"], pair["second"]), (pair["second"], pair["first"])):
            partners[here] += 1
            links[here] += pair["inliers"] if there in inside else 0
    groups: dict[str, list[int]] = {}
    for i in missing:
        if pictures[i]["keypoints"] < FEW_KEYPOINTS:
            cause = "too few features (dark, blurred or blank)"
        elif partners[i] == 0:
            cause = "no other frame matches them"
        elif links[i] == 0:
            cause = "they match each other but no frame of the model (a gap in the overlap)"
        else:
            cause = "they match frames of the model too weakly or ambiguously to be placed"
        groups.setdefault(cause, []).append(i)
    sizes: list[int] = next((attempt["models"] for attempt in facts["attempts"] if attempt["attempt"] == model["attempt"]), [])
    apart = f"; the scene split into models of {', '.join(str(size) for size in sizes)} frames" if len(sizes) > 1 else ""
    warnings = [f"{len(inside)} of {count} frames were registered{apart}"]
    usual = float(np.median([pictures[i]["keypoints"] for i in inside]))
    for cause, frames in groups.items():
        own = float(np.median([pictures[i]["keypoints"] for i in frames]))
        if FEW_KEYPOINTS <= own < BARE * usual:
            cause += f"; they show little texture ({own:.0f} keypoints each, the others {usual:.0f})"
        warnings.append(f"{len(frames)} frames are missing because {cause}: {listed(runs([pictures[i]['name'] for i in frames], frames))}")
    return warnings


def doubts(facts: dict[str, Any]) -> list[str]:
    """A warning of the frames, of a few, whose place contradicts many of their matches (`agreement`)."""
    shares = {int(i): share for i, share in (facts.get("agreement") or {}).items()}
    doubtful = [i for i, share in sorted(shares.items()) if share < AGREES]
    if not doubtful:
        return []
    names = runs([facts["pictures"][i]["name"] for i in doubtful], doubtful)
    return [
        f"the places of {len(doubtful)} of {len(shares)} frames contradict many of their matches and may be wrong: {listed(names)}; "
        f"add photos from between"
    ]


def fold(facts: dict[str, Any], ordered: bool) -> list[str]:
    """A warning when places that look alike were taken for one (`loops.without_folds`): what was done about it, or, of images `ordered` in
    time, that nothing helped."""
    folded = facts.get("folded")
    if folded is None:
        return []
    if folded["left"] < folded["contradicting"]:
        return [
            f"what is filmed looks alike from several sides: {folded['dropped']} of {folded['far']} matches between frames far apart "
            f"contradict the way of the camera and were taken back"
        ]
    if not ordered:
        return []
    return [
        f"{folded['contradicting']} pairs of neighbouring frames contradict the poses found: places that look alike may have been taken "
        f"for one; film with more of what differs in view, such as the floor and things around"
    ]


def standing(facts: dict[str, Any]) -> list[str]:
    """A warning where something stands still in the images of many pairs while the rest moves, in some as no camera motion explains. (In
    most pairs of a turntable's neighbouring images all moves sideways, as before a camera that does so.)"""
    pairs = facts["pairs"]
    extents = [pair["stands"][0] for pair in pairs if pair.get("stands")]
    against = sum(pair["stands"][1] for pair in pairs if pair.get("stands"))
    if len(extents) < SHARE_STANDING * len(pairs) or against < max(FEW_STANDING, SHARE_AGAINST * len(pairs)):
        return []
    found = f"what stands still in the images, in {len(extents)} of {len(pairs)} matched pairs, contradicts what moves"
    if float(np.median(extents)) < MARK:
        return [
            f"{found}, and takes up a small part of them: a watermark, a clock or a part of the camera's mount is in view; give masks that "
            f"exclude it"
        ]
    return [
        f"{found}: the object was turned before a standing camera, or large things move along with the camera, and poses mix both; "
        f"give masks of the object, film it before a plain background, or walk around it while nothing turns"
    ]


def runs(names: Sequence[str], positions: Sequence[int]) -> list[str]:
    """Names of neighbouring positions gathered as `first to last`."""
    out: list[str] = []
    start = 0
    for k in range(1, len(positions) + 1):
        if k == len(positions) or positions[k] != positions[k - 1] + 1:
            length = k - start
            out += [f"{names[start]} to {names[k - 1]}"] if length > 2 else list(names[start:k])
            start = k
    return out
