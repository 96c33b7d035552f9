"""Masks that lie beside a capture's images, found by their names. White is used, black is excluded: from fits, scores, features and depth.

Read are folders named as masks are (`masks/`, `images_mask/`, `silhouettes/`, …), beside the images' folder or above it, with files
named after the images (`NAME.png`, COLMAP's `NAME.jpg.png`, `NAME_mask.png`, …) or numbered as they are; and masks among the images
(`NAME_mask.png`, `NAME.alpha.png`). instant-ngp's `dynamic_mask_NAME.png` are the other way round: white is excluded.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.capture import heif
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.images import LOSSY, decode, load_image, load_mask, spread, turns_by_exif, usable_pixels
from fieldfuse.capture.listing import counted, images_in, natural_key, words_of
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

FOLDER_WORDS = {"mask", "masks", "matte", "mattes", "silhouette", "silhouettes"}
FILE_WORDS = {*FOLDER_WORDS, "alpha", "removebg", "nobg", "cutout"}
PHOTOS = (".jpg", ".jpeg", *heif.SUFFIXES)  # a mask is none of these where it has its image's name
SHARED = re.compile(r"(camera[_-]?)?mask")  # the name of one mask for all images
OTHER_WORDS = {"depth", "depths", "normal", "normals", "confidence", "overlay", "overlays"}  # `depth_masks/` is of something else
INVERTED = "dynamic"  # what such a mask marks is excluded
SAMPLED = 16  # images whose names are compared with all masks' to find how these are called
LOOKED_AT = 5  # masks, and images, whose pixels are looked at
PIXELS = 150e6  # of masks that are decoded at once; of more, evenly spread ones
SHAPE = 0.02  # how far a mask's ratio of width to height may be from its image's
LITTLE = 0.1  # of the pixels; masks that leave less, all of them, may mark the wrong side
NOTHING, WHOLE = 1e-3, 1 - 1e-5
PLAIN = 0.99  # of the pixels outside the masks that are white (or black) in images that are cut out
INSTEAD = "if white marks what is to be left out, give --set capture.masks=inverted; --set capture.masks=off uses none"


@dataclass(frozen=True)
class _Found:
    masks: dict[int, Path]  # index of a frame → its mask
    place: str  # as it is named to people
    excludes: bool = False


def with_masks(capture: Capture, use: str = "auto") -> Capture:
    """The capture with the masks that lie beside its images, unless it lists its own; and remarks on how many are used.

    Masks that leave every pixel are dropped, and so are those of another shape than their image and those that cannot be read. Images of
    which nothing is left are dropped themselves.

    Args:
        use: auto | inverted (white is excluded) | off.
    """
    if use == "off":
        return capture.with_frames(map(_unmasked, capture.frames))
    if capture.filmed:
        return capture
    remarks: list[str] = []
    frames = list(capture.frames)
    place = " (listed by the capture)"
    if all(frame.mask is None for frame in frames):
        try:
            found = _find(capture, remarks)
        except OSError as error:
            raise InputError(f"cannot read {error.filename or capture.root}: {error.strerror or error}") from error
        if found is not None:
            place = f" in {found.place}"
            for index, path in found.masks.items():
                frames[index] = replace(frames[index], mask=path, mask_excludes=found.excludes)
    if use == "inverted":
        frames = [replace(frame, mask_excludes=not frame.mask_excludes) if frame.mask is not None else frame for frame in frames]
    exif = turns_by_exif(capture)
    frames = _without_bad(frames, exif, remarks)
    masked = [index for index, frame in enumerate(frames) if frame.mask is not None]
    shares, unreadable = _shares(frames, masked)
    for index in unreadable:
        frames[index] = replace(frames[index], mask=None)
    if unreadable:
        first = capture.frames[unreadable[0]].name
        remarks.append(f"{counted(len(unreadable), 'mask')} cannot be read (of {first}{', …' if len(unreadable) > 1 else ''}) and not used")
    if not shares:
        return capture.with_frames(frames, *remarks)
    if len(shares) + len(unreadable) == len(masked) and min(shares.values()) > WHOLE:
        return capture.with_frames(map(_unmasked, frames), *remarks)
    if max(shares.values()) < NOTHING and len(masked) == len(frames):
        raise InputError(f"the masks{place} of {capture.root} leave nothing of any image (black is left out); {INSTEAD}")
    if len(masked) == len(frames) and not unreadable and (colour := _cut_out_on([frames[index] for index in shares], exif)):
        frames = [replace(frame, mask_is_alpha=True) for frame in frames]
        remarks.append(f"the images are cut out on {colour} already, so {counted(len(frames), 'mask')}{place} are taken as their alpha")
        return replace(capture.with_frames(frames, *remarks), alpha=True)
    excluding = frames[masked[0]].mask_excludes
    frames = [frame for index, frame in enumerate(frames) if shares.get(index) != 0]
    count, empty = sum(frame.mask is not None for frame in frames), len(capture.frames) - len(frames)
    if count:
        share = float(np.mean([share for share in shares.values() if share > 0]))
        remarks.append(
            f"{count} of {counted(len(frames), 'image')} {'has' if count == 1 else 'have'} a mask{place}, which leaves "
            f"{100 * share:.0f}% of the pixels: {'white' if excluding else 'black'} is left out of the fit and of scores"
            + ("" if count == len(frames) else "; images without one are used whole")
        )
    if empty:
        remarks.append(f"{counted(empty, 'image')} of which the masks leave nothing {'is' if empty == 1 else 'are'} not used")
    if count and max(shares.values()) < LITTLE:
        remarks.append(f"the masks leave less than {100 * LITTLE:.0f}% of every image; {INSTEAD}")
    return capture.with_frames(frames, *remarks)


def masks_among(images: Sequence[Path]) -> set[Path]:
    """Those of a folder's images that are masks of others, by their names (`NAME_mask.png`) and by what a few of them show."""
    out: set[Path] = set()
    named, twins = _named(images), _twins(images)
    others = [path for path in images if path not in {*named, *twins}]
    shared = [path for path in named if SHARED.fullmatch(path.stem.lower())]
    for found in (*(sorted(_match(others, some, among=True).values()) for some in (named, twins)), shared if len(shared) == 1 else []):
        if len(others) > 1 and found and _show_masks(found):
            out |= set(found)
    return out


