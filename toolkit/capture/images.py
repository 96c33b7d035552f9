"""Pixels of a frame: the image as RGB(A), its depth in the input's units, its mask. Nothing is resized or undistorted here."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from PIL import Image

from fieldfuse.camera import Array
from fieldfuse.capture import exr, heif, raw
from fieldfuse.capture.archive import MAPS, load_map, read_bytes
from fieldfuse.capture.colours import to_srgb
from fieldfuse.capture.headers import LYING, MAX_PIXELS, Header, image_header, orientation_of, read_header, unturned
from fieldfuse.capture.sens import is_sens, sens_depth
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.video import iterate_video
from fieldfuse.errors import InputError
from fieldfuse.tone import stored

EXIF_TURNS = "exif_turns"  # in `Capture.extra`: the cameras are those of images that are turned by EXIF
LOSSY = ("JPEG", "MPO", "WEBP", heif.FORMAT)  # formats whose black and white come out as greys
LINEAR = (exr.FORMAT, raw.FORMAT)  # formats whose channels hold linear light
ROWS = 256  # of an image that are converted at a time
FEW_LEVELS = 32  # grey levels of a mask up to which they are labels, not soft edges
HEADERS, IMAGES = 100, 5  # looked at at most, evenly spread: decoding all of a large capture would take minutes
T = TypeVar("T")


def spread(values: Sequence[T], most: int) -> list[T]:
    """At most `most` of the values, evenly spread, the first and the last among them."""
    return [values[int(at)] for at in np.unique(np.linspace(0, len(values) - 1, most).round())] if len(values) else []


def turns_by_exif(capture: Capture) -> bool:
    """Whether this capture's images are turned upright by their EXIF orientation.

    Plain photo folders are. Other sources have cameras that were made for the pixels as they are stored, unless only the turned images
    have the cameras' shape (`usable.turned_by_exif`).
    """
    return capture.kind == "photos" or capture.extra.get(EXIF_TURNS) is True


def load_image(frame: Frame, *, exif: bool = False) -> Array:
    """The frame's image, (H, W, 3) or with alpha (H, W, 4), uint8 RGB(A), alpha not premultiplied.

    Grey images become RGB; 16-bit ones are rounded to 8 bits; floating-point ones are taken as 0 to 1. Linear light (OpenEXR, camera raw,
    what `light.with_white` finds) gets sRGB's curve, up to the frame's white. Colours are sRGB's, whatever profile the file has. A mask
    that is alpha (`mask_is_alpha`) becomes the image's. With `exif` the EXIF orientation is applied (see `turns_by_exif`), without it the
    pixels stay as stored.

    Raises:
        InputError: naming the file, when it is missing, no image, cut short or too large.
    """
    if frame.video_index is not None:
        for _, image in iterate_video(frame.image, {frame.video_index}, as_stored=frame.as_stored):
            return image
        raise InputError(f"frame {frame.video_index} of the video {frame.image} cannot be decoded; the file may be damaged")
    as_stored, orientation = read_image(frame)
    image = upright(as_stored, orientation if exif else 1)
    mask = load_mask(frame, exif=exif) if frame.mask_is_alpha else None
    if mask is None or image.shape[2] == 4:
        return image
    return np.dstack([image, cv2.resize(mask.astype(np.uint8) * 255, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)])


def read_image(frame: Frame, *, small: bool = False) -> tuple[Array, int]:
    """The image file of a frame as `load_image` has it, pixels as stored, and its EXIF orientation; `small` as `decode`."""
    image, header = decode(frame.image, frame.balance, small=small)
    linear = header.format in LINEAR if frame.linear is None else frame.linear
    shown = to_rgba(image, frame.white, linear=linear)
    return shown if linear else to_srgb(shown, header.profile), 1 if header.format == heif.FORMAT else header.orientation


def cut_out(frames: Sequence[Frame]) -> bool:
    """Whether alpha cuts an object out of a capture's images: some pixel of those looked at is not opaque. Screenshots and many programs'
    PNGs have an alpha that is full everywhere. Files that cannot be read are reported when all pixels are read."""
    with_alpha = []
    for frame in spread([frame for frame in frames if frame.video_index is None], HEADERS):
        with suppress(InputError):
            if image_header(frame.image).alpha:
                with_alpha.append(frame.image)
    for path in spread(with_alpha, IMAGES):
        with suppress(InputError):
            image = to_rgba(decode(path)[0])
            if image.shape[2] == 4 and (image[:, :, 3] < 255).any():
                return True
    return False


def load_depth(frame: Frame, capture: Capture) -> Array:
    """The frame's depth map, (H, W) float32 along z in units of the input's poses, 0 = missing.

    Stored values are divided by `capture.depth_scale`. 0, negative, NaN and infinite values are missing, so is 65535 in 16-bit images,
    and so is where the frame's confidence is 0. Where the depth camera stands beside the image's, the map is reprojected into that
    (`depth_reprojection`). Read are 8/16-bit PNG, TIFF and PFM with whole or floating-point numbers, OpenEXR, .npy arrays, LZFSE
    (`archive`), and what `.sens` files hold.

    Raises:
        InputError: naming the file, when it is missing, damaged, or not one value a pixel.
    """
    if frame.depth is None:
        raise InputError(f"the frame {frame.name} has no depth map")
    path = frame.depth
    if frame.video_index is not None and is_sens(path):
        raw = sens_depth(path, frame.video_index)
    else:
        raw = _load_npy(path) if path.suffix.lower() == ".npy" else _values(path, frame)
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[:, :, 0]
    if raw.ndim != 2 or raw.size == 0:
        raise InputError(
            f"the depth map {path} has the shape {raw.shape}, it must hold one value a pixel; store it as 16-bit grey PNG or float .npy"
        )
    depth = raw.astype(np.float32) / np.float32(capture.depth_scale)
    missing = ~np.isfinite(depth) | (depth <= 0)
    if raw.dtype == np.uint16:
        missing |= raw == 65535
    if frame.confidence is not None:
        confidence = _values(frame.confidence, frame)
        if confidence.shape != depth.shape:
            raise InputError(
                f"the confidence {frame.confidence} has the shape {confidence.shape}, its depth map {depth.shape}; export both again"
            )
        missing |= confidence == 0
    depth[missing] = 0
    camera = frame.depth_intrinsics or frame.intrinsics
    if frame.depth_pose is None or camera is None:
        return depth
    from fieldfuse.capture.depth_reprojection import reprojected  # here: its kernels take a second to load, and few captures need them

    height, width = depth.shape
    return reprojected(depth, camera.scaled(width, height), frame.depth_pose)


def load_mask(frame: Frame, *, exif: bool = False) -> Array | None:
    """(H, W) bool, True where the pixel may be used; None when the frame has no mask. A mask may have another size than its image.

    Excluded is what is 0 in every channel (what is not, where `frame.mask_excludes`). Masks with soft edges, and those of a lossy format,
    are cut at half of white. Alpha that is not the same everywhere is the mask, whatever the colours are. With `exif` the mask is turned
    as its image is: by its own orientation or, if only its image has one and it fits no other way, by that.

    Raises:
        InputError: naming the file, when it is missing or damaged.
    """
    if frame.mask is None:
        return None
    decoded, header = decode(frame.mask)
    mask = _white(decoded, header.format in LOSSY)
    if exif:
        mask = upright(mask, 1 if header.format == heif.FORMAT else header.orientation)
        orientation = orientation_of(frame.image)
        if orientation >= LYING:
            width, height = image_header(frame.image).size
            as_stored, turned = (abs(math.log(mask.shape[1] * b / (mask.shape[0] * a))) for a, b in ((width, height), (height, width)))
            mask = upright(mask, orientation) if as_stored < turned else mask
    return np.asarray(mask != frame.mask_excludes)


def usable_pixels(frame: Frame, image: Array, *, exif: bool = False) -> Array | None:
    """(H, W) bool: pixels of the frame's `image` (H, W, 3 or 4) that its mask allows and that are not see-through; None: all.

    Raises:
        InputError: as `load_mask`.
    """
    height, width = image.shape[:2]
    usable = load_mask(frame, exif=exif)
    if usable is not None and usable.shape != (height, width):
        usable = np.asarray(cv2.resize(usable.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)
    if image.shape[2] == 4:
        opaque = image[:, :, 3] >= 128
        usable = opaque if usable is None else usable & opaque
    return usable


def _white(mask: Array, lossy: bool) -> Array:
    """(H, W) bool: what a decoded mask of any depth and number of channels marks."""
    if mask.ndim == 3 and mask.shape[2] in (2, 4):
        alpha = mask[:, :, -1]
        if alpha.min() < alpha.max():
            return np.asarray(alpha > alpha.max() / 2)
    grey = mask if mask.ndim == 2 else mask[:, :, :3].max(axis=2)
    if lossy:
        return np.asarray(grey > 255 / 2)
    soft = grey.dtype.kind == "f" or np.count_nonzero(np.bincount(grey.ravel())) > FEW_LEVELS
    return np.asarray(grey > grey.max() / 2 if soft else grey > 0)


def to_rgba(image: Array, white: float | None = None, *, linear: bool = False) -> Array:
    """A decoded image of any depth and number of channels (BGR order) → (H, W, 3) or (H, W, 4) uint8 RGB(A).

    Args:
        white: the value of 16-bit or floating-point channels that becomes 255; None: 65535, or 1. Alpha of 16 bits always uses all.
        linear: such channels hold linear light, which gets sRGB's curve.
    """
    if image.dtype == np.uint16 and not linear:
        alpha = image[..., 3:] if white is not None and image.ndim == 3 and image.shape[2] == 4 else None
        image = cv2.convertScaleAbs(image, alpha=255 / (white or 65535))
        if alpha is not None:
            image[..., 3:] = alpha >> 8
    elif image.dtype != np.uint8 and linear:
        image = _shown(image, white)
    elif image.dtype != np.uint8:
        top = white or 1
        finite = np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=top, neginf=0.0)
        image = np.round(np.clip(finite / np.float32(top), 0, 1) * 255).astype(np.uint8)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB))
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB))


def _shown(image: Array, white: float | None) -> Array:
    """Linear light, 16-bit or floating-point, with sRGB's curve: uint8. `white` (None: 65535, or 1) becomes 255; alpha is no light."""
    alpha = image[..., 3:] if image.ndim == 3 and image.shape[2] == 4 else None
    if image.dtype == np.uint16:
        out = stored(np.arange(65536, dtype=np.float32) / np.float32(white or 65535))[image]
        if alpha is not None:
            out[..., 3:] = alpha >> 8
        return out
    out, top = np.empty(image.shape, np.uint8), np.float32(white or 1)
    for start in range(0, len(image), ROWS):  # of a large image all at once would take fifty bytes a pixel
        rows = image[start : start + ROWS].astype(np.float32)
        out[start : start + ROWS] = stored(np.nan_to_num(rows / top, nan=0.0, posinf=1.0, neginf=0.0))
    if alpha is not None:
        out[..., 3:] = np.round(np.clip(np.nan_to_num(alpha), 0, 1) * 255)
    return out


