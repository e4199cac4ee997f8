"""A recording as its files have it: lists of images, how they are decoded, camera and truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.semantics.instances.image_files import decode_image, read_colour
from bmask_slam.sequences.images import (
    Lens,
    check_depth_type,
    check_size,
    depth_in_metres,
    reduced_colour,
    reduced_depth,
)
from bmask_slam.sequences.lists import ImageList
from bmask_slam.sequences.registration import register_depth


@dataclass(frozen=True, eq=False)
class DepthForm:
    """What the stored values of depth images mean, beside the camera's ``depth_scale``.

    Attributes:
        missing: stored value without depth; 0 is always one.
        camera: the depth camera, where depth is not registered to colour.
        T_colour_depth: (4, 4) from that camera to the colour camera.
        lens: undistorts the depth images before all else; None: nothing does.
    """

    missing: int = 0
    camera: Camera | None = None
    T_colour_depth: Array = field(default_factory=lambda: np.eye(4))
    lens: Lens | None = None

    def on_colour(self, stored: NDArray, camera: Camera) -> NDArray:
        """Stored values (h, w) as z-depth at the pixels (H, W) of the colour ``camera``.

        In the units of its ``depth_scale``, 0 or NaN where missing.
        """
        if self.missing:
            stored = np.where(stored == self.missing, stored.dtype.type(0), stored)
        if self.lens is not None:
            stored = self.lens.undistorted_depth(stored)
        if self.camera is None:
            return stored
        z_m = np.divide(stored, camera.depth_scale, dtype=np.float32)
        z_m[~(z_m > 0)] = np.nan
        z_m = register_depth(z_m, self.camera, self.T_colour_depth, camera)
        return z_m * np.float32(camera.depth_scale)


def read_stored(file: Path) -> NDArray:
    """The values (h, w) of an image file as they are. Raises InputError."""
    return decode_image(file, cv2.IMREAD_UNCHANGED)


@dataclass(frozen=True, eq=False)
class Recording:
    """The images of a recording in any layout, and what is known about them.

    Attributes:
        layout: name of its layout.
        path: its folder or file.
        rgb, depth: stamped images; a path may stand for a part of the file ``path``.
        camera: the colour camera.
        camera_source: where its parameters come from.
        groundtruth: T_world_camera of the colour camera, or None.
        form: what depth values mean.
        colour, stored_depth: decode the image that a path stands for: (H, W, 3), red first, and
            (h, w) stored values, integers or floats. Both raise InputError.
        exists: whether an image is there.
        lens: undistorts the colour images; None: nothing does.
    """

    layout: str
    path: Path
    rgb: ImageList
    depth: ImageList
    camera: Camera
    camera_source: str
    groundtruth: Trajectory | None = None
    form: DepthForm = field(default_factory=DepthForm)
    colour: Callable[[Path], Image] = read_colour
    stored_depth: Callable[[Path], NDArray] = read_stored
    exists: Callable[[Path], bool] = Path.is_file
    lens: Lens | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the stamps or images of the lists doubtful."""
        return self.rgb.warnings + self.depth.warnings

    def read_rgb(self, file: Path, camera: Camera) -> Image:
        """The colour image (H, W, 3), red first, reduced as the camera says.

        Raises:
            InputError: an image that cannot be read, or is of another size than the camera records.
        """
        rgb = self.colour(file)
        check_size(file, rgb, camera)
        if self.lens is not None:
            rgb = self.lens.undistorted_colour(rgb)
        return reduced_colour(rgb, camera.reduced_by)

    def read_depth(self, file: Path, camera: Camera) -> Floats:
        """Depth (H, W) in metres at the pixels of the colour camera, NaN where missing.

        Raises:
            InputError: as ``read_rgb``.
        """
        return depth_in_metres(self.registered_depth(file, camera), camera)

    def registered_depth(self, file: Path, camera: Camera) -> NDArray:
        """Stored depth (H, W), z-depth registered to ``camera``, 0 or NaN where missing."""
        stored, form = self.stored_depth(file), self.form
        check_depth_type(file, stored, camera)
        check_size(file, stored, form.camera or camera)
        found = form.on_colour(stored, camera)
        return found if form.camera else reduced_depth(found, camera.reduced_by)