def is_mask_folder(name: str) -> bool:
    """Whether a folder of that name holds masks."""
    words = words_of(name)
    return bool(words & FOLDER_WORDS) and not words & OTHER_WORDS


def _unmasked(frame: Frame) -> Frame:
    return replace(frame, mask=None, mask_excludes=False)


def _named(images: Sequence[Path]) -> list[Path]:
    return [path for path in images if words_of(path.stem) & FILE_WORDS]


def _twins(images: Sequence[Path]) -> list[Path]:
    """Of `NAME.jpg` and `NAME.png` the latter, which may be the mask of the former."""
    photos = {path.stem.lower() for path in images if path.suffix.lower() in PHOTOS}
    return [path for path in images if path.suffix.lower() not in PHOTOS and path.stem.lower() in photos]


# ------------------------------------------------------------------------------------------------ found by names


def _find(capture: Capture, remarks: list[str]) -> _Found | None:
    """The masks of the place that has most of them; remarks on masks that are not used."""
    root = capture.root.resolve()
    places: dict[Path, dict[int, Path]] = {}
    among: set[Path] = set()  # folders of images that hold masks, too
    for place, directory, indices in _places(capture):
        images = [capture.frames[index].image for index in indices]
        beside = images_in(directory)
        if place == directory == images[0].resolve().parent:
            used = {image.name for image in images}
            beside = [path for path in (*_named(beside), *_twins(beside)) if path.name not in used]
            among.add(place)
        found = _match(images, beside, among=place in among)
        if place not in among and not found and len(beside) == 1:
            found = dict.fromkeys(range(len(images)), beside[0])
        places.setdefault(place, {}).update(
            {indices[at]: path.resolve() for at, path in found.items() if path.resolve().is_relative_to(root)}
        )
    names = {place: "the folder of the images" if place == root else f"{place.relative_to(root).as_posix()}/" for place in places}

    def factor(name: str) -> str:  # of `images_4` 4
        match = re.search(r"_([0-9]+)/?$", name)
        return match[1] if match else ""

    usual = factor(Counter(frame.image.parent.name for frame in capture.frames).most_common(1)[0][0])
    best: _Found | None = None
    for place in sorted(places, key=lambda place: (-len(places[place]), factor(names[place]) != usual, len(names[place]))):
        masks, name = places[place], names[place]
        marks = [path.stem if place in among else f"{name} {path.stem}" for path in masks.values()]
        excludes = sum(INVERTED in words_of(mark) for mark in marks) > len(marks) / 2
        of_others = best is not None and best.excludes == excludes and not best.masks.keys() & masks.keys()
        if masks and (best is None or of_others) and not _show_masks([masks[index] for index in sorted(masks)]):
            remarks.append(f"what lies in {name} is not used: it is neither black and white nor has it alpha, as masks do")
        elif masks and best is None:
            best = _Found(masks, name, excludes)
        elif masks and best is not None and of_others:  # of another split or camera
            best = _Found({**best.masks, **masks}, f"{best.place} and {name}", excludes)
        elif place not in among or masks:
            why = "other masks are" if masks else "their names fit no image"
            remarks.append(f"the masks in {name} are not used: {why}")
    return best or _shared(capture)


