"""Reads images from files, after a check of the size in their header."""

import warnings
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from PIL import Image as Header

from ballfg.checks import one_line
from ballfg.files.damaged import check_pixels, whole_content
from ballfg.vision.arrays import Image

ENDINGS: Final = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")  # others are ignored
FORMATS: Final = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "MPO")  # Pillow's; MPO: telephones' JPEG
_TILES: Final = (322, 323)  # tags of TIFF: width and height of the pieces in which the pixels are kept


def read_image(path: Path, flags: int) -> Image:
    """An image by `cv2.imdecode`, (h, w) or (h, w, 3) uint8, BGR. Raises: ValueError: none, or too large. OSError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Header.DecompressionBombWarning)  # our own bound is lower
            with Header.open(path, formats=FORMATS) as header:
                sizes = [header.size]
                tags = getattr(header, "tag_v2", {})
                if all(tag in tags for tag in _TILES):
                    sizes.append((int(tags[_TILES[0]]), int(tags[_TILES[1]])))
    except Exception as error:  # of any class: the header is damaged, or of a size that Pillow refuses
        if isinstance(error, OSError) and error.errno is not None:
            raise
        why = one_line(error) if isinstance(error, Header.DecompressionBombError) else "its header is not"
        raise ValueError(f"image {path} must be readable; {why}. Write it again or remove it.") from None
    for width, height in sizes:
        check_pixels(path, width, height)
    image = cv2.imdecode(np.frombuffer(whole_content(path), dtype=np.uint8), flags)
    if image is None:
        raise ValueError(f"image {path} must be readable; OpenCV cannot decode it. Write it again or remove it.")
    return np.asarray(image, dtype=np.uint8)
