"""Map images: from the gray of a PNG, PNM or BMP file to occupied cells, as map_server does it.

An alpha channel says where a pixel is known: in the modes trinary and scale one that is not wholly
opaque is unknown, whatever its gray; opaque ones read as if there were no alpha. Mode raw takes no
notice of it. Color counts as the mean of its channels.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from sqn_jax.maps.occupancy import MAX_CELLS
from sqn_jax.outside.messages import one_line

MAX_IMAGE_BYTES = 512 * 2**20
MODES = ("trinary", "scale", "raw")
FORMATS = "PNG, PGM, PPM or BMP"
_TEXT_KINDS = (b"P1", b"P2", b"P3")
# See `suspicious_level`.
_UNKNOWN_GRAY = 205  # of 255
_NEAR_THRESHOLD = 0.1
_WHITE_OCCUPANCY = 0.1  # What is lighter is meant to be free.
_LARGE_FRACTION = 0.2
_UNKNOWN_FRACTION = 0.01


@dataclass(frozen=True)
class Thresholds:
    """How gray becomes occupancy: the keys of a map_server YAML file.

    Attributes:
        mode: trinary, scale or raw.
        negate: True if white is occupied.
        occupied_thresh: occupancy above this is occupied, 0..1.
        free_thresh: occupancy below this is free, 0..1; between the two it is unknown.
    """

    mode: str = "trinary"
    negate: bool = False
    occupied_thresh: float = 0.65
    free_thresh: float = 0.196


@dataclass(frozen=True)
class GrayImage:
    """Decoded pixels: channel sums `level` [H, W] (row 0 at the top) of which `white` is white.

    `opaque` is bool [H, W], or None for an image without an alpha channel.
    """

    level: NDArray[np.integer]
    white: int
    opaque: NDArray[np.bool_] | None


def read_pixels(path: Path) -> GrayImage:
    """Decode a PNG, PNM or BMP file.

    Raises:
        ValueError: one line, without the file's name: not an image, too large, damaged.
    """
    size = path.stat().st_size
    if not 1 <= size <= MAX_IMAGE_BYTES:
        raise ValueError(f"expected 1 to {MAX_IMAGE_BYTES} bytes, got {size}")
    with path.open("rb") as file:
        data = file.read(size)
    if data[:2] in _TEXT_KINDS:
        # The decoder copies a megabyte for every comment: minutes for a file made of them.
        data = re.sub(rb"#[^\r\n]*", b"", data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with _opened(data) as image:
                width, height = image.size
                if width * height > MAX_CELLS:
                    raise _TooLarge(f"{width} x {height} pixels")
                is_png = image.format == "PNG"
            if is_png:
                _require_whole_png(data)
            with _opened(data) as image:
                return _to_gray(image)
        except (_TooLarge, Image.DecompressionBombError) as error:
            # Pillow's own limit is a multiple of this one.
            found = str(error) if isinstance(error, _TooLarge) else "more pixels"
            raise ValueError(
                f"{found}, expected at most {MAX_CELLS} cells: a smaller or coarser image"
            ) from error
        except UnidentifiedImageError as error:
            raise ValueError(f"contents of another kind, expected a {FORMATS} image") from error
        # Pillow's decoders raise a dozen kinds of error on damaged files: each means unusable.
        except Exception as error:
            raise ValueError(f"{one_line(error)}, expected a readable {FORMATS} image") from error


class _TooLarge(ValueError):
    """More pixels than a map may have cells."""


def _opened(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data), formats=("PNG", "PPM", "BMP"))


def _require_whole_png(data: bytes) -> None:
    """Refuse wrong checksums and missing rows; Pillow reports the rest when it decodes."""
    # Rows that are missing stay what they were before decoding: they differ if that does.
    if _last_rows(data, 0) != _last_rows(data, 1):
        raise ValueError("rows of pixels are missing")
    with _opened(data) as image:
        image.verify()


def _last_rows(data: bytes, before: int) -> bytes:
    """The end of an image decoded over pixels of a value; of an interlaced one that is two rows."""
    with _opened(data) as image:
        image.im = Image.new(image.mode, image.size, before).im
        return image.crop((0, max(0, image.height - 2), *image.size)).tobytes()


def _to_gray(image: Image.Image) -> GrayImage:
    """Pixels of an open image of any supported kind."""
    # A palette's transparency is an alpha channel like any other, and so is a gray or a color that
    # is marked as clear.
    clear = image.info.get("transparency")
    if image.mode in ("I", "I;16", "I;16B", "I;16L"):
        # 16 bits: read as numbers, since a conversion to 8 bits would clip at 255.
        gray = np.asarray(image).astype(np.int64).clip(0, 65535)
        return GrayImage(gray, 65535, None if clear is None else gray != clear)
    if image.mode in ("P", "RGB", "L", "1"):
        channels = "RGB" if image.mode in ("P", "RGB") else "L"
        image = image.convert(channels if clear is None else channels + "A")
    if image.mode not in ("L", "LA", "RGB", "RGBA"):
        raise ValueError(f"pixel type {image.mode!r}, expected gray, color or palette")
    pixels = np.asarray(image)
    if pixels.ndim == 2:
        return GrayImage(pixels, 255, None)
    opaque = None
    if image.mode in ("LA", "RGBA"):
        opaque, pixels = pixels[..., -1] == 255, pixels[..., :-1]
    return GrayImage(pixels.sum(axis=-1, dtype=np.int32), 255 * pixels.shape[-1], opaque)


def level_occupancy(white: int, thresholds: Thresholds) -> NDArray[np.float64]:
    """Occupancy of every gray level 0..white: 0..1, or above 1 where a raw level means unknown."""
    levels = np.arange(white + 1)
    if thresholds.mode == "raw":
        # Raw images hold the percentage itself, whatever `negate` says; above 100 is unknown.
        return np.round(levels * 255 / white) / 100
    return (levels if thresholds.negate else white - levels) / white


def occupied_cells(image: GrayImage, thresholds: Thresholds) -> NDArray[np.bool_]:
    """Occupied cells [H, W] with row 0 at the BOTTOM: whatever is not free, unknown included.

    A pixel is free if its occupancy is below `free_thresh`; but for raw mode it must be opaque too.
    """
    free_level = level_occupancy(image.white, thresholds) < thresholds.free_thresh
    free = free_level[image.level]
    if thresholds.mode != "raw" and image.opaque is not None:
        free &= image.opaque
    return ~free[::-1]


def unknown_cells(image: GrayImage, thresholds: Thresholds) -> NDArray[np.bool_] | None:
    """Cells [H, W], row 0 at the BOTTOM, neither free nor surely occupied; None if none is."""
    occupancy = level_occupancy(image.white, thresholds)
    is_sure = (occupancy > thresholds.occupied_thresh) & (occupancy <= 1)
    sure = is_sure[image.level]
    if thresholds.mode != "raw" and image.opaque is not None:
        sure &= image.opaque
    unknown = occupied_cells(image, thresholds) & ~sure[::-1]
    return unknown if unknown.any() else None


def why_nothing_is_free(image: GrayImage, thresholds: Thresholds) -> str:
    """What makes so few pixels free that no robot fits: negate, transparency, the threshold."""
    parts = [f"{_free_fraction(image, thresholds):.1%} of the pixels are free"]
    if thresholds.mode == "raw":
        return f"{parts[0]} (mode raw: values below {100 * thresholds.free_thresh:g})"
    kind = "dark" if thresholds.negate else "light"
    parts[0] += f" (negate: {thresholds.negate:d}, the {kind} ones)"
    if image.opaque is not None and not image.opaque.all():
        clear = 1 - image.opaque.mean()
        parts.append(f"{clear:.1%} are transparent, which means unknown")
    other = replace(thresholds, negate=not thresholds.negate)
    parts.append(f"negate: {other.negate:d} would make {_free_fraction(image, other):.1%} free")
    return "; ".join(parts)


def _free_fraction(image: GrayImage, thresholds: Thresholds) -> float:
    return 1.0 - float(occupied_cells(image, thresholds).mean())


@dataclass(frozen=True)
class Suspicion:
    """A gray level that reads as free and probably means unknown, and what would change that."""

    text: str
    thresholds: Thresholds
    """The same with a `free_thresh` under which the level is not free."""


def suspicious_level(image: GrayImage, thresholds: Thresholds) -> Suspicion | None:
    """A gray level that probably means unknown and yet reads as free, else None.

    Map files write unknown as gray 205, occupancy 0.196. A `free_thresh` above that makes all
    unexplored ground free. Suspicious is the largest level, other than the freest one present,
    whose occupancy is at least 0.1 and within 0.1 below `free_thresh`, if it fills more than a
    fifth of the free space; for 205 itself a hundredth is enough, since little else is ever
    written so.
    """
    if thresholds.mode == "raw":
        return None
    occupancy = level_occupancy(image.white, thresholds)
    levels = image.level if image.opaque is None else image.level[image.opaque]
    pixels = np.bincount(levels.ravel(), minlength=image.white + 1)
    free = (occupancy < thresholds.free_thresh) & (pixels > 0)
    near = free & (occupancy >= max(thresholds.free_thresh - _NEAR_THRESHOLD, _WHITE_OCCUPANCY))
    if not near.any():
        return None
    near &= occupancy > occupancy[free].min()
    level = int(np.argmax(np.where(near, pixels, 0)))
    fraction = pixels[level] / pixels[free].sum()
    is_unknown_gray = round(level * 255 / image.white) == _UNKNOWN_GRAY
    if not near[level] or fraction <= (_UNKNOWN_FRACTION if is_unknown_gray else _LARGE_FRACTION):
        return None
    # Rounded down, but not past the next lighter level.
    threshold = max(math.floor(1000 * occupancy[level]) / 1000, 0.0)
    if threshold <= occupancy[free & (occupancy < occupancy[level])].max():
        threshold = float(occupancy[level])
    text = (
        f"gray {level} of {image.white} (occupancy {occupancy[level]:.3f}) fills {fraction:.0%} of "
        f"the free space: if it means unknown, lower free_thresh from {thresholds.free_thresh:g} "
        f"to {threshold:g}"
    )
    return Suspicion(text, replace(thresholds, free_thresh=threshold))