def _shared(capture: Capture) -> _Found | None:
    """One mask for all images: `mask.png` among them or above."""
    root = capture.root.resolve()
    for folder in sorted({root, *(frame.image.resolve().parent for frame in capture.frames)}):
        masks = [path for path in images_in(folder) if SHARED.fullmatch(path.stem.lower())] if folder.is_relative_to(root) else []
        if len(masks) == 1 and len(capture.frames) > 1 and _show_masks(masks):
            mask = masks[0].resolve()
            if all(frame.image.resolve() != mask for frame in capture.frames):
                return _Found(dict.fromkeys(range(len(capture.frames)), mask), mask.relative_to(root).as_posix())
    return None


def _places(capture: Capture) -> Iterator[tuple[Path, Path, list[int]]]:
    """Folders that may hold masks: the place that they belong to, the folder itself, and the frames that it may hold masks of."""
    root = capture.root.resolve()
    by_folder: dict[Path, list[int]] = {}
    for index, frame in enumerate(capture.frames):
        by_folder.setdefault(frame.image.resolve().parent, []).append(index)
    children: dict[Path, list[Path]] = {}
    for folder, indices in by_folder.items():
        if not folder.is_relative_to(root) or not folder.is_dir():
            continue
        yield folder, folder, indices
        above = [folder, *(parent for parent in folder.parents if parent.is_relative_to(root))]
        for base in above:
            if base not in children:
                named = [child for child in base.iterdir() if is_mask_folder(child.name) and not child.name.startswith(".")]
                children[base] = sorted(filter(Path.is_dir, named), key=lambda child: natural_key(child.name))
            for place in children[base]:
                if place in above:
                    continue
                parts = folder.relative_to(base).parts
                folders = [place.joinpath(*rest) for rest in dict.fromkeys((parts, parts[1:]))]
                inside = [directory for directory in folders if directory.resolve().is_relative_to(root) and images_in(directory)]
                if inside or (place.resolve().is_relative_to(root) and any(place.iterdir())):
                    yield place, (inside or [place])[0], indices


def _match(images: Sequence[Path], masks: Sequence[Path], *, among: bool) -> dict[int, Path]:
    """Index of an image → its mask: by what all masks' names add to their images', else (not `among` the images) by the last number."""
    by_name = {path.stem.lower(): path for path in reversed(masks)}
    votes: Counter[tuple[str, str]] = Counter()
    for image in spread(images, SAMPLED):
        stem, suffix = image.stem.lower(), image.suffix.lower()
        for name in by_name:
            start = name.find(stem)
            if start >= 0 and _apart(name[:start], stem[0]) and _apart(name[start + len(stem) :][::-1], stem[-1]):
                before, after = name[:start], name[start + len(stem) :]
                if after.startswith(suffix) or not among or not before + after or words_of(before + " " + after) & FILE_WORDS:
                    votes[before, after.replace(suffix, "{}", 1) if after.startswith(suffix) else after] += 1
    out: dict[int, Path] = {}
    for before, after in sorted(votes, key=lambda affix: (-votes[affix], len(affix[0] + affix[1]), affix)):
        for at, image in enumerate(images):
            name = before + image.stem.lower() + (after.replace("{}", image.suffix.lower(), 1) if after.startswith("{}") else after)
            if at not in out and name in by_name:
                out[at] = by_name[name]
    if out or among:
        return out
    numbers = [[int(found[-1]) if (found := re.findall(r"[0-9]{1,18}", path.stem)) else None for path in some] for some in (images, masks)]
    if any(None in some or len(set(some)) < len(some) or not some for some in numbers):
        return {}
    by_number = dict(zip(numbers[1], masks, strict=True))
    out = {at: by_number[number] for at, number in enumerate(numbers[0]) if number in by_number}
    return out if 2 * len(out) >= len(images) else {}