def as_bgr(image: Array) -> Array:
    """(H, W, 3) RGB or (H, W, 4) RGBA with premultiplied alpha, floating-point → BGR(A), alpha not premultiplied; (H, W) as it is."""
    if image.ndim == 2:
        return image
    out = np.ascontiguousarray(image[..., [2, 1, 0, *range(3, image.shape[2])]])
    if out.shape[2] == 4:
        alpha = np.where(out[..., 3:] > 0, out[..., 3:], np.float32(1))
        out[..., :3] /= alpha
    return out


def upright(image: Array, orientation: int) -> Array:
    """Apply an EXIF orientation (1 to 8, TIFF 6.0 tag 274) to (H, W, ...) pixels."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def _values(path: Path, frame: Frame) -> Array:
    """What the file of a depth map, or of its confidence, holds."""
    if path.suffix.lower() == exr.SUFFIX:
        return exr.read_exr(path, depth=True)
    camera = frame.depth_intrinsics
    if path.suffix.lower() in MAPS and camera is not None:
        return load_map(path, camera.width, camera.height)
    return decode(path)[0]


def decode(path: Path, balance: raw.Balance | None = None, *, small: bool = False) -> tuple[Array, Header]:
    """The pixels as stored (OpenCV's channel order and depth; of HEIF and camera raw as they are seen), and the file's header.

    Args:
        balance: white balance of camera raw. small: half of its size will do.
    """
    data = read_bytes(path)
    header = read_header(data, path)
    if header.format == heif.FORMAT:
        return heif.decode(data, path), header
    if header.format == raw.FORMAT:
        return raw.develop(data, path, balance, small=small), header
    if header.format == exr.FORMAT:
        return as_bgr(exr.read_exr(path)), header
    image: Any = None
    try:
        if header.format == "AVIF":  # OpenCV reads more than 8 bits in a range of their own
            with Image.open(io.BytesIO(data)) as opened:
                rgb = np.asarray(opened.convert("RGBA" if opened.mode in ("RGBA", "LA") else "RGB"))
            image = cv2.cvtColor(rgb, cv2.COLOR_RGBA2BGRA if rgb.shape[2] == 4 else cv2.COLOR_RGB2BGR)
        else:
            # UNCHANGED keeps alpha and 16 bits, and leaves the orientation to us; TIFFs would be turned all the same.
            image = cv2.imdecode(np.frombuffer(unturned(data), np.uint8), cv2.IMREAD_UNCHANGED)
    except Exception:  # Pillow's decoders raise many families on damaged files
        image = None
    if image is None:
        raise InputError(
            f"the image {path} ({header.format}) is damaged or of a kind that cannot be decoded; copy it again or convert it to PNG"
        )
    return np.asarray(image), header


def _load_npy(path: Path) -> Array:
    try:
        # Mapped, not read: a header that promises more than the file holds is refused before memory is taken for it.
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise InputError(f"cannot read the depth map {path}: {error.strerror or error}") from error
    except Exception as error:  # the header is parsed as Python text, which on damaged files raises many families
        raise InputError(
            f"the depth map {path} is not a plain .npy array of numbers, or it is cut short; write it with numpy.save"
        ) from error
    if not isinstance(mapped, np.ndarray) or mapped.dtype.kind not in "fiu" or mapped.size > MAX_PIXELS:
        raise InputError(f"the depth map {path} is not an array of numbers of at most {MAX_PIXELS // 10**6} megapixels")
    return np.array(mapped)
