"""Image files: what a header says, and pixels that are whole or refused.

Pillow decodes them, since it raises on a truncated PNG or JPEG where OpenCV hands back the rows that it has. A damaged
PNG may still decode, to other pixels: the checksums of its chunks are what tells.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sequences.errors import InputError

Depth = NDArray[np.float32]
Colour = NDArray[np.uint8]
Size = tuple[int, int]

GREY = 128
_DEPTH_MODES = ("I;16", "I;16B", "I")
_REPLACE = "copy the image again from the recording, or remove the frame"


def image_size(path: Path) -> Size:
    """(width, height) from the header alone. Raises InputError where there is no image."""
    return _header(path)[0]


def depth_size(path: Path) -> Size:
    """(width, height) of a depth image. Raises InputError where it isn't a 16-bit image of one channel."""
    size, mode = _header(path)
    if mode not in _DEPTH_MODES:
        raise InputError(
            f"depth image of pixel type {mode}, expected 16 bits and one channel",
            file=path,
            field="pixel type",
            remedy="write depth as 16-bit greyscale PNG, 0 where nothing was measured",
        )
    return size


def read_depth(path: Path, metres_per_count: float, size: Size) -> Depth:
    """(height, width) float32 metres, 0 = no measurement.

    Raises InputError where the file is missing, truncated, damaged, of another size or not 16 bits deep.
    """
    depth_size(path)
    counts = np.asarray(_decode(path, size), dtype=np.float64)
    return (counts * metres_per_count).astype(np.float32)


def read_colour(path: Path | None, size: Size) -> Colour:
    """(height, width, 3) uint8 RGB; mid-grey where `path` is None. Raises InputError as `read_depth`."""
    if path is None:
        return np.full((size[1], size[0], 3), GREY, dtype=np.uint8)
    image = _decode(path, size)
    if image.mode in _DEPTH_MODES:  # a 16-bit grey image; Pillow's own conversion clips it
        image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    return np.array(image.convert("RGB"))


def encode_png(pixels: NDArray[np.uint16] | NDArray[np.uint8]) -> bytes:
    """Pixels (h, w) uint16, (h, w) uint8 or (h, w, 3) uint8 -> PNG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def check_size(path: Path, found: Size, expected: Size, source: str) -> None:
    """Raises InputError where an image isn't of the size that `source` says."""
    if found != expected:
        raise InputError(
            f"is {found[0]} x {found[1]} pixels, {source} says {expected[0]} x {expected[1]}",
            file=path,
            field="size",
            remedy="give depth, colour and camera.json the same width and height",
        )


def _header(path: Path) -> tuple[Size, str]:
    try:
        with Image.open(path) as image:
            return image.size, image.mode
    except FileNotFoundError as error:
        raise InputError("the image is missing", file=path, field="(whole file)", remedy=_REPLACE) from error
    except (OSError, SyntaxError, ValueError) as error:
        raise _damaged(path, error) from error


def _decode(path: Path, size: Size) -> Image.Image:
    check_size(path, image_size(path), size, "the camera")
    try:
        data = path.read_bytes()
        Image.open(io.BytesIO(data)).verify()
        image = Image.open(io.BytesIO(data))
        image.load()
        return image
    except (OSError, SyntaxError, ValueError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(f"truncated or damaged ({error})", file=path, field="pixels", remedy=_REPLACE)