def _apart(beside: str, end: str) -> bool:
    """Whether a name's end character `end` stands apart from what is beside it (its last character): `1` is no part of `11`."""
    return not beside or not ((beside[-1].isdigit() and end.isdigit()) or (beside[-1].isalpha() and end.isalpha()))


# ------------------------------------------------------------------------------------------------ looked at


def _show_masks(paths: Sequence[Path]) -> bool:
    """Whether most of a few files are masks by what they show: alpha, black and white, or few flat colours. What cannot be read counts."""
    chosen = spread(paths, LOOKED_AT)
    return sum(map(_shows_mask, chosen)) * 2 > len(chosen)


def _shows_mask(path: Path) -> bool:
    try:
        image, header = decode(path)
    except InputError:
        return True
    if image.ndim == 3 and image.shape[2] in (2, 4) and image[:, :, -1].min() < image[:, :, -1].max():
        return True
    step = max(1, int(max(image.shape[:2]) / 256))
    few = image[::step, ::step].reshape(-1, 1 if image.ndim == 2 else image.shape[2])[:, :3].astype(np.float64)
    low, high = few.min(axis=1), few.max(axis=1)
    top = max(float(few.max()), 1.0)
    flat = ((high < 0.12 * top) | (low > 0.88 * top)).mean() > 0.9
    return bool(flat) or (header.format not in LOSSY and len(np.unique(few, axis=0)) <= 64)


def _cut_out_on(frames: Sequence[Frame], exif: bool) -> str:
    """`white` or `black` where a few images show nothing else outside their masks, and enough of it; else empty."""
    plain = {"white": True, "black": True}
    for frame in spread(frames, LOOKED_AT):
        try:
            image = load_image(frame, exif=exif)
        except InputError:
            return ""
        usable = usable_pixels(frame, image[:, :, :3], exif=exif)
        if usable is None or usable.mean() > 1 - LITTLE:
            return ""
        # Masks of another size, or drawn by hand, are off by a pixel or two at the edge.
        reach = 2 * math.ceil(max(image.shape) / 200) + 1
        outside = image[cv2.dilate(usable.astype(np.uint8), np.ones((reach, reach), np.uint8)) == 0][:, :3]
        plain["white"] &= len(outside) > 0 and bool((outside.min(axis=1) >= 240).mean() > PLAIN)
        plain["black"] &= len(outside) > 0 and bool((outside.max(axis=1) <= 15).mean() > PLAIN)
    return next((colour for colour, is_so in plain.items() if is_so), "")


def _without_bad(frames: list[Frame], exif: bool, remarks: list[str]) -> list[Frame]:
    """Without masks of another shape than their image (turned ones fit, where images are turned), or that are no images."""
    out: list[Frame] = []
    bad: dict[str, list[str]] = {"of another shape than their image": [], "no images that can be read": []}
    shape, broken = bad.values()
    for frame in frames:
        if frame.mask is not None:
            try:
                (width, height), (wide, high) = image_header(frame.mask).size, image_header(frame.image).size
                ratios = [(width * high / (height * wide)), *([width * wide / (height * high)] if exif else [])]
                wrong = None if any(abs(ratio - 1) < SHAPE for ratio in ratios) else shape
            except (InputError, ZeroDivisionError):
                wrong = broken
            if wrong is not None:
                wrong.append(frame.name)
                frame = _unmasked(frame)
        out.append(frame)
    for why, names in bad.items():
        if names:
            verb = "mask is" if len(names) == 1 else "masks are"
            remarks.append(f"{len(names)} {verb} {why} (of {names[0]}{', …' if len(names) > 1 else ''}) and not used")
    return out


def _shares(frames: Sequence[Frame], masked: Sequence[int]) -> tuple[dict[int, float], list[int]]:
    """Share of pixels that masks leave, by the index of the frame, of as many as `PIXELS` allows; and the indices of those unreadable."""
    shares: dict[int, float] = {}
    unreadable: list[int] = []
    if not masked:
        return shares, unreadable
    sizes = [image_header(path).size for index in masked if (path := frames[index].mask) is not None]
    most = max(8, int(PIXELS / max(1.0, float(np.mean([width * height for width, height in sizes])))))
    for index in spread(masked, min(most, len(masked))):
        try:
            mask = load_mask(frames[index])
            shares[index] = 1.0 if mask is None else float(mask.mean())
        except (InputError, cv2.error):
            unreadable.append(index)
    return shares, unreadable
