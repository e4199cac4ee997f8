"""Pictures of a run folder, reduced in size for a page."""

from __future__ import annotations

from pathlib import Path

import cv2

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_bytes
from bmask_slam.reporting.parts import Picture
from bmask_slam.semantics.instances.image_files import decode_image

FILM_SUFFIX, GIF = ".gif", (b"GIF87a", b"GIF89a")


def read_picture(path: Path, title: str, width_px: int) -> Picture:
    """A picture, at most ``width_px`` wide, as PNG; of a film, the whole file.

    Raises:
        InputError: it cannot be read or is no picture.
    """
    if path.suffix == FILM_SUFFIX:
        data = read_bytes(path, "make it again by bmask-slam film")
        if not data.startswith(GIF):  # it goes into the page as it is
            raise InputError(f"{path}: is no GIF; make it again by bmask-slam film")
        width, height = (int.from_bytes(data[k : k + 2], "little") for k in (6, 8))
        return Picture(title, f"{title}.", data, "image/gif", (width, height), wide=True)
    image = decode_image(path, cv2.IMREAD_COLOR)
    height, width = image.shape[:2]
    if width > width_px:
        height, width = round(height * width_px / width), width_px
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".png", image)[1].tobytes()
    return Picture(title, f"{title}.", data, "image/png", (width, height))
